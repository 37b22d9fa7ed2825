"""The account of one session: bytes, order, clocks, counts; and the figures of the receiver report.

Reports cost the way back: their rate is such that they take `_SHARE` of the arriving bytes, within bounds, and
only when something new has arrived; in a pause the usual ones, twice a second, go on.
"""

from __future__ import annotations

import statistics
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.protocol.clock_offset import CaptureClock, ClockOffset
from hvt_common.protocol.edge_words import decision_sentences, each_decision
from hvt_common.protocol.ledger import Account, Ledger, overhead_bytes
from hvt_common.protocol.messages import (
    MAX_MISSING_STILLS,
    MAX_STILL_RESULTS,
    BacklogHeader,
    BacklogKind,
    BaseHeader,
    Feedback,
    Health,
    Info,
    PoseReport,
    RoiHeader,
    Status,
    StillResult,
    TrackStep,
    TrackStepDecoder,
)
from hvt_common.runtime.statistics import LatencyStats, Newest, StillSequenceWindow
from hvt_common.transport.inbox import Received
from hvt_common.units import SECOND_NS, bitrate_text
from hvt_common.values import Tracks
from hvt_ground.events import Event, Level, MessageTiming, Traffic
from hvt_ground.link.reassemble import StreamCounters

Message = BaseHeader | RoiHeader | TrackStep | PoseReport | Status | BacklogHeader

_MS = 1_000_000
REPORT_LINE_BYTES = 180
"""Line bytes of a report without results."""
_SHARE = 0.03
_LEAST_NS, _MOST_NS = 100 * _MS, 500 * _MS
_LEAST_NEWS_NS = 20 * _MS
"""Between two reports, where something is missing."""
_RATE_OVER_NS = 2 * SECOND_NS
_MOST_DELAYS, _MOST_DELAY_MS = 256, 3_600_000.0
_ACCOUNTS = {Channel.BASE: Account.BASE, Channel.ROI: Account.ROI, Channel.BACKLOG: Account.BACKLOG}
_HELD_US = 2**32 - 1
_NEAR_STILLS = 256
"""A still that is further from the highest number may be forged: it counts once another follows it."""
_MISSED_NS = 6 * SECOND_NS
"""A still that is overdue by this does not come any more: reports need not name it for ever."""
_ANEW_NS = 5 * SECOND_NS
"""After this long without a newer one, rising numbers may begin anew: the high ones may have been forged."""
_LATELY_NS, _FRAMES_LATELY = 3 * SECOND_NS, 4
"""A message that came longer ago than both tells nothing of the present."""
_MOST_OBJECTS = 65_535
_MOST_RESULTS = 4096
"""Reports take 32 each; in a flood the newest count."""


