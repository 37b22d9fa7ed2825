"""The rate that the link carries, from receiver reports: a delay-based controller of the SCReAM and GCC family. Pure.

The signal is queueing delay (RFC 8298, section 4.1.2; RFC 6817): one-way delay above the recent minimum, so the
two clocks need not agree. The controller subtracts the delay that the edge's own messages would have had on a link of
exactly the present rate (`Progress.serialization_ns`): a keyframe or a burst is no congestion. The rest, the
**excess**, grows exactly where the link is slower than the rate. It is overuse where it stays high and does not
fall over several reports (as in CoDel, a burst empties, a standing queue does not). Then the rate becomes a share
of the arrival rate meanwhile, which is the link's capacity. Messages sent before that say nothing about the new rate
and are not judged: the hold-off lasts a round trip and the emptying of the queue, however long these are.

A delay that stays high but is the same for small and large messages is no queue's: the route has become longer, and
its new delay is the least from then on.

Growth follows a cubic curve (RFC 9438, section 4.2, in time): quickly back to the rate of the last breakdown, long
near it, then faster and faster beyond. So a link of constant rate sees a rate close to its own, and the rate of a
link that has come back is found again in some seconds.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from hvt_common.units import SECOND_NS

_MS = 1_000_000
_ABSURD_NS = 60 * SECOND_NS
"""A delay that changes by this much shows a clock that was set, not a queue."""
_MTU_BITS = 12_000
_SOME_LOSS = 0.02
_GRAVE, _GRAVE_SPAN_NS = 2.5, 150 * _MS
_LOSS_EVERY_NS = 3 * SECOND_NS
"""Least time between two falls for the same loss: a lower rate takes effect late."""
_FEW_MESSAGES, _LOSS_MESSAGES = 20, 100
"""Loss among fewer messages than the first says nothing; from the second on its share is used as measured."""
_LOSS_DEVIATIONS = 2.0
_MUCH_LESS, _MUCH_MORE = 0.8, 1.25
"""x265 is opened anew at once where the wanted rate is below or above these multiples of the base's."""
_SOME_OFF, _SOME_NS = 0.08, 3 * SECOND_NS
"""A difference of this share leads to a new opening after this time."""
_LITTLE_OFF = 0.02
"""The share that replaces it at the ceiling, where the rate will stay."""
_REST_NS = 1_500 * _MS
"""Least time between two openings; a third of it where the rate is higher by `_FAR_MORE`: it grows in steps."""
_FAR_MORE = 1.5
_EXCESS_NS = 80 * _MS
"""Overuse begins here; on thin links at two large packets."""
_VERDICT_NS, _VERDICT_REPORTS = 300 * _MS, 3
"""The excess must stay high for this time, and over so many reports."""
_BACKOFF = 0.85
"""Factor on the arrival rate after overuse."""
_PLATEAU_NS = 2_600 * _MS
"""Time of the growth back to the rate of the last breakdown."""
_BEYOND_PER_S3 = 0.008
"""Growth beyond it, as a share of that rate, by the third power of the seconds."""
_BEGIN_SHARE = 4
"""A flight begins at this part of the ceiling: a smaller one delays a thin link less, and all others show it."""
_BEGIN_NS = SECOND_NS
"""Time of the growth from there to the ceiling, on a good link: each flight begins with the poorer pictures."""
_LEAST_STEP = 1.05
"""Growth with each report then, however little there is to send: a dark scene or few stills prove no rate."""
_SUSTAINED = 0.9
"""Messages that came no more slowly than this part of the pace at which they were sent found no queue."""
_OUTRUN = 0.7
"""Below this part of the pace they fill a queue: a flight that begins has found the link's rate."""
_RESUME_NS = 3 * SECOND_NS
"""Time of the growth back to the former rate after the link was gone."""
_MOST_LOSS = 0.12
"""Share of lost messages; less counts as the link's nature, and only slows growth down."""
_MEMORY_NS = 15 * SECOND_NS
"""Window of the least delay: a route that became longer does not count as a queue for ever."""
_ROUTE_NS, _ROUTE_REPORTS = 2 * SECOND_NS, 8
"""A delay that was high for this time, over so many reports, is that of a longer route, …"""
_SAME_NS, _VARIED_NS = 20 * _MS, 40 * _MS
"""… if it varied no more than the first, and a queue's would have varied more than the second."""
_ROUTE_FALL = 4
"""After it the rate goes on at this part of the rate before."""


