"""The numbers of `make link`, on arrivals whose numbers are known."""

import json
import math
from dataclasses import replace

import pytest

from lab.link.measures.outcome import STORED_FROM, Outcome, measures, rate_over_time, rows
from lab.link.measures.resources import Sample, more_at_the_end, slope_mb_per_hour
from lab.link.measures.rows import holds
from lab.link.measures.store_left import StoreLeft
from lab.link.measures.timing import Arrival
from lab.link.script import load_scenario

BEGAN_S = 1_790_000_000.0
STORE = dict.fromkeys(
    ("stills", "video_s", "evicted_stills", "evicted_segments", "unreadable", "given_up"), 0
)


def frame(index: int, *, delay_s: float = 0.1, shown: bool = True, size: int = 5000) -> Arrival:
    capture_s = BEGAN_S + index / 10
    return Arrival("base", index, index, capture_s, capture_s + 0.02, capture_s + delay_s, shown, size)


def outcome(name: str, frames: list[Arrival], *, sent: int | None = None, store=None) -> Outcome:
    sums = {"base_bytes": 1000, "roi_bytes": 10, "backlog_bytes": 7, "meta_bytes": 0, "overhead_bytes": 5}
    edge = {
        **sums,
        "frames": len(frames) if sent is None else sent,
        "frames_dropped": 3,
        "stills": {"sent": 8, "reasons": {"sent": {"utility": 7, "stored": 1}}},
        "store": None if store is None else STORE | store,
    }
    back = {"stills": 2, "frames": 50, "video_s": 5.0}
    ground = {**sums, "roi_bytes": 8, "stills": {"received": 4}, "backlog": back}
    ground |= {"keyframe_requests": 2, "lost": 1}
    return Outcome(
        scenario=name,
        script=load_scenario(name).script("full"),
        began_s=BEGAN_S,
        arrivals=frames,
        edge=edge,
        ground=ground,
        samples={"edge": [Sample(BEGAN_S + i, 100 + i / 3600, 20, 9) for i in range(600)]},
        exit_codes={"edge": 0, "ground": None},
        said={"edge": "flying", "ground": "Traceback (most recent call last):"},
    )


LATE = dict.fromkeys(range(152, 180), 1.5) | {160: 0.3}
AFTER_DARKNESS = [
    *(frame(i) for i in range(119)),
    *(frame(i, delay_s=20.5 - i / 10) for i in range(120, 190)),
    *(frame(i) for i in range(230, 400)),
]
RATE_BACK = "90 % of the rate again after a rise, s"


@pytest.mark.parametrize(
    ("name", "frames", "measured"),
    [
        # 20 ms of encoding, 40 ms on the line at 1 Mbps, 20 ms of delay and 2 ms of jitter.
        (
            "steady-1M",
            [frame(i) for i in range(600)],
            {"frame delay p50, ms": 100, "frame delay p95 over floor": 100 / 82},
        ),
        ("steady-1M", [frame(i) for i in range(600)], {"delivered, kbps": pytest.approx(400, rel=0.01)}),
        # A stream of garbage would be a whole picture; a run that died in the middle would have the best gaps.
        (
            "steady-1M",
            [frame(i, shown=not 100 <= i < 130) for i in range(600) if not 300 <= i < 350],
            {"decodable frames, %": 100 * 520 / 600, "longest without a picture, s": 5.1},
        ),
        ("steady-1M", [frame(i) for i in range(300)], {"longest without a picture, s": 30.0}),
        # One early frame would count as a recovery; an adaptation that stays down would pass.
        (
            "step-1M-200k-1M",
            sorted((frame(i, delay_s=LATE.get(i, 0.1)) for i in range(600)), key=lambda one: one.received_s),
            {"under 1 s again after a fall, s": pytest.approx(179 / 10 + 1.5 - 15, abs=0.11)},
        ),
        (
            "step-1M-200k-1M",
            [frame(i, size=5000 if i < 150 else 1000) for i in range(600)],
            {RATE_BACK: math.inf},
        ),
        (
            "step-1M-200k-1M",
            [frame(i, size=1000 if 150 <= i < 400 else 5000) for i in range(600)],
            {RATE_BACK: pytest.approx(7, abs=0.5)},
        ),
        # The flood of old frames after an outage would be taken for the present.
        ("outage-8s", AFTER_DARKNESS, {"live again after darkness, s": 3.1}),
    ],
)
def test_what_is_measured_of_arrivals(name, frames, measured):
    """The table's numbers would be others."""
    found = measures(outcome(name, frames, sent=600))
    assert {measure: found[measure] for measure in measured} == pytest.approx(measured)


HOLDS = {"stills lost": False, "unheard of": False, "edge, exit code": True, "ground, exit code": False}
HOLDS |= {"edge, tracebacks": True, "ground, tracebacks": False}


