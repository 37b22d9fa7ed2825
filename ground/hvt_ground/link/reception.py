"""What came of a session, and the figures of the receiver report: the newest message of each stream, stills missing.

Reports cost the way back: they come so often that together they take `_SHARE` of what arrives, within bounds, and
only when something new has arrived; in a pause the usual ones, twice a second, go on.
"""

from __future__ import annotations

import statistics
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.protocol.clock_offset import ClockOffset
from hvt_common.protocol.ledger import Account, Ledger, overhead_bytes
from hvt_common.protocol.messages import (
    MAX_MISSING_STILLS,
    BacklogHeader,
    BaseHeader,
    Feedback,
    Info,
    PoseReport,
    RoiHeader,
    Status,
    TrackStep,
)
from hvt_common.runtime.statistics import LatencyStats, Newest, SequenceWindow
from hvt_common.transport.inbox import Received
from hvt_common.units import SECOND_NS
from hvt_ground.events import Event, MessageTiming, Traffic
from hvt_ground.link.reassemble import StreamCounters

_MS = 1_000_000
_LONGEST_TRIP_NS = 60 * SECOND_NS
_EARLY_NS = 5 * SECOND_NS
"""More than half the round trip of any link that carries video."""
REPORT_LINE_BYTES = 180
"""Line bytes of a report without results."""
_SHARE = 0.03
_LEAST_NS, _MOST_NS = 100 * _MS, 500 * _MS
_RATE_OVER_NS = 2 * SECOND_NS
_MOST_DELAYS, _MOST_DELAY_MS = 256, 3_600_000.0
_ACCOUNTS = {Channel.BASE: Account.BASE, Channel.ROI: Account.ROI, Channel.BACKLOG: Account.BACKLOG}
_HELD_US = 2**32 - 1
_MOST_SENT = 512
"""Stills whose second copy is still known for one: those of the last seconds."""
_NEVER_NS = -(2**64)
"""When a still was sent that has come with the backlog only."""
_NEAR_STILLS = 256
"""A still that is further from the highest number may be forged: it counts once another follows it."""
_MISSED_NS = 6 * SECOND_NS
"""A still that has not come for so long does not come any more: reports need not name it for ever."""