@dataclass(frozen=True, slots=True)
class Progress:
    """One report of the newest base message that has arrived, in the edge's own counts."""

    now_ns: int
    """When the report came, by the edge's clock."""
    sent_ns: int
    """When the message was sent, by the edge's clock."""
    arrived_ns: int
    """When it arrived, by the ground's clock."""
    serialization_ns: int
    """Its delay on a link of the rate of that time, behind the edge's own messages."""
    arrived_bytes: int
    """Line bytes sent up to this message, itself included: they have all arrived, or are lost."""
    delivery_bps: float = 0.0
    """Its own line bits over its round trip, without the time for which the ground held the report: a slower link
    would have needed longer."""
    messages: int = 0
    """Messages of base and stills sent up to this one, itself included."""
    lost: int = 0
    """The lost ones among them, by the ground's count."""


class LeastDelay:
    """The least of the last ``memory_ns`` to twice that long, in constant memory."""

    def __init__(self, memory_ns: int = _MEMORY_NS) -> None:
        self._memory_ns = memory_ns
        self._since_ns: int | None = None
        self._former: int | None = None
        self._least: int | None = None

    def add(self, delay_ns: int, *, now_ns: int) -> int:
        if self._since_ns is None or now_ns - self._since_ns >= self._memory_ns:
            self._former, self._least, self._since_ns = self._least, None, now_ns
        self._least = delay_ns if self._least is None else min(self._least, delay_ns)
        return self._least if self._former is None else min(self._former, self._least)

    @property
    def empty(self) -> bool:
        return self._since_ns is None


class LossCount:
    """Tells whether more than `_MOST_LOSS` of the newest messages are lost, at any frame rate.

    It counts messages, not seconds: the newest 100, however long these took. For 100 the share is used as measured.
    For 20 to 99, two standard deviations of the binomial distribution more must be lost than a link of just
    that share would lose; at 12 % that means 6 of 20, or 11 of 50. Fewer than 20 say nothing.
    """

    def __init__(self) -> None:
        self._counts: deque[tuple[int, int]] = deque()
        """(messages, lost of them) by report."""
        self._marked: tuple[int, int] | None = None
        """The counts when the rate last fell for loss."""

    def add(self, messages: int, lost: int) -> None:
        """Add the counts of one report, both since the beginning."""
        self._counts.append((messages, lost))
        while len(self._counts) > 1 and messages - self._counts[1][0] >= _LOSS_MESSAGES:
            self._counts.popleft()
        marked = self._marked
        if marked is not None and self._beyond(marked) < 0:  # the lower rate has helped, or the loss is over
            self._marked = None
            while self._counts[0][0] < marked[0]:
                self._counts.popleft()

    def exceeds(self) -> bool:
        return bool(self._counts) and self._beyond(self._counts[0]) > 0

    def lasts(self) -> bool:
        """Whether the share lost since `mark`, as measured, is too high."""
        return self._marked is None or self._share_since(self._marked) > _MOST_LOSS

    def mark(self) -> None:
        self._marked = self._counts[-1]

    def clear(self) -> None:
        """Forget earlier losses: from now on they are no property of the link."""
        self._counts.clear()
        self._marked = None

    @property
    def share(self) -> float:
        """Share of the newest messages that are lost, 0…1; 0 where there are too few messages."""
        few = not self._counts or self._since(self._counts[0])[0] < _FEW_MESSAGES
        return 0.0 if few else self._share_since(self._counts[0])

    def _since(self, first: tuple[int, int]) -> tuple[int, int]:
        messages, lost = self._counts[-1]
        return messages - first[0], min(messages - first[0], max(0, lost - first[1]))

    def _share_since(self, first: tuple[int, int]) -> float:
        messages, lost = self._since(first)
        return lost / messages if messages else 0.0

    def _beyond(self, first: tuple[int, int]) -> int:
        # 1 where surely more than the share was lost since then, -1 where surely less, 0 where nobody can tell.
        messages, lost = self._since(first)
        if messages < _FEW_MESSAGES:
            return 0
        doubt = 0.0
        if messages < _LOSS_MESSAGES:
            doubt = _LOSS_DEVIATIONS * math.sqrt(_MOST_LOSS * (1 - _MOST_LOSS) * messages)
        more = lost - _MOST_LOSS * messages
        return (more > doubt) - (more < -doubt)


