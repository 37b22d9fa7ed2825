"""Paces sending: bounds the bytes in flight, so that no queue stands in kernel or router.

A message is expected to be reported when a link of the present rate would have carried it and all before it (its
*serialization delay*), plus a round trip and one report later. While a message is overdue, or while more than
`_MOST_BACKLOG_NS` of the edge's own bytes wait for that link, frames are dropped before they are encoded, and stills
wait. So after an outage live video starts at once, with nothing to catch up on.

Messages in flight have two accounts: `Flight` counts bytes, for the pace, `BaseInFlight` keeps units, for an outage.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass

from hvt_common.protocol.messages import Feedback
from hvt_common.units import SECOND_NS
from hvt_common.values import AccessUnit
from hvt_edge.link.feedback import Report
from hvt_edge.link.rate_control import LeastDelay, Progress, RateController

_MS = 1_000_000
_MOST_BACKLOG_NS = 250 * _MS
_STILL_BACKLOG_NS = 50 * _MS
"""A still goes when earlier messages have (nearly) left the edge: the next base frame finds the link free."""
_SLACK_NS = 75 * _MS
_LEAST_HELD_NS, _FIRST_HELD_NS, _MOST_HELD_NS = 50 * _MS, 150 * _MS, 500 * _MS
_NO_NEWS_NS = 250 * _MS
"""If the link loses messages and reports name none for this long, a keyframe probes whether overdue ones are lost."""
_PROBES_NS = 1500 * _MS
"""The longest time for which such probes are sent."""
_GIVEN_UP_NS = SECOND_NS
"""A message overdue for this long is lost, if reports come and name no newer one in the same time."""
_SILENCE_NS = 2 * SECOND_NS
_PROBE_NS = SECOND_NS
"""In silence one frame is sent in this time: a ground that has forgotten the session receives nothing else."""
_START_NS, _START_HOLD_NS = SECOND_NS // 2, 8 * SECOND_NS
"""Before the first report, frames go for half a second from a keyframe on, then one in `_PROBE_NS` for eight: a thin
link that is overrun at once leaves no room to query info. A ground that never reports gets every frame after that.
So long the rate may be looked for, with video alone: a clip may end before it is found, or delays vary."""
_FORGET_NS = 15 * SECOND_NS
"""A receiver silent for this long has left, where Zenoh still has the link: its lease is shorter. Other subscribers
get video at the least rate, since behind a router the link may be gone all the same."""
_LATE_NS = 3 * SECOND_NS
"""Where all named messages have come late for this long, the path is longer than it was."""
_QUEUE_NS = SECOND_NS
"""Where two named in a row came later than this, those behind them stand in a queue that must empty first, …"""
_STALL_NS = SECOND_NS
"""… unless none of them has come for this long: they are lost."""
_MEMORY_NS = 15 * SECOND_NS
"""What was measured counts for this long."""
_MOST_RECORDS = 1024
_RESEND_NS = SECOND_NS
"""An older access unit is not sent again: a keyframe has been requested by then."""
_AGAIN_NS = 30 * _MS
"""Time beyond one and a half round trips after which a unit that was sent again counts as lost once more."""


@dataclass(frozen=True, slots=True)
class Sent:
    """One base message in flight."""

    sequence: int
    sent_ns: int
    serialization_ns: int
    """Time from its sending until a link of the present rate has carried it."""
    line_bytes: int
    up_to_bytes: int
    """Line bytes of everything sent so far, this message included."""
    messages: int
    """Messages of base and stills sent so far, this one included: reports count the lost messages of both."""
    alone: bool
    """No other base message was on its way: its round trip is the path's, and no queue's."""


class Flight:
    """The account of messages in flight. Pure: time is an argument; bounded in memory."""

    def __init__(self) -> None:
        self._base: deque[Sent] = deque(maxlen=_MOST_RECORDS)
        self._given_up: deque[Sent] = deque(maxlen=_MOST_RECORDS)
        self._stills: deque[tuple[int, int, int]] = deque(maxlen=_MOST_RECORDS)
        """(sequence, time of sending, line bytes)."""
        self._backlog_bytes = 0.0
        self._drained_ns = 0
        self._total_bytes = 0
        self._messages = 0
        self._last = (-1, -1)

    @property
    def last_base(self) -> int:
        """The sequence of the base message that went out last; -1 before the first."""
        return self._last[0]

    @property
    def oldest(self) -> Sent | None:
        return self._base[0] if self._base else None

    @property
    def next_due(self) -> Sent | None:
        """The oldest that may yet come, also where it was given up."""
        return self._given_up[0] if self._given_up else self.oldest

    @property
    def newest(self) -> Sent | None:
        return self._base[-1] if self._base else None

    @property
    def size_bytes(self) -> int:
        """Line bytes of base and stills that no report has named yet."""
        return sum(one.line_bytes for one in self._base) + sum(size for _, _, size in self._stills)

    def sent(
        self,
        line_bytes: int,
        *,
        now_ns: int,
        rate_bps: int,
        base: int | None = None,
        still: int | None = None,
    ) -> None:
        """Count a base message or a still of this sequence, or a message that no report names."""
        self._drain(now_ns, rate_bps)
        self._backlog_bytes += line_bytes
        self._total_bytes += line_bytes
        self._messages += base is not None or still is not None
        if still is not None:
            self._last = (self._last[0], still)
            self._stills.append((still, now_ns, line_bytes))
        if base is not None:
            self._last = (base, self._last[1])
            serialization_ns = self.backlog_ns(now_ns=now_ns, rate_bps=rate_bps)
            alone = self.next_due is None
            self._base.append(
                Sent(base, now_ns, serialization_ns, line_bytes, self._total_bytes, self._messages, alone)
            )

    def backlog_ns(self, *, now_ns: int, rate_bps: int) -> int:
        """The time that a link of this rate still needs for the bytes in flight."""
        self._drain(now_ns, rate_bps)
        return round(8 * SECOND_NS * self._backlog_bytes / rate_bps)

    def acknowledge(self, base_sequence: int, still_sequence: int) -> Sent | None:
        """Remove messages that have arrived; return the newest base message among them, None where there is none.

        Earlier messages have arrived too or are lost. Sequence numbers that were never sent are ignored.
        """
        if base_sequence > self._last[0] or still_sequence > self._last[1]:
            return None
        newest: Sent | None = None
        for sent in (self._given_up, self._base):
            while sent and sent[0].sequence <= base_sequence:
                newest = sent.popleft()
        latest_ns = -(2**63) if newest is None else newest.sent_ns - 2 * SECOND_NS
        while self._stills and (self._stills[0][0] <= still_sequence or self._stills[0][1] < latest_ns):
            self._stills.popleft()
        self._backlog_bytes = min(self._backlog_bytes, self.size_bytes)
        return newest

    def refill(self) -> None:
        """The link is slower than assumed: all unreported bytes still wait."""
        self._backlog_bytes = max(self._backlog_bytes, self.size_bytes)

    def give_up(self) -> None:
        """Declare messages in flight lost; a late report may still name them."""
        given_up = (*self._given_up, *self._base)
        self.clear()
        self._given_up.extend(given_up)

    def clear(self) -> None:
        self._given_up.clear()
        self._base.clear()
        self._stills.clear()
        self._backlog_bytes = 0.0

    def _drain(self, now_ns: int, rate_bps: int) -> None:
        # Two threads send, with times that may differ a little: time never goes back.
        elapsed_ns = max(0, now_ns - self._drained_ns)
        self._drained_ns = max(self._drained_ns, now_ns)
        self._backlog_bytes = max(0.0, self._backlog_bytes - rate_bps * elapsed_ns / 8 / SECOND_NS)


class BaseInFlight:
    """Access units that were sent and not acknowledged: unreported ones and missing ones; the oldest leaves first.

    Thread-safe.
    """

    def __init__(self, *, max_age_ns: int = 4 * SECOND_NS, max_bytes: int = 2 * 2**20) -> None:
        self._max_age_ns = max_age_ns
        self._max_bytes = max_bytes
        self._lock = threading.Lock()
        self._units: dict[int, tuple[int, AccessUnit]] = {}
        """Sequence → time of sending and unit, in order."""
        self._resent: dict[int, int] = {}
        """Sequence → when it was last sent again."""
        self.size_bytes = 0

    def __len__(self) -> int:
        return len(self._units)

    def sent(self, sequence: int, unit: AccessUnit, *, now_ns: int) -> None:
        with self._lock:
            self._units[sequence] = now_ns, unit
            self.size_bytes += len(unit.data)
            while self._units:
                oldest = next(iter(self._units))
                if self.size_bytes <= self._max_bytes and now_ns - self._units[oldest][0] <= self._max_age_ns:
                    break
                self._forget(oldest)

    def on_report(self, base_sequence: int, missing: Collection[int] = ()) -> bool:
        """Forget units up to this sequence but ``missing``, by the primary receiver's report; whether any were."""
        with self._lock:
            come = [one for one in self._units if one <= base_sequence and one not in missing]
            for one in come:
                self._forget(one)
            return bool(come)

    def missing(self, sequence: int, *, now_ns: int, round_trip_ns: int) -> AccessUnit | None:
        """A unit that is worth sending again; None where it is too old, or a keyframe was sent since.

        None too for a unit sent again less than about one and a half ``round_trip_ns`` ago: it may have arrived.
        """
        with self._lock:
            sent_ns, unit = self._units.get(sequence, (0, None))
            resent_ns = self._resent.get(sequence)
            on_its_way = resent_ns is not None and now_ns - resent_ns <= _AGAIN_NS + 3 * round_trip_ns // 2
            newer = (one for at, (_, one) in self._units.items() if at > sequence)
            useful = now_ns - sent_ns <= _RESEND_NS and not any(one.keyframe for one in newer)
            return unit if useful and not on_its_way else None

    def resent(self, sequence: int, *, now_ns: int) -> None:
        with self._lock:
            if sequence in self._units:
                self._resent[sequence] = now_ns

    def take(self) -> list[AccessUnit]:
        """Return and forget all units that may be lost, in order."""
        with self._lock:
            units = [unit for _, unit in self._units.values()]
            self._units.clear()
            self._resent.clear()
            self.size_bytes = 0
        return units

    def _forget(self, sequence: int) -> None:
        self.size_bytes -= len(self._units.pop(sequence)[1].data)
        self._resent.pop(sequence, None)


