"""How long a comparison still takes."""

from __future__ import annotations

import heapq
import random

import pytest

from hvt_study.matrix.time_left import TimeLeft

FLIGHTS = {"M6": 1, "M5": 1, "auto": 1, "R0": 1, "tracks": 1, "M0": 1, "best": 10}
KINDS = dict.fromkeys(("M6", "auto", "tracks"), "source") | dict.fromkeys(("M5", "R0"), "decoded")


def estimates(workers: int, costs: dict[str, float], *, seed: int) -> tuple[float, list[float]]:
    """(when the first is said, what is said over what it then takes) of five rates, times as shares of the whole."""
    chance = random.Random(seed)
    rest = [(rate, name) for rate in range(5) for name in FLIGHTS if rate or name == "best"]
    order = [
        *((0, name) for name in FLIGHTS if name != "best"),
        *sorted(rest, key=lambda run: -FLIGHTS[run[1]]),
    ]
    runs = {run: 0 if run[0] and run[1] == "M0" else FLIGHTS[run[1]] for run in order}
    found = TimeLeft(
        runs, kinds={run: (run[1], KINDS.get(run[1], "video")) for run in runs}, workers=workers, now_s=0.0
    )
    waiting, events, begun = list(runs), [], 0

    def begin(now_s: float) -> None:
        nonlocal begun
        run = waiting.pop(0)
        at_s = now_s + (20.0 if begun < workers else 0.0)  # the clip is read, and labelled
        begun += 1
        for _ in range(runs[run]):
            at_s += costs[run[1]] * chance.uniform(0.8, 1.2)
            heapq.heappush(events, (at_s, 0, run))
        heapq.heappush(events, (at_s, 1, run))

    for _ in range(workers):
        begin(0.0)
    said: list[tuple[float, float | None]] = []
    flown, now_s = 0, 0.0
    while events:
        at_s, end, run = heapq.heappop(events)
        while now_s < at_s:
            said.append((now_s, found.left_s(now_s=now_s)))
            now_s += 1.0
        flown += not end
        if end:
            found.ended(run, flown=flown, now_s=at_s)
            if waiting:
                begin(at_s)
    known = [(when_s, left_s) for when_s, left_s in said if left_s is not None]
    return known[0][0] / at_s, [left_s / (at_s - when_s) for when_s, left_s in known if at_s - when_s > 30]


@pytest.mark.parametrize("workers", [1, 2, 4])
@pytest.mark.parametrize(
    ("costs", "share"),
    [
        ({"R0": 10, "M5": 9, "tracks": 25, "M6": 30, "auto": 28, "best": 5, "M0": 5}, 0.9),
        ({"R0": 60, "M5": 60, "tracks": 200, "M6": 220, "auto": 210, "best": 12, "M0": 12}, 0.9),
        ({"R0": 4, "M5": 4, "tracks": 5, "M6": 5, "auto": 5, "best": 4, "M0": 4}, 0.9),
        ({"R0": 20, "M5": 20, "tracks": 30, "M6": 80, "auto": 60, "best": 8, "M0": 10}, 0.8),
    ],
)
def test_what_is_said_is_within_half_of_what_it_takes(costs, share, workers):
    """Who waits would be told of ten minutes, and wait for an hour: the first flights are not like the last."""
    for seed in range(3):
        first, said = estimates(workers, costs, seed=seed)
        assert first < 0.75
        assert sum(1 / 1.5 <= one <= 1.5 for one in said) >= share * len(said)


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