class Reception:
    """Counts all received messages of one session, sums them up, and makes the receiver report.

    ``clock`` is Unix nanoseconds without steps, like the ``now_ns`` and ``received_ns`` of all calls; ``emit`` takes
    the events, ``note`` a line for the recording's log. Messages are for one thread; another may report, and add
    results.
    """

    def __init__(
        self,
        info: Info,
        *,
        clock: Callable[[], int],
        edge_clock: ClockOffset,
        emit: Callable[[Event], None],
        note: Callable[[Level, str], None] = lambda _level, _text: None,
    ) -> None:
        self.lockstep = info.pace == "lockstep"
        self.budget_bps = self.highest_budget_bps = info.budget_bps
        self.method = info.method
        """As they are now, some seconds late, and the highest budget that this ground learned of."""
        self.ledger = Ledger(window_ns=info.window_ns)
        self.receive_latency, self.overlay_latency = LatencyStats(), LatencyStats()
        self.clock_offset = edge_clock
        """The offset of the edge's clock."""
        self.capture_clock, self.pose_clock = CaptureClock(edge_clock), CaptureClock(edge_clock)
        """The clocks of the camera and of the source of poses."""
        self.counters = StreamCounters()
        """Counts of the reassembly since the session before."""
        self.sequences = StillSequenceWindow()
        self.frames = self.stills = self.steps = 0
        """Received; the last are reports of the edge's tracks."""
        self.newest_index = -1
        """Frame index of the newest access unit; -1 before the first."""
        self.newest_capture_ns = 0
        """Its capture time, the edge's clock; 0 before the first."""
        self.last_status: Status | None = None
        self.decisions = ""
        """The edge's newest word on what ``auto`` sends beside the video, with the reasons."""
        self.edge_failing: Mapping[str, int] = {}
        """Since when each part of the edge fails, by its clock: a report has the newest try."""
        self.analyzed = (-1, -1)
        """The last analyzed frame, and the number of objects detected by then: reports need both of one moment."""
        self._first_capture_ns = 0
        self._info = info
        self._keys = EdgeKeys(info.edge)
        self._clock, self._emit, self._note = clock, emit, note
        self._step_decoder = TrackStepDecoder()
        self._last_step = -1
        self._stepped_ns = self._status_ns = self._base_ns = 0
        """When the newest report of tracks came, the newest status, and the newest access unit."""
        self._next_traffic_ns = 0
        self._traffic: Traffic | None = None
        self._lock = threading.Lock()
        """Guards all that is below."""
        self._base_sequence = self._still_sequence = self._last_still = -1
        self._missing_base: tuple[int, ...] = ()
        """Sequences that the newest units of ``base`` wait for."""
        self._from_start = False
        self._missing: Newest[int, int] = Newest(MAX_MISSING_STILLS)
        """Sequence → when it was first missed."""
        self._arrived_ns = self._size_bytes = 0
        self._sizes: deque[tuple[int, int]] = deque()
        self._delays_ms: deque[float] = deque(maxlen=_MOST_DELAYS)
        self._results: deque[StillResult] = deque(maxlen=_MOST_RESULTS)
        self._news = False
        self._reported_ns: int | None = None

    # From the receiving thread

    def base(self, header: BaseHeader, item: Received) -> None:
        at_ns = item.received_ns  # its own, also where it waited behind a hole
        self._time_capture(header.capture_ns, at_ns)
        self.count(Channel.BASE, item, at_ns=header.send_ns)
        if not self.frames:
            self._first_capture_ns = header.capture_ns
        self.newest_index, self.newest_capture_ns = header.frame_index, header.capture_ns
        self.frames += 1
        self._base_ns = self._clock()
        with self._lock:
            if header.sequence > self._base_sequence:
                self._base_sequence, self._arrived_ns = header.sequence, at_ns
            self._from_start |= header.sequence == 0
            if self.knows_delay:
                delay_ns = at_ns - self.capture_clock.to_local_ns(header.capture_ns)
                self._delays_ms.append(max(0.0, delay_ns / _MS))
            self._arrive(item)

    def note_held(self, missing: tuple[int, ...], newest: BaseHeader | None, *, at_ns: int) -> bool:
        """Access units wait behind ``missing`` ones, ``newest`` since ``at_ns``; whether to report that at once.

        They count as received: until its frames do, the edge holds the next ones. The edge takes all units up to the
        newest that are not missing for received, too.
        """
        with self._lock:
            news = not set(missing) <= set(self._missing_base)
            self._missing_base = missing
            if newest is not None and newest.sequence > self._base_sequence:
                self._base_sequence, self._arrived_ns, self._news = newest.sequence, at_ns, True
            return news and (self._reported_ns is None or at_ns - self._reported_ns > _LEAST_NEWS_NS)

    def still(self, header: RoiHeader, item: Received) -> bool:
        """Whether a still is to be shown; a second one of the same number is but counted, a third ignored."""
        sequence, at_ns = header.sequence, header.send_ns
        with self._lock:
            self._missing.pop(sequence, None)
            if self._still_sequence < 0 or abs(sequence - self._still_sequence) <= _NEAR_STILLS:
                if sequence > self._still_sequence:
                    self._miss(self._still_sequence + 1, sequence, at_ns=item.received_ns)
                    self._still_sequence = sequence
            elif 0 < sequence - self._last_still <= _NEAR_STILLS:
                self._still_sequence = sequence
                self._missing.clear()
            self._last_still = sequence
            self._arrive(item)
        new = self.sequences.is_new(sequence, send_ns=at_ns)
        if new or self.sequences.is_copy(sequence, send_ns=at_ns):
            self.count(Channel.ROI, item, at_ns=at_ns)
        if new:
            self.time(Channel.ROI, item, header, handled=None)
            self.stills += 1
            self.ledger.record_outcome("received", header.reason)
        return new

    def tracks(self, step: TrackStep, item: Received) -> Tracks | None:
        """The edge's tracks of a newer step; `WireError` where its boxes make no sense."""
        now_ns = self._clock()
        if step.sequence <= self._last_step:
            if step.reference >= 0 or now_ns - self._stepped_ns < _ANEW_NS:
                return None
            self._step_decoder = TrackStepDecoder()
        self._last_step, self._stepped_ns = step.sequence, now_ns
        self.count(Channel.TRACKS, item, at_ns=step.send_ns)
        self.steps += 1
        tracks = self._step_decoder.decode(step)
        self.time(Channel.TRACKS, item, step, handled=tracks is not None)
        return tracks

    def status(self, status: Status, item: Received) -> bool:
        """Whether the edge's report is newer than the last; another is ignored."""
        now_ns = self._clock()
        old = self.last_status is not None and status.sequence <= self.last_status.sequence
        if old and now_ns - self._status_ns < _ANEW_NS:
            return False
        self._status_ns = now_ns
        self.count(Channel.STATUS, item, at_ns=status.send_ns)
        self.time(Channel.STATUS, item, status, handled=True)
        failing, since = (one for one in status.failed if not one.working), self.edge_failing
        self.edge_failing = {one.part: since.get(one.part, one.failed_ns) for one in failing}
        self.last_status = status
        before, now = ([one for one, _ in each_decision(says)] for says in (self.decisions, status.decisions))
        self.decisions = status.decisions or self.decisions
        if status.decisions and now != before:  # numbers alone change each second: they are in the state
            self._note("info", " ".join(decision_sentences(status.decisions)))
        return True

    def backlog(self, header: BacklogHeader, item: Received, *, delivered: bool) -> None:
        """A chunk, of whichever session; ``delivered``: with it an object was whole, and is of use."""
        own_still = header.kind == BacklogKind.STILL and header.session_id == self._info.session_id
        with self._lock:
            self._arrive(item)
            if delivered and own_still:  # it never came on ``roi``
                self._missing.pop(header.number, None)
        self.count(Channel.BACKLOG, item, at_ns=header.send_ns)
        self.time(f"{Channel.BACKLOG}-{header.kind}", item, header, handled=delivered)

    def learn(self, info: Info) -> None:
        if (info.budget_bps, info.method) != (self.budget_bps, self.method):
            budget = bitrate_text(info.budget_bps)
            self._note("info", f"from now on the budget is {budget}, and the method {info.method}")
        self.budget_bps, self.method = info.budget_bps, info.method
        self.highest_budget_bps = max(self.highest_budget_bps, info.budget_bps)

    def time(self, kind: str, item: Received, header: Message, *, handled: bool | None) -> None:
        """Give out when a message came; ``handled``: something was made of it, None is said later."""
        size, extra = len(item.payload), len(item.attachment)
        self._emit(
            MessageTiming(
                kind=kind,
                sequence=header.number if isinstance(header, BacklogHeader | PoseReport) else header.sequence,
                frame_index=getattr(header, "frame_index", -1),
                capture_ns=getattr(header, "capture_ns", 0),
                send_ns=header.send_ns,
                received_ns=item.received_ns,
                handled_ns=None if handled is None else self._clock() if handled else 0,
                line_bytes=size + extra + overhead_bytes(size, extra, key=item.key, encoding=item.encoding),
                clock_offset_ns=self.capture_clock.offset_ns,
            )
        )

    def measure(self, header: BaseHeader, *, tracks: int, tracks_refined: int) -> None:
        """Give out how full the link was and how old the picture is, twice a second of the stream."""
        at_ns, ledger = header.send_ns, self.ledger
        if 0 < self._next_traffic_ns - at_ns <= SECOND_NS // 2:  # more: its time was set back
            return
        self._next_traffic_ns = at_ns + SECOND_NS // 2
        to_bps = 8 * SECOND_NS / self._info.window_ns
        self._traffic = Traffic(
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
        self._emit(self._traffic)

    def count(self, row: Channel, item: Received, *, at_ns: int) -> None:
        """Take the bytes of a message on the line."""
        size, extra = len(item.payload), len(item.attachment)
        self.ledger.count(
            _ACCOUNTS.get(row, Account.META),
            payload_bytes=size,
            attachment_bytes=extra,
            overhead_bytes=overhead_bytes(size, extra, key=self._keys[row], encoding=item.encoding),
            at_ns=at_ns,
        )

    def _time_capture(self, capture_ns: int, received_ns: int) -> None:
        if self.lockstep:
            return
        was_sound = self.capture_clock.is_sound
        self.capture_clock.note(capture_ns, received_ns=received_ns)
        if was_sound and not self.capture_clock.is_sound:
            off_s = abs(received_ns - self.clock_offset.to_local_ns(capture_ns)) // SECOND_NS
            self._note(
                "warning",
                f"the camera's clock is {off_s} s off: ages count from the arrival of pictures, and delays are not "
                "known",
            )

    # Its state

    @property
    def knows_delay(self) -> bool:
        """Whether the times of pictures say how long they were on their way."""
        return self.capture_clock.is_sound and not self.lockstep

    @property
    def duration_s(self) -> float:
        """From the first frame received to the last by their capture, with one frame's length."""
        if not self.frames:
            return 0.0
        span_ns = max(0, self.newest_capture_ns - self._first_capture_ns)
        return span_ns / SECOND_NS + 1 / self._info.fps

    @property
    def not_sent(self) -> Mapping[str, int]:
        """Why candidates have no still: the edge's counts, by reason."""
        return {} if self.last_status is None else self.last_status.outcomes

    @property
    def is_whole(self) -> bool:
        """Whether all has come that the edge counted in its newest report."""
        last, messages = self.last_status, self.ledger.messages
        return last is not None and (
            self.frames >= last.base_messages
            and messages(Account.ROI) >= last.roi_messages
            and messages(Account.BACKLOG) >= last.backlog_messages
            and messages(Account.META) > last.meta_messages  # a report does not count itself
        )

    def traffic(self, now_ns: int) -> Traffic | None:
        """The link's load; None before the first access unit, and where none has come lately."""
        coded_fps = 0.0 if self.last_status is None else self.last_status.coded_fps
        lately_ns = max(_LATELY_NS, round(_FRAMES_LATELY * SECOND_NS / (coded_fps or self._info.fps)))
        return None if now_ns - self._base_ns > lately_ns else self._traffic

    def health(self, now_ns: int) -> Health | None:
        """The edge's health; None before its first report, and where none has come lately."""
        if self.last_status is None or now_ns - self._status_ns > _LATELY_NS:
            return None
        return self.last_status.health

    # Reports

    def add_results(self, results: Iterable[StillResult]) -> None:
        """Count the results of stills that were read."""
        with self._lock:
            self._results.extend(results)

    def take_results(self, most: int) -> tuple[StillResult, ...]:
        """Return and forget up to ``most`` results that the edge has not been sent yet."""
        with self._lock:
            return tuple(self._results.popleft() for _ in range(min(most, len(self._results))))

    def due(self, now_ns: int) -> bool:
        """Whether a report should go out: the more bytes arrived, the more often."""
        with self._lock:
            if self._reported_ns is None:
                return True
            since_ns = now_ns - self._reported_ns
            if since_ns >= _MOST_NS or self.lockstep or not self._news:
                return since_ns >= _MOST_NS
            self._forget(now_ns)
            arriving = self._size_bytes / _RATE_OVER_NS
            return arriving > 0 and since_ns >= max(_LEAST_NS, round(REPORT_LINE_BYTES / (_SHARE * arriving)))

    def feedback(self, *, send_ns: int, **of_receiver: Any) -> Feedback:
        """The report of now, with the fields ``of_receiver`` for all sessions; delays begin anew."""
        last_frame_index, objects_detected = self.analyzed
        results = self.take_results(MAX_STILL_RESULTS)
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
                last_frame_index=last_frame_index,
                objects_detected=min(objects_detected, _MOST_OBJECTS),
                base_messages=self.frames,
                base_bytes=self.ledger.base_bytes,
                roi_messages=self.stills,
                roi_bytes=self.ledger.roi_bytes,
                lost=self.counters.lost + self.counters.resent,
                corrupt=self.counters.corrupt,
                base_sequence=self._base_sequence,
                base_held_us=min(held_us, _HELD_US),
                still_sequence=self._still_sequence,
                missing_stills=tuple(self._missing),
                missing_base=self._missing_base,
                stills=results,
                delay_p50_ms=min(statistics.median(delays), _MOST_DELAY_MS) if delays else -1.0,
                **of_receiver,
            )

    def _miss(self, first: int, end: int, *, at_ns: int) -> None:
        # Of many, the newest count; messages sent before this ground was there are not missed.
        if self._still_sequence < 0 and not self._from_start:
            return
        for one in range(max(first, end - MAX_MISSING_STILLS), end):
            self._missing[one] = at_ns

    def _arrive(self, item: Received) -> None:
        self._sizes.append((item.received_ns, item.size_bytes))
        self._size_bytes += item.size_bytes
        self._news = True
        self._forget(item.received_ns)

    def _forget(self, now_ns: int) -> None:
        while self._sizes and (self._sizes[0][0] <= now_ns - _RATE_OVER_NS or len(self._sizes) > 4096):
            self._size_bytes -= self._sizes.popleft()[1]
