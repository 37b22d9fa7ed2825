"""Keyframes on a link that loses messages: the edge's plan, the ground's reassembler, a round trip between."""

import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import pytest

from hvt_common.protocol.messages import Flags
from hvt_common.values import AccessUnit
from hvt_edge.link.pacer import BaseInFlight
from hvt_edge.operating import Keyframes, KeyframeSettings
from hvt_ground.link.reassemble import Arrival, Reassembler
from rigs.messages import UnitHeader

MS = 1_000_000
FRAME_NS = 66_666_667
STEP_NS = 10 * MS
REPORT_NS = 150 * MS
NIGHTLY = partial(pytest.param, marks=pytest.mark.nightly)


class Ground:
    """One receiver behind a loss of its own."""

    def __init__(self, number: int, *, loss: float, seed: int, way_ns: int) -> None:
        self.way_ns, self.number, self.loss = way_ns, number, loss
        self.random = random.Random(f"{seed}-{number}")
        self.reassembler: Reassembler = Reassembler()
        self.air: list[tuple[int, UnitHeader]] = []
        self.asked: set[int] = set()
        self.shown_ns: list[int] = []
        self.seen: set[int] = set()

    def send(self, header: UnitHeader, now_ns: int) -> None:
        if header.sequence == 0 or self.random.random() >= self.loss:
            self.air.append((now_ns + self.way_ns, header))

    def step(self, now_ns: int) -> bool:
        """Take in what has come; whether to ask for a keyframe."""
        while self.air and self.air[0][0] <= now_ns:
            self._show(self.reassembler.accept(self.air.pop(0)[1], b"", now_ns=now_ns), now_ns)
        if self.reassembler.repair.round_trip_ns is not None:
            self._show(self.reassembler.overdue(now_ns=now_ns), now_ns)
        if wants := self.reassembler.wants_keyframe(now_ns):
            self.reassembler.keyframe_requested(now_ns)
        return wants

    def _show(self, units: list[Arrival], now_ns: int) -> None:
        for unit in units:
            if unit.verdict == "decode":
                self.shown_ns.append(now_ns)
                self.seen.add(unit.header.sequence)

    def missing(self, now_ns: int) -> tuple[int, ...]:
        """What a report names: one goes at once for what is new."""
        missing = self.reassembler.missing
        if now_ns % REPORT_NS and self.asked.issuperset(missing):
            return ()
        self.asked.update(missing)
        return missing


@dataclass
class Minute:
    """Sixty seconds at 15 fps; each ground has losses of its own. ``takes_ms``: of the budget, for a keyframe.

    ``resends``: what the first ground misses is sent once more.
    """

    settings: KeyframeSettings
    loss: float = 0.05
    grounds: int = 1
    reports: bool = True
    takes_ms: int = 160
    seed: int = 1
    way_ms: int = 50
    refused: int = 0
    resends: bool = False

    def __post_init__(self) -> None:
        self.requests = Keyframes(self.settings)
        self.requests.note_round_trip(2 * self.way_ms * MS)
        way_ns = self.way_ms * MS
        self.sees = [
            Ground(number, loss=self.loss, seed=self.seed, way_ns=way_ns) for number in range(self.grounds)
        ]
        self.in_flight = BaseInFlight()
        self.sees[0].reassembler.repair.round_trip_ns = 2 * way_ns if self.resends else None
        asks: list[tuple[int, Callable[[int], None]]] = []
        self.sent = self.resent = next_ns = 0
        for now_ns in range(0, 60_000 * MS, STEP_NS):
            while asks and asks[0][0] <= now_ns:
                asks.pop(0)[1](now_ns)
            if now_ns >= next_ns:
                next_ns += FRAME_NS
                self._frame(now_ns)
            asks += [(now_ns + way_ns, ask) for ground in self.sees for ask in self._asks(ground, now_ns)]

    def _asks(self, ground: Ground, now_ns: int) -> Iterator[Callable[[int], None]]:
        wants = ground.step(now_ns)
        if self.reports and (wants or now_ns % REPORT_NS == 0):
            told = ground.number, ground.reassembler.counters.lost
            yield lambda _now_ns: self.requests.report_losses(*told)
        if wants:
            yield self._request
        if self.resends and ground.number == 0:
            yield partial(self._resend, ground.missing(now_ns))

    def _request(self, now_ns: int) -> None:
        self.refused += self.requests.request(now_ns) is not None

    def _frame(self, now_ns: int) -> None:
        keyframe = self.requests.now(now_ns, fits=True)
        if keyframe:
            self.requests.done(now_ns)
            self.requests.note_cost(self.takes_ms * MS)
        header = UnitHeader(1, self.sent, self.sent, keyframe)
        self.in_flight.sent(self.sent, AccessUnit(self.sent, now_ns, b"", keyframe=keyframe), now_ns=now_ns)
        self.sent += 1
        for ground in self.sees:
            ground.send(header, now_ns)

    def _resend(self, missing: tuple[int, ...], now_ns: int) -> None:
        for sequence in missing:
            if unit := self.in_flight.missing(sequence, now_ns=now_ns, round_trip_ns=2 * self.way_ms * MS):
                self.resent += 1
                self.in_flight.resent(sequence, now_ns=now_ns)
                self.sees[0].send(UnitHeader(1, sequence, sequence, unit.keyframe, Flags.RESENT), now_ns)

    @property
    def shown(self) -> float:
        """Share of the frames, at the ground that saw least."""
        return min(len(ground.seen) for ground in self.sees) / self.sent

    @property
    def longest_dark_s(self) -> float:
        """From one picture to the next, at the ground that waited longest."""
        return max(b - a for ground in self.sees for a, b in pairwise(ground.shown_ns)) / 1e9

    @property
    def dark_s(self) -> list[float]:
        """From one picture to the next where there was a loss, at the first ground."""
        return [(b - a) / 1e9 for a, b in pairwise(self.sees[0].shown_ns) if b - a > 1.5 * FRAME_NS]


