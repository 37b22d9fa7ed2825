"""How long a comparison still takes."""

import heapq

import pytest

from hvt_study.matrix.compare import COMPARED, what_is_ahead
from hvt_study.matrix.time_left import TimeLeft
from hvt_study.runs.spec import ModelChoice, RunSpec

RATES_KBPS = (150, 200, 300, 400, 800)
HYBRIDS_S = {
    "R0": (2.6, 2.7, 2.8, 2.9, 3.2),
    "M5-jpeg": (2.2, 3.0, 3.1, 3.1, 3.2),
    "M5-residual": (1.7, 1.7, 2.6, 2.9, 3.2),
    "tracks": (2.5, 2.7, 3.0, 3.0, 3.3),
    "M6": (2.1, 2.3, 2.9, 3.0, 3.3),
    "auto": (2.7, 3.2, 3.2, 3.3, 3.9),
}
"""What flights of a comparison took, s, by rate: of detectors so small that coding is much of it."""
VIDEO_S = {15: (2.4, 2.6, 2.8, 2.9, 3.1), 7.5: (2.0, 2.2, 2.2, 2.3, 2.4), 5: (1.8, 1.9, 2.0, 2.0, 2.1)}
VIDEO_S |= {3: (1.8, 1.9, 2.0, 2.0, 2.1), 2: (1.3, 1.5, 1.5, 1.5, 1.7), 1: (0.9, 0.9, 0.9, 1.0, 1.1)}
OTHER_SIZES_S = ((2.5, 1.9), (1.4, 0.9), (1.3, 0.9), (1.4, 0.9), (2.8, 2.2))
ONCE_S = 5.5
"""The clip is read and labelled."""


def flights_of(rate: int, name: str) -> dict[object, float]:
    """What each takes, s, by what it is: runs share some."""
    if name in HYBRIDS_S:
        return {name: HYBRIDS_S[name][rate]}
    video = {fps: took[rate] for fps, took in VIDEO_S.items() if name != "M0" or fps == 15}
    return video | (dict(enumerate(OTHER_SIZES_S[rate], 100)) if name == "M0-best" else {})


def estimates(workers: int, times: dict[str, float]) -> tuple[float, list[tuple[float, float]]]:
    """(what all takes, what is said each second and what it then takes), where kinds take so many times as long."""
    specs = {
        (rate, name): RunSpec(
            *("demo:0", "0", method, "", 1000 * kbps, ModelChoice("motion", "motion"), codec)
        )
        for rate, kbps in enumerate(RATES_KBPS)
        for name, (method, codec) in COMPARED.items()
    }
    _, work, kinds = what_is_ahead(specs, sizes=2)
    left = TimeLeft(work, kinds=kinds, workers=workers, now_s=0.0)
    waiting, flown, events = list(work), set(), []

    def begin(now_s: float, *, once_s: float = 0.0) -> None:
        run = waiting.pop(0)
        now_s += once_s * max(times.values())
        for what, took_s in flights_of(*run).items():
            if (run[0], what) not in flown:
                flown.add((run[0], what))
                now_s += took_s * times[kinds[run][-1]]
                heapq.heappush(events, (now_s, 0, run))
        heapq.heappush(events, (now_s, 1, run))

    for _ in range(workers):
        begin(0.0, once_s=ONCE_S)
    said, done, now_s = [], 0, 0.0
    while events:
        at_s, end, run = heapq.heappop(events)
        while now_s < at_s:
            said.append((now_s, left.left_s(now_s=now_s)))
            now_s += 1.0
        done += not end
        if end:
            left.ended(run, flown=done, now_s=at_s)
            if waiting:
                begin(at_s)
    return at_s, [(at_s - when_s, left_s) for when_s, left_s in said if left_s is not None]


@pytest.mark.parametrize("workers", [1, 2, 4])
@pytest.mark.parametrize("decoded", [0.7, 1, 3])
@pytest.mark.parametrize("source", [1, 3, 10])
def test_what_is_said_is_within_half_of_what_it_takes(decoded, source, workers):
    """Who waits would be told of ten minutes, and wait for an hour: the first flights are not like the last."""
    all_s, said = estimates(workers, {"video": 1.0, "decoded": decoded, "source": source})
    assert said[0][0] > 0.25 * all_s
    for left_s, says_s in said[1:]:
        assert left_s < 0.1 * all_s or left_s / 1.4 < says_s < 1.4 * left_s


def test_what_the_cache_had_says_nothing_of_what_is_flown():
    """A comparison that goes on where it was broken off would be told to end at once."""
    runs = dict.fromkeys(range(10), 1)
    found = TimeLeft(runs, kinds=dict.fromkeys(runs, ("M6",)), workers=1, now_s=0.0)
    for run in range(5):
        found.ended(run, flown=0, now_s=0.1)
    assert found.left_s(now_s=5.0) is None
    for run in (5, 6):
        found.ended(run, flown=run - 4, now_s=30.0 * (run - 4))
    assert found.left_s(now_s=60.0) == pytest.approx(90, abs=1)


def test_what_slows_one_kind_down_slows_all():
    """Where another program has begun, who waits would be told half of what it takes until each kind was flown."""
    kinds = {**dict.fromkeys(range(4), ("source",)), **dict.fromkeys(range(4, 20), ("video",))}
    order = [0, 4, 1, 5, 2, 3, *range(6, 20)]
    found = TimeLeft(dict.fromkeys(order, 1), kinds=kinds, workers=1, now_s=0.0)
    now_s = 0.0
    for flown, run in enumerate(order[:6], 1):
        now_s += {"source": 10.0, "video": 5.0}[kinds[run][0]] * (1 if flown < 5 else 2)
        found.ended(run, flown=flown, now_s=now_s)
    assert found.left_s(now_s=now_s) == pytest.approx(14 * 10.0, rel=0.33)
