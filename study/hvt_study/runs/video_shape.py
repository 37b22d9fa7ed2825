"""The best frame rate and size of video alone, from coarse to fine: what the strongest competitor is set to.

All rates are flown at the run's own size. Then other sizes are, next smaller and next larger ones first, at the rate
that was best and at its two neighbours; in each direction until a size shows less than the one before it. A rate and
size that are best together and far from both paths are not found: flying every pair would cost three times as much.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self, TypeVar

from hvt_edge.source.contract import size_within

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


class _Comparable(Protocol):
    def __lt__(self, other: Self, /) -> bool: ...


_Worth = TypeVar("_Worth", bound=_Comparable)


def competing_sizes(nominal: tuple[int, int], source: tuple[int, int]) -> tuple[tuple[int, int], ...]:
    """Sizes that video alone may have, smallest first: from 640x360 up to the run's or the source's, the larger one.

    ``nominal``, the run's own, is always one of them; the others have the source's aspect ratio.
    """
    pixels = {nominal: _area(size_within(source, nominal))}
    """Of the source's picture, without borders, by size."""
    whole = (source[0] // 2 * 2, source[1] // 2 * 2)
    largest = max(*pixels.values(), _area(whole))
    least = (1 - _ALIKE) * _area(size_within(source, _BOXES[0]))
    for size in (whole, *(size_within(source, box) for box in _BOXES)):
        alike = any(abs(_area(size) / one - 1) < _ALIKE for one in pixels.values())
        if least <= _area(size) <= largest and not alike:
            pixels[size] = _area(size)
    return tuple(sorted(pixels, key=lambda size: pixels[size]))


def search_shape(
    fly: Callable[[VideoShape], _Worth | None],
    *,
    rates: Sequence[float],
    sizes: Sequence[tuple[int, int]],
    nominal: tuple[int, int],
) -> None:
    """Fly from coarse to fine; ``fly`` says what a flight was worth, None where it cannot be flown.

    Args:
        fly: called once for each shape.
        rates: frames a second, in order.
        sizes: smallest first, ``nominal`` among them.
        nominal: the run's own size.
    """
    worth: dict[float, Any] = {fps: fly(VideoShape(fps)) for fps in rates}
    flown = [fps for fps in rates if worth[fps] is not None]
    if not flown:
        return
    best = max(flown, key=lambda fps: worth[fps])
    at = rates.index(best)
    near = rates[max(0, at - 1) : at + 2]
    middle = sizes.index(nominal)
    for path in (sizes[:middle][::-1], sizes[middle + 1 :]):
        before = worth[best]
        for size in path:
            found: list[Any] = [one for fps in near if (one := fly(VideoShape(fps, size))) is not None]
            if not found or max(found) < before:
                break
            before = max(found)


def _area(size: tuple[int, int]) -> int:
    return size[0] * size[1]