class ReceptionStatistics:
    """What came of one session: bytes, order, gaps and ages, and the figures of the receiver report.

    ``clock`` is Unix nanoseconds without steps, the ``now_ns`` and ``arrived_ns`` of all calls; ``emit`` takes the
    events. Safe for threads: messages come in one, and a still that was read in another is reported at once.
    """

    def __init__(
        self, info: Info, *, clock: Callable[[], int], edge_clock: ClockOffset, emit: Callable[[Event], None]
    ) -> None:
        self.lockstep = info.pace == "lockstep"
        self.budget_bps = info.budget_bps
        """As it is now, some seconds late."""
        self.ledger = Ledger(window_ns=info.window_ns)
        self.receive_latency, self.overlay_latency = LatencyStats(), LatencyStats()
        self.capture_clock, self.pose_clock = CaptureClock(edge_clock), CaptureClock(edge_clock)
        """Of the camera and of the source of poses."""
        self.counters = StreamCounters()
        """What the reassembly counted since the session before."""
        self.sequences = StillSequenceWindow()
        self.frames = self.stills = self.steps = 0
        """Received; the last are reports of the edge's tracks."""
        self.newest_index = -1
        """Frame index of the newest access unit; -1 before the first."""
        self.newest_capture_ns = 0
        """Its capture time, the edge's clock; 0 before the first."""
        self._first_capture_ns: int | None = None
        self._info = info
        self._keys = EdgeKeys(info.edge)
        self._clock = clock
        self._emit = emit
        self._next_traffic_ns = 0
        self.last_traffic: Traffic | None = None
        """The present measurement."""
        self._lock = threading.Lock()
        self._base_sequence = self._still_sequence = self._last_still = -1
        self._from_start = False
        self._missing: Newest[int, int] = Newest(MAX_MISSING_STILLS)
        """Sequence → when it was first missed."""
        self._arrived_ns = 0
        self._sizes: deque[tuple[int, int]] = deque()
        self._size_bytes = 0
        self._delays_ms: deque[float] = deque(maxlen=_MOST_DELAYS)
        self._news = False
        self._reported_ns: int | None = None

    @property
    def knows_delay(self) -> bool:
        """Whether the times of pictures say how long they were on their way."""
        return self.capture_clock.is_sound and not self.lockstep

    @property
    def newest_captured_ns(self) -> int | None:
        """The capture time of the newest picture, this ground's clock; None before the first."""
        if self._first_capture_ns is None:
            return None
        return self.capture_clock.to_local_ns(self.newest_capture_ns)

    @property
    def duration_s(self) -> float:
        """From the first frame received to the last by their capture, with one frame's length."""
        if self._first_capture_ns is None:
            return 0.0
        span_ns = max(0, self.newest_capture_ns - self._first_capture_ns)
        return span_ns / SECOND_NS + 1 / self._info.fps

    def frame(self, header: BaseHeader) -> None:
        """An access unit has its turn."""
        self.frames += 1
        if self._first_capture_ns is None:
            self._first_capture_ns = header.capture_ns
        self.newest_index, self.newest_capture_ns = header.frame_index, header.capture_ns

    def delay_ms(self, capture_ns: int, at_ns: int) -> float | None:
        """From capture until then; None where clocks do not tell."""
        if not self.knows_delay:
            return None
        return max(0.0, (at_ns - self.capture_clock.to_local_ns(capture_ns)) / _MS)

    def count(self, row: Channel, item: Received, *, at_ns: int) -> None:
        """Take the bytes of a message on the line."""
        size, extra = len(item.payload), len(item.attachment)
        self.ledger.count(
            _ACCOUNTS.get(row, Account.META),
            payload_bytes=size,
            attachment_bytes=extra,
            overhead_bytes=overhead_bytes(size, extra, key=self._keys.key(row), encoding=item.encoding),
            at_ns=at_ns,
        )

    def time(
        self,
        kind: str,
        item: Received,
        header: BaseHeader | RoiHeader | TrackStep | PoseReport | Status | BacklogHeader,
        *,
        handled: bool | None,
    ) -> None:
        """Give out when a message came; ``handled``: something was made of it, None is said later."""
        size, extra = len(item.payload), len(item.attachment)
        frame_index, capture_ns = -1, 0
        if isinstance(header, BaseHeader | RoiHeader | TrackStep):
            frame_index, capture_ns = header.frame_index, header.capture_ns
        self._emit(
            MessageTiming(
                kind=kind,
                sequence=header.number if isinstance(header, BacklogHeader | PoseReport) else header.sequence,
                frame_index=frame_index,
                capture_ns=capture_ns,
                send_ns=header.send_ns,
                received_ns=item.received_ns,
                handled_ns=None if handled is None else self._clock() if handled else 0,
                line_bytes=size + extra + overhead_bytes(size, extra, key=item.key, encoding=item.encoding),
                clock_offset_ns=self.capture_clock.offset_ns,
            )
        )

    def traffic(self, header: BaseHeader, *, tracks: int, tracks_refined: int) -> None:
        """Give out how full the link was and how old the picture is, twice a second of the stream."""
        at_ns, ledger = header.send_ns, self.ledger
        if 0 < self._next_traffic_ns - at_ns <= SECOND_NS // 2:  # more: its time was set back
            return
        self._next_traffic_ns = at_ns + SECOND_NS // 2
        to_bps = 8 * SECOND_NS / self._info.window_ns
        self.last_traffic = Traffic(
            frame_index=header.frame_index,
            capture_ns=header.capture_ns,
            base_bps=ledger.window_bytes(Account.BASE, at_ns) * to_bps,
            roi_bps=ledger.window_bytes(Account.ROI, at_ns) * to_bps,
            total_bps=ledger.window_bytes(None, at_ns) * to_bps,
            budget_bps=self.budget_bps,
            receive_latency_ms=self.receive_latency.percentile(50) if self.knows_delay else None,
            overlay_latency_ms=self.overlay_latency.percentile(50) if self.knows_delay else None,
            tracks=tracks,
            tracks_refined=tracks_refined,
        )
        self._emit(self.last_traffic)

    def base(
        self, header: BaseHeader, *, size_bytes: int, arrived_ns: int, delay_ms: float | None = None
    ) -> None:
        """An access unit of this session has arrived; ``delay_ms`` from capture, where clocks allow to say."""
        with self._lock:
            if header.sequence > self._base_sequence:
                self._base_sequence, self._arrived_ns = header.sequence, arrived_ns
            self._from_start |= header.sequence == 0
            if delay_ms is not None:
                self._delays_ms.append(delay_ms)
            self._note(size_bytes, arrived_ns)

    def still(self, sequence: int, *, size_bytes: int, arrived_ns: int) -> None:
        """A still of this session has arrived."""
        with self._lock:
            self._missing.pop(sequence, None)
            if self._still_sequence < 0 or abs(sequence - self._still_sequence) <= _NEAR_STILLS:
                if sequence > self._still_sequence:
                    self._miss(self._still_sequence + 1, sequence, at_ns=arrived_ns)
                    self._still_sequence = sequence
            elif 0 < sequence - self._last_still <= _NEAR_STILLS:
                self._still_sequence = sequence
                self._missing.clear()
            self._last_still = sequence
            self._note(size_bytes, arrived_ns)

    def backlog(self, *, size_bytes: int, arrived_ns: int) -> None:
        """A chunk of the backlog has arrived."""
        with self._lock:
            self._note(size_bytes, arrived_ns)

    def stored_still(self, sequence: int) -> None:
        """A still that never came on ``roi`` came afterwards, with the backlog."""
        with self._lock:
            self._missing.pop(sequence, None)

    def due(self, now_ns: int) -> bool:
        """Whether a report should go out."""
        with self._lock:
            if self._reported_ns is None:
                return True
            since_ns = now_ns - self._reported_ns
            return since_ns >= _MOST_NS or (self._news and since_ns >= self._interval_ns(now_ns))

    def _interval_ns(self, now_ns: int) -> int:
        if self.lockstep:
            return _MOST_NS
        self._forget(now_ns)
        arriving = self._size_bytes / _RATE_OVER_NS
        if arriving <= 0:
            return _MOST_NS
        return min(_MOST_NS, max(_LEAST_NS, round(REPORT_LINE_BYTES / (_SHARE * arriving))))

    def feedback(self, send_ns: int, **of_others: Any) -> Feedback:
        """The report of now, with what others know; delays begin anew."""
        with self._lock:
            delays = list(self._delays_ms)
            self._delays_ms.clear()
            self._news = False
            self._reported_ns = send_ns
            for one in [one for one, at_ns in self._missing.items() if send_ns - at_ns > _MISSED_NS]:
                del self._missing[one]
            held_us = max(0, send_ns - self._arrived_ns) // 1000 if self._base_sequence >= 0 else 0
            return Feedback(
                session_id=self._info.session_id,
                send_ns=send_ns,
                base_messages=self.frames,
                base_bytes=self.ledger.base_bytes,
                roi_messages=self.stills,
                roi_bytes=self.ledger.roi_bytes,
                lost=self.counters.lost,
                corrupt=self.counters.corrupt,
                base_sequence=self._base_sequence,
                base_held_us=min(held_us, _HELD_US),
                still_sequence=self._still_sequence,
                missing_stills=tuple(self._missing),
                delay_p50_ms=min(statistics.median(delays), _MOST_DELAY_MS) if delays else -1.0,
                **of_others,
            )

    def _miss(self, first: int, end: int, *, at_ns: int) -> None:
        # Of many, the newest count; what was sent before this ground was there is not missed.
        if self._still_sequence < 0 and not self._from_start:
            return
        for one in range(max(first, end - MAX_MISSING_STILLS), end):
            self._missing[one] = at_ns

    def _note(self, size_bytes: int, arrived_ns: int) -> None:
        self._sizes.append((arrived_ns, size_bytes))
        self._size_bytes += size_bytes
        self._news = True
        self._forget(arrived_ns)

    def _forget(self, now_ns: int) -> None:
        while self._sizes and (self._sizes[0][0] <= now_ns - _RATE_OVER_NS or len(self._sizes) > 4096):
            self._size_bytes -= self._sizes.popleft()[1]


