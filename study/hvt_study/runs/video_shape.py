"""The budget at which a method spends the same as another, and the best frame rate and size for video alone.

A target is first put on a grid of one per cent, so that methods which spent nearly the same are compared with one
and the same flight of video, whatever the order in which they were flown.

Shapes are tried from coarse to fine. All rates are flown at the run's own size. Then other sizes are, next smaller
and next larger ones first, at the rate that was best and at its two neighbours; in each direction until a size shows
less than the one before it. A rate and size that are best together and far from both paths are not found: flying
every pair would cost three times as much.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count

from hvt_edge.source.contract import size_within
from hvt_study.runs.spec import MATCH_TOLERANCE

_STEP = 1.01
_CLOSE = 0.003
"""Tolerance of the target on the grid: with half a step it stays within one per cent of the real one."""
SAME_TOTAL = 1e-4
"""Tolerance of a total: rates that come back from another accounting are rounded."""
_TRIES, _MORE = 7, 9
"""Tries of the secant, and then beside the best budget."""
_ASIDE = 0.004
"""Share of a budget by which the next is tried beside the best one, where the curve has a step or falls."""
_USUAL_RATIO = 0.85
"""The share of its budget that a video-only method spends."""


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
    return abs(total_bps / target_bps - 1) <= MATCH_TOLERANCE


def match(spends: Callable[[int], float | None], *, target_bps: float) -> Matched | None:
    """Find a budget for which ``spends(budget_bps)`` is close to the grid's target (of ``target_bps``).

    The search is a secant in the logarithms of both, kept between budgets that were too large and too small;
    ``spends`` is asked sixteen times at most. It may jump, so that between two budgets is none that fits: after seven
    times those beside the best one are tried, until one is within the tolerance. The nearest that was seen is
    returned, whether or not it is. ``spends`` is None for a budget that cannot be flown, which ends the search: None
    where that is the first one.
    """
    target = grid_target(target_bps)
    seen: dict[int, float] = {}
    budget = first_budget(target_bps)
    while len(seen) < _TRIES + _MORE:
        total = spends(budget)
        if total is None:
            break
        seen[budget] = total
        if abs(total / target - 1) <= _CLOSE:
            break
        if len(seen) >= _TRIES and any(within(one, target_bps) for one in seen.values()):
            break
        budget = _next(seen, target)
        if len(seen) >= _TRIES or budget in seen:
            budget = _beside(seen, target)
    if not seen:
        return None
    best = min(seen, key=lambda one: abs(seen[one] / target_bps - 1))
    return Matched(best, seen[best], len(seen))


def _next(seen: dict[int, float], target: float) -> int:
    low = max((one for one, total in seen.items() if total < target), default=None)
    high = min((one for one, total in seen.items() if total >= target), default=None)
    if low is None or high is None or low >= high:
        by_error = min(seen, key=lambda one: abs(seen[one] / target - 1))
        # Where all were too little, on from the highest: the nearest would be left by the same step again.
        nearest = max(seen) if high is None else min(seen) if low is None else by_error
        return round(nearest * target / seen[nearest])
    span = math.log(seen[high] / seen[low])
    share = math.log(target / seen[low]) / span if span > 0 else 0.5
    # Never right at an end: where the curve is a step, that end would be tried again and again.
    return round(low * math.pow(high / low, min(max(share, 0.1), 0.9)))


def _beside(seen: dict[int, float], target: float) -> int:
    best = min(seen, key=lambda one: abs(seen[one] / target - 1))
    side = -1 if seen[best] > target else 1
    step = max(1, round(_ASIDE * best))
    return next(
        one for k in count(1) for one in (best + side * k * step, best - side * k * step) if one not in seen
    )


_BOXES = ((640, 360), (960, 540), (1280, 720), (1920, 1080), (2560, 1440), (3840, 2160))
"""(width, height) into which the source is fitted for the sizes that are tried."""
_ALIKE = 0.15
"""Sizes of areas that differ by a smaller share are one."""


@dataclass(frozen=True, slots=True)
class VideoShape:
    """Frame rate and size of one flight of a run."""

    fps: float | None = None
    """Frames a second; None: as the method's flags say."""
    size: tuple[int, int] | None = None
    """(width, height) of the base stream in pixels; None: that of the run."""


def competing_sizes(nominal: tuple[int, int], source: tuple[int, int]) -> tuple[tuple[int, int], ...]:
    """Sizes that video alone may have, smallest first: from 640x360 up to the run's or the source's, the larger one.

    ``nominal``, the run's own, is always one of them; the others have the source's aspect ratio.
    """
    pixels = {nominal: _area(size_within(source, nominal))}
    """Pixels of the source's picture, without borders, by size."""
    whole = (source[0] // 2 * 2, source[1] // 2 * 2)
    largest = max(*pixels.values(), _area(whole))
    least = (1 - _ALIKE) * _area(size_within(source, _BOXES[0]))
    for size in (whole, *(size_within(source, box) for box in _BOXES)):
        alike = any(abs(_area(size) / one - 1) < _ALIKE for one in pixels.values())
        if least <= _area(size) <= largest and not alike:
            pixels[size] = _area(size)
    return tuple(sorted(pixels, key=lambda size: pixels[size]))


def search_shape(
    fly: Callable[[VideoShape], tuple[float, float] | None],
    *,
    rates: Sequence[float],
    sizes: Sequence[tuple[int, int]],
    nominal: tuple[int, int],
) -> None:
    """Fly each shape once, from coarse to fine; ``sizes`` go from the smallest, the run's own (``nominal``) is one.

    ``fly`` returns the worth of a flight, None where it cannot be flown.
    """
    worth = {fps: one for fps in rates if (one := fly(VideoShape(fps))) is not None}
    if not worth:
        return
    best = max(worth, key=lambda fps: worth[fps])
    at = rates.index(best)
    near = rates[max(0, at - 1) : at + 2]
    middle = sizes.index(nominal)
    for path in (sizes[:middle][::-1], sizes[middle + 1 :]):
        before = worth[best]
        for size in path:
            found = [one for fps in near if (one := fly(VideoShape(fps, size))) is not None]
            if not found or max(found) < before:
                break
            before = max(found)


def _area(size: tuple[int, int]) -> int:
    return size[0] * size[1]
