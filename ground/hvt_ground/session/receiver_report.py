"""Reports to one edge: what came of its messages, how the link is, what the stills were. For any thread."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable

from hvt_common.protocol.clock_offset import ClockOffset
from hvt_common.protocol.messages import MAX_ACKNOWLEDGED_RANGES, MAX_STILL_RESULTS, BaseHeader, Feedback
from hvt_common.transport.inbox import Received
from hvt_ground.backlog.delivery import BacklogDelivery
from hvt_ground.link.statistics import ReceptionStatistics
from hvt_ground.session.session import GroundSession
from hvt_ground.session.subscribe import EdgePort

__all__ = ["Reports"]

_MOST_DELAY_MS = 3_600_000.0


class Reports:
    """Makes and sends them, in the order of their numbers.

    Args:
        port: of the edge.
        clock: Unix nanoseconds without steps.
        clock_offset: what is known of the edge's clock.
        past: holds what is to be acknowledged of what was kept.
    """

    def __init__(
        self, port: EdgePort, *, clock: Callable[[], int], clock_offset: ClockOffset, backlog: BacklogDelivery
    ) -> None:
        self._port = port
        self._clock = clock
        self._clock_offset = clock_offset
        self._backlog = backlog
        self._receiver_id = secrets.randbits(64)
        self._sequence = 0
        self._lock = threading.Lock()
        self.reception_statistics = ReceptionStatistics()
        """Of the session that is open."""

    def begin(self, *, lockstep: bool) -> None:
        """Another session is open."""
        with self._lock:
            self.reception_statistics = ReceptionStatistics(lockstep=lockstep)

    def delay_ms(self, header: BaseHeader, item: Received) -> float:
        """How old an access unit was when it came, clocks reconciled."""
        return max(0.0, (item.received_ns - self._clock_offset.to_local_ns(header.capture_ns)) / 1e6)

    def send(self, session: GroundSession, *, lost: int, corrupt: int) -> None:
        """Report on a session as it is now; ``lost`` and ``corrupt`` count messages."""
        with self._lock:
            send_ns = self._clock()
            measured = self.reception_statistics.take(send_ns)
            delay_ms = measured.delay_p50_ms
            error_ns = self._clock_offset.error_ns
            feedback = Feedback(
                session_id=session.info.session_id,
                receiver_id=self._receiver_id,
                sequence=self._sequence,
                send_ns=send_ns,
                last_frame_index=session.last_frame_index,
                base_messages=session.frames_received,
                base_bytes=session.ledger.base_bytes,
                roi_messages=session.stills_received,
                roi_bytes=session.ledger.roi_bytes,
                lost=lost,
                corrupt=corrupt,
                base_sequence=measured.base_sequence,
                base_held_us=measured.base_held_us,
                still_sequence=measured.still_sequence,
                missing_stills=measured.missing_stills,
                delay_p50_ms=-1.0 if delay_ms is None else min(delay_ms, _MOST_DELAY_MS),
                clock_offset_ns=self._clock_offset.offset_ns or 0,
                clock_error_ns=-1 if error_ns is None else error_ns,
                stills=session.take_results(MAX_STILL_RESULTS),
                backlog=self._backlog.take_acknowledged_ranges(MAX_ACKNOWLEDGED_RANGES),
            )
            self._sequence += 1
            self._port.report(feedback)