class StillSequenceWindow:
    """The received stills: each is shown once, and counted as often as it crossed. Safe for threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._seen = SequenceWindow()
        self._sent_ns: Newest[int, int] = Newest(_MOST_SENT)
        """Sequence → when a still was sent of which no second copy has come."""

    def is_new(self, sequence: int, *, send_ns: int) -> bool:
        """Whether a still on ``roi`` has not come before."""
        with self._lock:
            if not self._seen.add([sequence]):
                return False
            self._sent_ns[sequence] = send_ns
            return True

    def is_copy(self, sequence: int, *, send_ns: int) -> bool:
        """Whether one that is not new is the copy that the edge sent for want of an acknowledgement; once.

        What bears the time of the first is a replay. Of one that came with the backlog, the first on ``roi`` is such
        a copy.
        """
        with self._lock:
            if send_ns <= self._sent_ns.get(sequence, send_ns):
                return False
            del self._sent_ns[sequence]
            return True

    def is_new_stored(self, sequence: int) -> bool:
        """Whether a still of the backlog has not come before."""
        return self.is_new(sequence, send_ns=_NEVER_NS)

    def forget(self, sequence: int) -> None:
        """One was lost on its way into a file: it is new when it comes again."""
        with self._lock:
            self._seen.discard(sequence)
            self._sent_ns.pop(sequence, None)


class CaptureClock:
    """The times of one camera by this ground's clock.

    A camera's clock may be years off, and an edge may say what it likes. A picture that came before it was captured,
    or a minute after, counts from its arrival, and so do those after it, as long as that can be.
    """

    def __init__(self, edge_clock: ClockOffset) -> None:
        self._edge_clock = edge_clock
        self._own_offset_ns: int | None = None

    def note(self, capture_ns: int, *, received_ns: int) -> None:
        """Take the time of something that has just come."""
        if -_EARLY_NS <= received_ns - self._edge_clock.to_local_ns(capture_ns) <= _LONGEST_TRIP_NS:
            self._own_offset_ns = None
        elif self.is_sound or not 0 <= received_ns - self.to_local_ns(capture_ns) <= _LONGEST_TRIP_NS:
            self._own_offset_ns = capture_ns - received_ns

    @property
    def is_sound(self) -> bool:
        """Whether the offset is that of the edge's clock, and not one from the arrival."""
        return self._own_offset_ns is None

    @property
    def offset_ns(self) -> int:
        """The camera's clock minus ours."""
        return self._edge_clock.offset_ns if self._own_offset_ns is None else self._own_offset_ns

    def to_local_ns(self, capture_ns: int) -> int:
        """A time of the camera as our clock would have shown it."""
        return capture_ns - self.offset_ns