class RateController:
    """Controls the rate between floor and ceiling, line bits a second. Deterministic; not thread-safe."""

    def __init__(self, *, ceiling_bps: int, floor_bps: int) -> None:
        assert 0 < floor_bps <= ceiling_bps
        self.ceiling_bps, self._floor_bps = ceiling_bps, floor_bps
        self._rate = float(ceiling_bps)
        self._least = LeastDelay()
        self._base_ns: int | None = None
        self._recent: deque[tuple[Progress, int]] = deque(maxlen=64)
        """Reports that were judged, and their excess (ns)."""
        self._former_bps = self._rate
        """The rate from which it fell, before it was on its way back."""
        self._judge_from_ns = -(2**63)
        """Only messages sent after this time say something about the present rate."""
        self._cubic_max = self._low = float(ceiling_bps)
        self._plateau_ns = _PLATEAU_NS
        self._curve_ns = 2**62
        """Time along the curve of growth; only time without signs of congestion counts."""
        self._last_ns: int | None = None
        self._silent = False
        self._losses = LossCount()
        self._next_loss_ns = 0
        self.backoffs = 0
        """How often the rate was lowered."""

    @property
    def rate_bps(self) -> int:
        return round(min(self.ceiling_bps, max(self._floor_bps, self._rate)))

    @property
    def steady_bps(self) -> int:
        """The rate that is likely to last, for slow followers: near the last breakdown, a little below it."""
        if self.at_ceiling or self.begins or self._rate > 1.15 * self._cubic_max:
            return self.rate_bps
        return min(self.rate_bps, max(self._floor_bps, round(0.9 * self._cubic_max)))

    @property
    def at_ceiling(self) -> bool:
        return self._rate >= self.ceiling_bps

    def set_ceiling(self, ceiling_bps: int, *, floor_bps: int | None = None) -> None:
        """Set another ceiling. A rate at the old ceiling moves to the new one; a lower rate grows as before."""
        if self.at_ceiling or self._rate > ceiling_bps:
            self._rate = self._cubic_max = float(ceiling_bps)
        elif self._cubic_max >= self.ceiling_bps:
            self._cubic_max = float(ceiling_bps)
        self._floor_bps = min(ceiling_bps, self._floor_bps if floor_bps is None else floor_bps)
        self.ceiling_bps = ceiling_bps

    def on_progress(self, progress: Progress) -> None:
        """Process one report that names a message for the first time."""
        # Bounded: a report after a long pause must not make the rate leap.
        step_ns = 0 if self._last_ns is None else min(max(0, progress.now_ns - self._last_ns), 500 * _MS)
        self._last_ns = progress.now_ns
        excess_ns = self._excess(progress)
        if progress.sent_ns < self._judge_from_ns:
            return
        self._silent = False
        self._recent.append((progress, excess_ns))
        self._losses.add(progress.messages, progress.lost)
        limit_ns = self._limit_ns()
        pace, arriving_bps = self._lately() or (1.0, 0.0)
        if self.begins and pace < _OUTRUN:
            self._back_off(progress, _BACKOFF * min(self._rate, arriving_bps))
        elif excess_ns >= limit_ns // 2 and self._is_longer_route():
            self._take_longer_route()
        elif self._overused(limit_ns) and self._rate > self._floor_bps:
            self._back_off(progress, _BACKOFF * min(self._rate, self._arriving_bps()))
        elif self._losses.exceeds():
            if progress.now_ns >= self._next_loss_ns and self._losses.lasts():
                self._next_loss_ns = progress.now_ns + _LOSS_EVERY_NS
                self._losses.mark()
                self._back_off(progress, self._rate * (1 - self._losses.share / 2))
        elif excess_ns < limit_ns // 2:
            self._grow(step_ns // 2 if self._losses.share > _SOME_LOSS else step_ns)

    @property
    def begins(self) -> bool:
        """It is on its way up from `begin`, and nothing has held it yet."""
        return self._plateau_ns == _BEGIN_NS and self._curve_ns < _BEGIN_NS and not self.at_ceiling

    def begin(self) -> None:
        """Nothing is known of the link: the rate begins low, and nears the former one as fast as messages come."""
        lowest = max(self._floor_bps, self.ceiling_bps / _BEGIN_SHARE)
        self._climb_from(min(self._rate, lowest), plateau_ns=_BEGIN_NS)

    def settle(self) -> None:
        """It has begun long enough: a ground that never reports gets the ceiling, others a growth like any other."""
        if self.begins and self._last_ns is None:
            self._rate = float(self.ceiling_bps)
        elif self.begins:
            self._plateau_ns = _RESUME_NS

    def on_silence(self, now_ns: int) -> None:
        """Reports have stopped: the rate falls to the floor. When they return it nears the former rate quickly."""
        if not self._silent:
            self._silent = True
            if self._curve_ns >= self._plateau_ns:  # else it is still on its way back
                self._cubic_max = self._rate
            self._climb_from(self._floor_bps, plateau_ns=_RESUME_NS)
            self.backoffs += 1
            self._losses.clear()  # losses while a link is away are no property of it
            self._start_over(now_ns)
        self._last_ns = now_ns

    def _climb_from(self, rate: float, *, plateau_ns: int) -> None:
        self._rate = self._low = float(rate)
        self._curve_ns, self._plateau_ns = 0, plateau_ns

    def forget_path(self) -> None:
        """The receiver or the transport has changed: earlier delays say nothing."""
        self._least = LeastDelay()
        self._recent.clear()
        self._losses.clear()

    def _excess(self, progress: Progress) -> int:
        delay_ns = progress.arrived_ns - progress.sent_ns
        if self._base_ns is not None and abs(delay_ns - self._base_ns) > _ABSURD_NS:
            self.forget_path()
        self._base_ns = self._least.add(delay_ns, now_ns=progress.now_ns)
        return delay_ns - self._base_ns - progress.serialization_ns

    def _limit_ns(self) -> int:
        return max(_EXCESS_NS, round(2 * _MTU_BITS * SECOND_NS / self._rate))

    def _verdict(self) -> list[tuple[Progress, int]]:
        # The newest judged reports, as few as suffice for a verdict; empty where there are too few.
        chosen: list[tuple[Progress, int]] = []
        for one, excess_ns in reversed(self._recent):
            chosen.insert(0, (one, excess_ns))
            span_ns = chosen[-1][0].arrived_ns - one.arrived_ns
            if len(chosen) >= _VERDICT_REPORTS and span_ns >= _VERDICT_NS:
                return chosen
            # Where the link has fallen far, few messages arrive and each is later than the last: two of them suffice.
            if len(chosen) == 2 and span_ns >= _GRAVE_SPAN_NS and excess_ns > _GRAVE * self._limit_ns():
                return chosen
        return []

    def _overused(self, limit_ns: int) -> bool:
        excesses_ns = [excess_ns for _, excess_ns in self._verdict()]
        if min(excesses_ns, default=0) <= limit_ns:
            return False
        return excesses_ns[-1] >= excesses_ns[0] - limit_ns // 4  # else the queue empties: wait

    def _is_longer_route(self) -> bool:
        # Behind a queue, each message waits for those before it. A delay that is the same for small and large ones,
        # and stays as it is at a lower rate, is the route's.
        newest = self._recent[-1][0]
        delays_ns, queued_ns = [], []
        for one, _ in reversed(self._recent):
            delays_ns.append(one.arrived_ns - one.sent_ns)
            queued_ns.append(one.serialization_ns)
            if max(delays_ns) - min(delays_ns) > _SAME_NS:
                return False
            if len(delays_ns) >= _ROUTE_REPORTS and newest.arrived_ns - one.arrived_ns >= _ROUTE_NS:
                return max(queued_ns) - min(queued_ns) >= _VARIED_NS
        return False

    def _take_longer_route(self) -> None:
        # Its delay is the least from now on; the former rate is found again as after a silence. The little that is
        # sent meanwhile would prove a higher rate but slowly.
        self.forget_path()
        self._cubic_max = max(self._rate, self._former_bps)
        self._climb_from(max(self._rate, self._former_bps / _ROUTE_FALL), plateau_ns=_RESUME_NS)

    def _arriving_bps(self) -> float:
        # The arrival rate while the queue stood: the link's capacity.
        chosen = self._verdict() or list(self._recent)
        return _arrival_bps(chosen[0][0], chosen[-1][0]) or self._rate

    def _back_off(self, progress: Progress, rate: float) -> None:
        broke_bps = min(self._rate, self._arriving_bps())
        if self._curve_ns >= self._plateau_ns:
            self._former_bps = self._rate
        again = 0.85 * self._cubic_max < broke_bps < 1.15 * self._cubic_max
        self._rate = max(rate, self._rate / 10, self._floor_bps)
        self._cubic_max, self._low, self._curve_ns = max(self._rate, broke_bps), self._rate, 0
        # At a link that breaks down at the same rate again and again growth is slower.
        self._plateau_ns = min(2 * _PLATEAU_NS, self._plateau_ns * 13 // 10) if again else _PLATEAU_NS
        self.backoffs += 1
        self._start_over(progress.now_ns)

    def _start_over(self, now_ns: int) -> None:
        self._judge_from_ns = now_ns
        self._recent.clear()

    def _grow(self, step_ns: int) -> None:
        if self.at_ceiling:
            self._rate = float(self.ceiling_bps)
            return
        curve_ns = self._curve_ns + step_ns
        wanted = self._on_curve(curve_ns)
        # The rate stays near the measured arrival rate: where little is sent, it does not run away. After a silence
        # little is sent, however good the link: on the way back one message that came quickly is enough.
        proven = max(self._lately_proven_bps(), min(self._cubic_max, self._delivery_bps()))
        if wanted <= proven:
            self._curve_ns = curve_ns
        self._rate = min(float(self.ceiling_bps), max(self._rate, min(wanted, proven)))

    def _on_curve(self, curve_ns: int) -> float:
        if curve_ns < self._plateau_ns:
            left = 1 - curve_ns / self._plateau_ns
            return self._cubic_max - (self._cubic_max - self._low) * left**3
        beyond_s = (curve_ns - self._plateau_ns) / SECOND_NS
        return self._cubic_max * (1 + _BEYOND_PER_S3 * beyond_s**3)

    def _delivery_bps(self) -> float:
        # The highest rate that one message of about the last second has proved.
        last_ns = self._recent[-1][0].arrived_ns
        return max(one.delivery_bps for one, _ in self._recent if last_ns - one.arrived_ns <= SECOND_NS)

    def _lately(self) -> tuple[float, float] | None:
        # Of the reports of about the last second: the speed at which messages came over that at which they were
        # sent, and their arrival rate; None after less than half a second.
        last = first = self._recent[-1][0]
        for first, _ in reversed(self._recent):
            if last.arrived_ns - first.arrived_ns >= SECOND_NS:
                break
        span_ns = last.arrived_ns - first.arrived_ns
        if span_ns < SECOND_NS // 2:
            return None
        # A keyframe behind a small frame comes later by its own length, which is no queue.
        longer_ns = max(0, last.serialization_ns - first.serialization_ns)
        return (last.sent_ns - first.sent_ns + longer_ns) / span_ns, _arrival_bps(first, last)

    def _lately_proven_bps(self) -> float:
        # A multiple of the arrival rate of about the last second; the present rate if that is not known yet.
        lately = self._lately()
        if lately is None:
            return self._rate
        pace, arrival_bps = lately
        if self._plateau_ns not in (_BEGIN_NS, _RESUME_NS) or self._curve_ns >= self._plateau_ns:
            return 2 * arrival_bps
        # On the way up the least delay may itself be that of a queue, and show no excess.
        if pace < _SUSTAINED:
            return arrival_bps
        return max(3 * arrival_bps, _LEAST_STEP * self._rate if self.begins else 0)


def _arrival_bps(first: Progress, last: Progress) -> float:
    # Line bits a second that arrived after the first and up to the last; 0 where no time passed.
    span_ns = last.arrived_ns - first.arrived_ns
    return 0.0 if span_ns <= 0 else 8e9 * max(0, last.arrived_bytes - first.arrived_bytes) / span_ns


class ReconfigurationTrigger:
    """Tells whether it is worth a keyframe to open x265 at another rate. Time is an argument.

    Until then a base stream that is too fast takes bits from the stills, and then drops frames.
    """

    def __init__(self) -> None:
        self._done_ns: int | None = None
        self._off_ns: int | None = None

    def wants(self, wanted_bps: float, base_bps: float, *, at_ceiling: bool, now_ns: int) -> bool:
        """``base_bps`` is the rate of the open x265; ``at_ceiling``: the wanted rate is the one that will stay."""
        ratio = wanted_bps / base_bps
        if abs(ratio - 1) <= (_LITTLE_OFF if at_ceiling else _SOME_OFF):
            self._off_ns = None
            return False
        self._off_ns = now_ns if self._off_ns is None else self._off_ns
        rest_ns = _REST_NS if ratio < _FAR_MORE else _REST_NS // 3
        if self._done_ns is not None and now_ns - self._done_ns < rest_ns:
            return False
        much = not _MUCH_LESS < ratio < _MUCH_MORE
        return much or now_ns - self._off_ns >= _SOME_NS

    def done(self, now_ns: int) -> None:
        self._done_ns, self._off_ns = now_ns, None
