"""Code again until the total is right: which budget makes a method spend what another really spent.

A target is first put on a grid of one per cent, so that methods which spent nearly the same are compared with one
and the same flight of video, whatever the order in which they were flown.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from hvt_study.runs.spec import MATCH_TOLERANCE

_STEP = 1.01
_CLOSE = 0.003
"""Of the target on the grid: with half a step it stays within one per cent of the real one."""
SAME_TOTAL = 1e-4
"""Of a total: rates that come back from another accounting are rounded."""
_TRIES = 7
_USUAL_RATIO = 0.98
"""What a video-only method spends of the budget that it is given."""


@dataclass(frozen=True, slots=True)
class Matched:
    """The budget that came nearest."""

    budget_bps: int
    total_bps: float
    tries: int


def grid_target(total_bps: float) -> float:
    """The target on the grid next to this total."""
    return float(_STEP ** round(math.log(total_bps, _STEP)))


def first_budget(total_bps: float) -> int:
    """The budget of which video usually spends this total."""
    return round(grid_target(total_bps) / _USUAL_RATIO)


def within(total_bps: float, target_bps: float) -> bool:
    """Whether a total counts as equal."""
    return abs(total_bps / target_bps - 1) <= MATCH_TOLERANCE


def match(spends: Callable[[int], float | None], *, target_bps: float) -> Matched | None:
    """Find a budget for which ``spends(budget_bps)`` is close to the grid's target (of ``target_bps``).

    The search is a secant in the logarithms of both, kept within what has been seen to be too much and too little;
    ``spends`` is asked seven times at most. It may jump: the nearest that was seen is returned, whether or not it is
    within the tolerance. ``spends`` is None for a budget that cannot be flown, which ends the search: None where that
    is the first one.
    """
    target = grid_target(target_bps)
    seen: dict[int, float] = {}
    budget = first_budget(target_bps)
    while len(seen) < _TRIES and budget not in seen:
        total = spends(budget)
        if total is None:
            break
        seen[budget] = total
        if abs(seen[budget] / target - 1) <= _CLOSE:
            break
        budget = _next(seen, target)
    if not seen:
        return None
    best = min(seen, key=lambda one: abs(seen[one] / target_bps - 1))
    return Matched(best, seen[best], len(seen))


def _next(seen: dict[int, float], target: float) -> int:
    """The next budget to try."""
    low = max((one for one, total in seen.items() if total < target), default=None)
    high = min((one for one, total in seen.items() if total >= target), default=None)
    if low is None or high is None or low >= high:
        nearest = min(seen, key=lambda one: abs(seen[one] / target - 1))
        return round(nearest * target / seen[nearest])
    span = math.log(seen[high] / seen[low])
    share = math.log(target / seen[low]) / span if span > 0 else 0.5
    # Never right at an end: where the curve is a step, that end would be tried again and again.
    return round(low * math.pow(high / low, min(max(share, 0.1), 0.9)))
