"""Reports to one edge: its received messages, the link, the readings of its stills. For any thread."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable

from hvt_common.protocol.clock_offset import ClockOffset
from hvt_common.protocol.messages import MAX_ACKNOWLEDGED_RANGES, Feedback, StillResult
from hvt_ground.backlog.edge_backlog import EdgeBacklog
from hvt_ground.link.statistics import LinkMeasurement

_MOST_DELAY_MS = 3_600_000.0
_MOST_OBJECTS = 65_535


class ReceiverReports:
    """Makes and sends them, in the order of their numbers; ``clock`` is Unix nanoseconds without steps."""

    def __init__(
        self,
        publish: Callable[[Feedback], None],
        *,
        clock: Callable[[], int],
        clock_offset: ClockOffset,
        backlog: EdgeBacklog,
    ) -> None:
        self._publish = publish
        self._clock = clock
        self.clock_offset = clock_offset
        self._backlog = backlog
        self._receiver_id = secrets.randbits(64)
        self._sequence = 0
        self._lock = threading.Lock()

    def send(
        self,
        *,
        session_id: int,
        last_frame_index: int,
        objects_detected: int,
        base: tuple[int, int],
        roi: tuple[int, int],
        lost: int,
        corrupt: int,
        measured: LinkMeasurement,
        stills: tuple[StillResult, ...],
    ) -> None:
        """Report on a session as it is now; ``base`` and ``roi`` are messages and bytes."""
        delay_ms, (offset_ns, error_ns) = measured.delay_p50_ms, self.clock_offset.estimate or (0, -1)
        with self._lock:
            feedback = Feedback(
                session_id=session_id,
                receiver_id=self._receiver_id,
                sequence=self._sequence,
                send_ns=self._clock(),
                last_frame_index=last_frame_index,
                base_messages=base[0],
                base_bytes=base[1],
                roi_messages=roi[0],
                roi_bytes=roi[1],
                lost=lost,
                corrupt=corrupt,
                base_sequence=measured.base_sequence,
                base_held_us=measured.base_held_us,
                still_sequence=measured.still_sequence,
                missing_stills=measured.missing_stills,
                delay_p50_ms=-1.0 if delay_ms is None else min(delay_ms, _MOST_DELAY_MS),
                clock_offset_ns=offset_ns,
                clock_error_ns=error_ns,
                stills=stills,
                backlog=self._backlog.take_acknowledged_ranges(MAX_ACKNOWLEDGED_RANGES),
                objects_detected=min(objects_detected, _MOST_OBJECTS),
            )
            self._sequence += 1
            self._publish(feedback)