def test_accounts_and_processes():
    """A hole in the account, or a process that had to be killed, would not show."""
    result = outcome("outage-60s", [*(frame(i) for i in range(1200)), *(still(i) for i in range(6))])
    found = {row["measure"]: row for row in rows(result, {"stills lost": "== 0", "unheard of": "<= 1"})}
    assert found["ledger difference, bytes"]["value"] == 2
    assert found["stills lost"]["value"] == 1
    assert {name: found[name]["holds"] for name in HOLDS} == HOLDS
    assert found["edge, memory slope MB/h"]["value"] == pytest.approx(1.0, abs=0.01)
    json.dumps(list(found.values()), allow_nan=False)


def still(sequence: int, kind: str = "roi", *, shown: bool = True) -> Arrival:
    return Arrival(kind, sequence, 0, BEGAN_S, BEGAN_S, BEGAN_S + 1, shown, 500)


def test_what_is_still_kept_is_not_lost_and_what_was_given_up_is():
    """An edge that throws away what it kept would lose nothing."""
    first = STORED_FROM
    came = [still(number) for number in (0, 1, 2, 4, 5)]
    past = [still(first, "backlog-still"), still(first + 1, "backlog-still", shown=False)]
    past.append(still(3, "backlog-base"))

    def lost(stored: set[int], **store: int) -> float:
        result = outcome("outage-60s", [*came, *past], store=store)
        return measures(replace(result, stored=StoreLeft(9, 0, stills=frozenset(stored))))["stills lost"]

    assert lost({3, 6, first + 1, first + 2}) == 0
    assert lost({3, 6, first + 2}) == 1, "a half of one came"
    assert lost({6, first + 1}) == 1, "live still 3 is nowhere"
    assert lost({3, first + 1}) == 1, "seven were sent, the last leaves no hole"
    assert lost({3, 6, first + 1}, evicted_stills=3, given_up=1) == 4


def test_what_the_store_did_is_told_where_it_did_something():
    """The numbers of `outage-60s` would be nowhere, or in every scenario's table."""
    frames = [frame(i) for i in range(600)]
    found = measures(outcome("outage-60s", frames, store={"stills": 9, "video_s": 12}))
    told = "stills that came afterwards"
    kept = found["stills still kept at the end"], found["video still kept at the end, s"]
    assert (found[told], *kept) == (2, 9, 12)
    assert told not in measures(outcome("outage-60s", frames, store={}))
    assert told not in measures(outcome("outage-60s", frames))


@pytest.mark.parametrize(
    ("value", "bar", "held"),
    [(2.0, "<= 2", 1), (2.1, "<= 2", 0), (97, ">= 97", 1), (None, "== 0", 0), (math.inf, ">= 97", 0)],
)
def test_bars_are_read_as_they_are_written(value, bar, held):
    """`<= 2` would be `< 2`, or infinity good enough."""
    assert holds(value, bar) == bool(held)


def test_the_rate_over_time_leaves_nothing_out():
    """The plot of the delivered bitrate would not sum to what came."""
    result = outcome("steady-1M", [frame(i, size=1000) for i in range(590)])
    assert sum(rate_over_time(result)) == 590 * 8000


def test_memory_has_the_slope_of_its_leak_and_of_nothing_else():
    """The start would count as a leak, or the moment in which a recording is folded; or a leak would hide there."""
    samples = [Sample(i, 50 + min(i, 30) + 40 * (i == 70), 5, 5) for i in range(100)]
    assert slope_mb_per_hour(samples) == pytest.approx(0, abs=1e-6)
    assert slope_mb_per_hour(samples[:5]) is None
    samples = [Sample(i / 4, 500 + i / 4 / 3600 + 9 * (i % 60 < 3), 5, 5) for i in range(14_400)]
    assert slope_mb_per_hour(samples) == pytest.approx(1, abs=0.05)


def test_more_at_the_end_is_what_stays():
    """A leak of descriptors would not show, or an open file for a moment would."""

    def more(levels: list[int]) -> float | None:
        samples = [Sample(float(i), 50.0, level, 5) for i, level in enumerate(levels)]
        return more_at_the_end(samples, lambda sample: sample.descriptors)

    assert more([20] * 100) == 0
    assert more([20] * 85 + [27] + [20] * 14) == 0
    assert more([20] * 30 + [18] * 40 + [20] * 30) == 0, "an outage took a socket and gave it back"
    assert more([20] * 84 + [21] * 5 + [20] * 11) == 0, "an outage near the end opened a file"
    assert more([20 + i // 10 for i in range(100)]) >= 4
    assert more([20] * 10) is None


def test_a_long_run_has_to_be_flat():
    """An hour would be flown, and nobody say that memory grew."""
    result = outcome("drone-fade", [frame(i) for i in range(900)])
    soak = replace(result, script=load_scenario("drone-fade").script("full", lasts="60min"))
    short = {row["measure"]: row["bar"] for row in rows(result, {})}
    asked = {row["measure"]: row["bar"] for row in rows(soak, {})}
    assert short["edge, memory slope MB/h"] is None
    assert asked["edge, memory slope MB/h"] == asked["ground, memory slope MB/h"] == "<= 1"
    assert asked["ledger difference, bytes"] == "== 0"