class Pacer:
    """Paces sending: bounds bytes in flight to the link's rate times 250 ms. Thread-safe; time is an argument.

    Only the primary receiver's reports count (`hvt_edge.link.feedback`): the pace of a ground that is itself badly
    connected must not be everybody's.
    """

    def __init__(self, controller: RateController) -> None:
        self._controller = controller
        self._flight = Flight()
        self._lock = threading.Lock()
        self._reported_ns: int | None = None
        """When the primary receiver reported last; None while there is none."""
        self._progress_ns = 0
        """When it last named a base message in flight."""
        self._held_ns = _FIRST_HELD_NS
        self._round_trip, self._return = LeastDelay(), LeastDelay()
        self.round_trip_ns = SECOND_NS // 2
        """Shortest time from sending a message to its report; half a second until one was measured."""
        self._return_ns = 0
        """Shortest travel time of a report, plus the difference of the clocks."""
        self._given_up = -1
        """The newest base message that was declared lost."""
        self._lossy = False
        """Whether overdue messages are likely lost, as they were the last time."""
        self._lost = 0
        self._probed = -1
        """The oldest message that was overdue when another was sent all the same."""
        self._doubted: int | None = None
        """The first message sent as a probe, until a report tells whether the overdue one is lost."""
        self._doubt_ns = self._open_ns = 0
        self._late_since_ns: int | None = None
        """Since when all named messages came late."""
        self._alone = LeastDelay()
        """The shortest round trip of messages sent since then, each with no other on its way."""
        self._queued = False
        """Whether the message named last came so late that it stood in a queue of more than `_QUEUE_NS`."""
        self._drain_to = -1
        """The base message that must have come, or be lost, before another frame goes."""
        self._last_sent_ns = self._last_bytes = 0
        self._linked: bool | None = None
        self._reports = True
        self._started_ns: int | None = None
        """When the first keyframe was sent since a subscriber is there."""
        self._began_ns: int | None = None
        """When the first ground that reports was there."""
        self.ignored = 0
        """Reports ignored as old, of another receiver, of one without video, or naming a message never sent."""

    @property
    def rate_bps(self) -> int:
        return self._controller.rate_bps

    @property
    def begins(self) -> bool:
        return self._controller.begins

    @property
    def most_bps(self) -> int:
        """The total that the budget allows at this rate.

        As a flight begins it is the whole: frames of the full rate, for which nobody listened, still fill its window.
        """
        return self._controller.ceiling_bps if self.begins else self._controller.rate_bps

    @property
    def steady_bps(self) -> int:
        """The rate of which x265 should be opened for a share."""
        return self._controller.steady_bps

    @property
    def measures(self) -> bool:
        return not self._round_trip.empty

    def measured_now(self, now_ns: int) -> bool:
        """Whether round trip and rate are current: without reports, or frames for them to name, they are not."""
        with self._lock:
            reports = self._reported_ns is not None and now_ns - self._reported_ns <= _SILENCE_NS
            return self.measures and reports and now_ns - self._progress_ns <= _MEMORY_NS

    @property
    def at_ceiling(self) -> bool:
        return self._controller.at_ceiling

    @property
    def backoffs(self) -> int:
        return self._controller.backoffs

    def set_ceiling(self, ceiling_bps: int, *, floor_bps: int | None = None) -> None:
        """Set another ``--budget`` while running; ``floor_bps`` is the ``--min-budget`` that belongs to it."""
        with self._lock:
            self._controller.set_ceiling(ceiling_bps, floor_bps=floor_bps)

    # Sending

    def sent_base(self, sequence: int, line_bytes: int, *, now_ns: int, keyframe: bool = False) -> None:
        with self._lock:
            self._last_sent_ns, self._last_bytes = now_ns, line_bytes
            if keyframe and self._started_ns is None:
                self._started_ns = now_ns
            if self._overdue_ns(now_ns) > self._slack_ns and self._flight.oldest is not None:
                self._probed = self._flight.oldest.sequence
                if self._doubted is None:
                    self._doubted, self._doubt_ns = sequence, now_ns
            self._flight.sent(line_bytes, now_ns=now_ns, rate_bps=self.rate_bps, base=sequence)

    def sent_still(self, sequence: int, line_bytes: int, *, now_ns: int) -> None:
        with self._lock:
            self._flight.sent(line_bytes, now_ns=now_ns, rate_bps=self.rate_bps, still=sequence)

    def sent_other(self, line_bytes: int, *, now_ns: int) -> None:
        """Count status, tracks or a still that is sent again: no report names them."""
        with self._lock:
            self._flight.sent(line_bytes, now_ns=now_ns, rate_bps=self.rate_bps)

    # Reports

    def on_report(self, report: Report) -> None:
        feedback, now_ns = report.feedback, report.now_ns
        with self._lock:
            # A ground without video says nothing of its link, also where the only video receiver never reports.
            video = self._linked is not False and (self._reports or feedback.base_sequence >= 0)
            if not (report.primary and video):
                self.ignored += 1
                return
            if report.first:
                self._forget_path()
                self._progress_ns = now_ns
            silent = self._reported_ns is not None and now_ns - self._reported_ns > _SILENCE_NS
            self._reported_ns = now_ns
            self._note_losses(feedback, now_ns)
            oldest = self._flight.oldest
            sent = self._flight.acknowledge(feedback.base_sequence, feedback.still_sequence)
            given_up = self._given_up
            if silent:
                self._give_up_all()
            if sent is None:
                return
            self._progress_ns = now_ns
            return_ns, held_ns = now_ns - feedback.send_ns, 1000 * feedback.base_held_us
            late_back_ns = 0 if self._return.empty else max(0, return_ns - self._return_ns)
            queued_before = self._queued
            self._queued = self._late_ns(sent, now_ns) - held_ns - late_back_ns > _QUEUE_NS
            if self._queued and queued_before:
                self._drain_to = self._flight.last_base
            if sent.sequence <= given_up and not self._take_longer(sent, return_ns, now_ns):
                return
            self._note_late(sent, oldest or sent, held_ns, now_ns)
            # The oldest message that this report names has waited for it since the report before.
            self._note_times(
                sent, held_ns + max(0, sent.sent_ns - (oldest or sent).sent_ns), return_ns, now_ns
            )
            backoffs = self.backoffs
            self._controller.on_progress(
                Progress(
                    now_ns=now_ns,
                    sent_ns=sent.sent_ns,
                    arrived_ns=feedback.send_ns - held_ns,
                    serialization_ns=sent.serialization_ns,
                    arrived_bytes=sent.up_to_bytes,
                    delivery_bps=8e9 * sent.line_bytes / max(1, now_ns - sent.sent_ns - held_ns),
                    messages=sent.messages,
                    lost=feedback.lost_so_far,
                )
            )
            if self.backoffs > backoffs:
                self._flight.refill()

    def on_fault(self, now_ns: int) -> None:
        """Handle an invalid report: the messages in flight are unknown, so the rate falls to the least."""
        with self._lock:
            self._controller.on_silence(now_ns)
            self._flight.clear()
            self._reported_ns = self._progress_ns = now_ns

    def link(self, there: bool, *, now_ns: int, reports: bool = True) -> bool:  # noqa: FBT001 - the news itself
        """Note whether any subscriber can be reached. ``reports``: whether one of them is a ground that reports.

        True where the link has just come back, or messages in flight seem lost: the video needs a keyframe to go on.
        """
        with self._lock:
            before, self._linked, self._reports = self._linked, there, reports
            if there and not before:
                self._started_ns, self._progress_ns = None, now_ns
            if there and reports and self._began_ns is None:
                self._began_ns = now_ns
                self._controller.begin()
            if self._began_ns is not None and now_ns - self._began_ns >= _START_HOLD_NS:
                self._controller.settle()
            if before and not there:
                self._flight.clear()
                if self._reported_ns is not None:
                    self._controller.on_silence(now_ns)
                self._leave()
            reported_ns = self._reported_ns if there else None
            lost = reported_ns is not None and (self._give_up(now_ns, reported_ns) or self._probes(now_ns))
            return lost or (before is False and there and self.backoffs > 0)

    # Admission

    def admits_base(self, now_ns: int, *, coding_ns: int = 0) -> bool:
        """Whether a frame may be encoded now, and sent ``coding_ns`` later."""
        with self._lock:
            # Stored frames have the former rate: they would delay live video when the link is back.
            carries_ns = 8 * SECOND_NS * self._last_bytes // self.rate_bps
            probes = now_ns - self._last_sent_ns >= max(_PROBE_NS, carries_ns)
            if self._reported_ns is None:
                return self._may_start(now_ns) or probes
            if now_ns - self._reported_ns > _FORGET_NS and self._linked:
                self._leave()
                return True
            self._give_up(now_ns, self._reported_ns)
            if now_ns - self._reported_ns > _SILENCE_NS:
                return probes
            return self._is_open(now_ns, _MOST_BACKLOG_NS + coding_ns) or self._probes(now_ns)

    def holds(self, now_ns: int) -> bool:
        """Whether the link, and not the budget's own rate, leaves no room for a frame now."""
        with self._lock:
            if self._reported_ns is None:
                return not self._may_start(now_ns)
            silent = now_ns - self._reported_ns > _SILENCE_NS
            return silent or not self.at_ceiling or self._overdue_ns(now_ns) > self._slack_ns

    def admits_still(self, now_ns: int) -> bool:
        with self._lock:
            if self.begins:
                return False  # on a thin link stills would fill the queue
            if self._reported_ns is None:
                return self._may_start(now_ns)
            return now_ns - self._reported_ns <= _SILENCE_NS and self._is_open(now_ns, _STILL_BACKLOG_NS)

    def _give_up(self, now_ns: int, reported_ns: int) -> bool:
        # Falls to the least rate where no report comes, or none names a message; True where these are declared lost.
        if now_ns - reported_ns > _SILENCE_NS:
            self._controller.on_silence(now_ns)
            return False
        if min(self._overdue_ns(now_ns), now_ns - self._progress_ns) <= _GIVEN_UP_NS:
            return False
        self._controller.on_silence(now_ns)
        self._give_up_all()
        return True

    def _give_up_all(self) -> None:
        self._given_up = self._flight.last_base
        self._flight.give_up()

    def _may_start(self, now_ns: int) -> bool:
        if not self._linked or not self._reports or self._started_ns is None:
            return True  # nothing is known, nothing is sent, or no ground will report arrivals
        return not _START_NS <= now_ns - self._started_ns < _START_NS + _START_HOLD_NS

    def _is_open(self, now_ns: int, most_backlog_ns: int) -> bool:
        due = self._flight.next_due
        if due is not None and due.sequence <= self._drain_to and now_ns - self._progress_ns <= _STALL_NS:
            return False
        backlog_ns = self._flight.backlog_ns(now_ns=now_ns, rate_bps=self.rate_bps)
        return backlog_ns <= most_backlog_ns and self._overdue_ns(now_ns) <= self._slack_ns

    def _note_losses(self, feedback: Feedback, now_ns: int) -> None:
        # An overdue message that still came was late: it stood in a queue, and further probes would lengthen that.
        lost = feedback.lost_so_far
        if lost != self._lost:
            self._lossy, self._lost = lost > self._lost, lost
            self._doubted = None
        elif self._doubted is None or feedback.base_sequence < self._doubted:
            self._open_ns = now_ns
        elif now_ns - self._open_ns > _NO_NEWS_NS:  # by now the receiver has given up missing messages
            self._lossy = False
            self._doubted = None

    def _probes(self, now_ns: int) -> bool:
        # Whether a keyframe is sent although a message is overdue: if all in flight were lost no report can say so,
        # since none arrives for it to name. The next is sent when that keyframe is overdue, too.
        oldest, newest = self._flight.oldest, self._flight.newest
        # Messages held up in a queue would have to wait behind all of the probes.
        armed = self._lossy and (self._doubted is None or now_ns - self._doubt_ns < _PROBES_NS)
        if not armed or oldest is None or newest is None or self._overdue_ns(now_ns) <= self._slack_ns:
            return False
        if oldest.sequence == self._probed:
            return self._late_ns(newest, now_ns) > self._slack_ns
        return now_ns - self._progress_ns > _NO_NEWS_NS

    @property
    def _slack_ns(self) -> int:
        return _SLACK_NS + self._held_ns

    def _overdue_ns(self, now_ns: int) -> int:
        oldest = self._flight.oldest
        return 0 if oldest is None else self._late_ns(oldest, now_ns)

    def _late_ns(self, sent: Sent, now_ns: int) -> int:
        return now_ns - sent.sent_ns - sent.serialization_ns - self.round_trip_ns

    def _leave(self) -> None:
        self._reported_ns = None
        self._forget_path()

    def _forget_path(self) -> None:
        self._held_ns = _FIRST_HELD_NS
        self._round_trip, self._return = LeastDelay(), LeastDelay()
        self.round_trip_ns, self._drain_to = SECOND_NS // 2, -1
        self._controller.forget_path()

    def _take_longer(self, sent: Sent, return_ns: int, now_ns: int) -> bool:
        # Whether reports take longer than before, if one names a message declared lost; else that stood in a queue.
        longer_ns = 0 if self._return.empty else return_ns - self._return_ns
        if longer_ns <= 0:
            return False
        round_trip_ns = min(now_ns - sent.sent_ns, self.round_trip_ns + longer_ns)
        self._round_trip, self._return = LeastDelay(), LeastDelay()
        self._round_trip.add(round_trip_ns, now_ns=now_ns)
        return True

    def _note_late(self, sent: Sent, oldest: Sent, held_ns: int, now_ns: int) -> None:
        # The rate falls at once, and the queue with it: if messages stay late after that, also one that was sent
        # when no other was on its way, the path is longer.
        if self._late_ns(sent, now_ns) - held_ns <= _SLACK_NS:
            self._late_since_ns = None
        elif self._late_since_ns is None:
            self._late_since_ns, self._alone = now_ns, LeastDelay()
        elif oldest.sent_ns >= self._late_since_ns:
            if oldest.alone:
                self._alone.add(now_ns - oldest.sent_ns, now_ns=now_ns)
            if now_ns - self._late_since_ns < _LATE_NS:
                return
            if self._alone.empty:
                self._drain_to = self._flight.last_base
            else:
                self._round_trip, self._late_since_ns = self._alone, None

    def _note_times(self, sent: Sent, held_ns: int, return_ns: int, now_ns: int) -> None:
        # Rises quickly and falls slowly: the estimate is the longest of the usual times.
        held_ns = min(max(held_ns, _LEAST_HELD_NS), _MOST_HELD_NS)
        self._held_ns = max((9 * self._held_ns + held_ns) // 10, min(held_ns, 2 * self._held_ns))
        self.round_trip_ns = self._round_trip.add(max(0, now_ns - sent.sent_ns), now_ns=now_ns)
        self._return_ns = self._return.add(return_ns, now_ns=now_ns)