INTERVAL_NS = 10_000 * MS
LIMITED = KeyframeSettings(interval_ns=INTERVAL_NS)
UNLIMITED = KeyframeSettings(interval_ns=INTERVAL_NS, refill_ns=0)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("loss", "grounds", "takes_ms"),
    [(0.05, 1, 160), (0.05, 2, 160), (0.1, 2, 160), (0.05, 1, 600), (0.05, 2, 600)],
)
def test_a_minute_of_loss_is_as_dark_as_without_a_limit(loss, grounds, takes_ms, seed):
    """On a radio that loses one frame in twenty the screen would be dark for half of the time, and for seconds."""
    free = Minute(UNLIMITED, loss=loss, grounds=grounds, takes_ms=takes_ms, seed=seed)
    limited = Minute(LIMITED, loss=loss, grounds=grounds, takes_ms=takes_ms, seed=seed)
    assert free.refused == 0
    assert limited.shown > free.shown - 0.05
    assert limited.longest_dark_s <= max(1.5, free.longest_dark_s + 0.5)


@pytest.mark.parametrize("way_ms", [10, NIGHTLY(30), NIGHTLY(100), 200])
def test_after_a_loss_a_keyframe_comes_at_once_and_only_one(way_ms):
    """Each lost frame would darken the screen for longer than the link needs, or bring keyframe after keyframe."""
    flown = [Minute(LIMITED, loss=0.01, seed=seed, way_ms=way_ms) for seed in range(8)]
    dark_s = sorted(one for minute in flown for one in minute.dark_s)
    # The frame that is lost, the one behind it, the request, the wait for the next frame, and its way.
    assert dark_s[len(dark_s) // 2] <= 2 * way_ms / 1000 + 0.21
    losses = sum(ground.reassembler.counters.gaps for minute in flown for ground in minute.sees)
    assert sum(minute.requests.sent for minute in flown) <= losses + 8 * 7


@pytest.mark.parametrize("way_ms", [10, NIGHTLY(30), NIGHTLY(100), 200])
@pytest.mark.parametrize("loss", [0.01, NIGHTLY(0.05), 0.1])
def test_lost_frames_that_go_once_more_leave_less_of_the_screen_dark(loss, way_ms):
    """Each would cost all frames up to the next keyframe, and that the bits of some four."""
    without, repaired = (
        [Minute(LIMITED, loss=loss, seed=seed, way_ms=way_ms, resends=resends) for seed in range(4)]
        for resends in (False, True)
    )
    hidden, left = (sum(1 - one.shown for one in flown) for flown in (without, repaired))
    assert left < 0.5 * hidden
    longest = [sum(one.longest_dark_s for one in flown) for flown in (repaired, without)]
    assert longest[0] < 1.1 * longest[1]
    assert sum(one.requests.sent for one in repaired) < 0.6 * sum(one.requests.sent for one in without)
    assert sum(one.resent for one in repaired) <= 1.2 * loss * sum(one.sent for one in repaired)


def test_without_reports_the_token_bucket_alone_lasts_for_an_ordinary_loss():
    """A ground whose reports are lost as well would be left in the dark."""
    limited = Minute(LIMITED, loss=0.05, reports=False)
    assert limited.refused == 0
    assert limited.shown > 0.75


def test_the_rig_can_fail():
    """It would say nothing of the limit: with one keyframe in two seconds, as it once was, the picture goes."""
    slow = KeyframeSettings(interval_ns=INTERVAL_NS, refill_ns=2_000 * MS)
    before = Minute(slow, reports=False, takes_ms=0)
    assert before.refused > 5
    assert before.longest_dark_s > 1.9
