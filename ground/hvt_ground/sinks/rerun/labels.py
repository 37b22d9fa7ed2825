"""Places labels on the picture: beside their own object and over no other; without room there is none.

A viewer draws text at a size of its own, in points of the screen, centred below a point. How large that is on the
picture depends on the window; it is reckoned for a picture that is `_POINTS_WIDE` points wide, and takes less room in
a larger one. Nothing here knows Rerun.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

LEGEND_POINTS = 34.0
"""Height of the legend below the picture."""
_POINTS_WIDE = 900.0
_LETTER, _MARGIN, _HEIGHT, _GAP = 7.2, 12.0, 25.0, 2.0

_Boxes = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Word:
    """The label of a track."""

    row: int
    """Row of the boxes."""
    text: str


@dataclass(frozen=True, slots=True)
class Label:
    """A word that has found a place."""

    row: int
    text: str
    at_px: tuple[float, float]
    """The point that the text is centred below, base pixels."""
    side: int
    """Side of its box; tried first next time."""


def points(count: float, width_px: int) -> float:
    """Pixels of a picture of this width for ``count`` points of the screen."""
    return count * width_px / _POINTS_WIDE


def place_labels(
    words: Sequence[Word], boxes: _Boxes, *, size: tuple[int, int], sides: Mapping[int, int]
) -> list[Label]:
    """Those of the words that fit; earlier ones choose first.

    ``boxes`` are (N, 4) corners of everything on the picture of ``size`` (width, height), ``sides`` where the label
    of a row was last.
    """
    taken = np.empty((0, 4))
    labels = []
    for word in words:
        others = np.vstack([np.delete(boxes, word.row, axis=0), taken])
        places = _places(boxes[word.row], word.text, size)
        order = sorted(range(len(places)), key=lambda side: side != sides.get(word.row, -1))
        for side in order:
            area = places[side]
            inside = (area[:2] >= 0).all() and area[2] <= size[0] and area[3] <= size[1]
            if inside and not _overlaps(area, others):
                at = (float(area[0] + area[2]) / 2, float(area[1]))
                labels.append(Label(word.row, word.text, at, side))
                taken = np.vstack([taken, area])
                break
    return labels


def place_legend(texts: Sequence[str], *, size: tuple[int, int]) -> list[tuple[float, float]]:
    """Points in a row below the picture, from the left, each with room for its text below it."""
    places, x = [], 0.0
    for text in texts:
        width = _width(text, size) + points(_MARGIN, size[0])
        places.append((x + width / 2, size[1] + points(6, size[0])))
        x += width
    return places


def _places(box: _Boxes, text: str, size: tuple[int, int]) -> list[_Boxes]:
    # Areas of a label: below, above, right, left of its box; within a box that is much larger.
    width, height, gap = _width(text, size), points(_HEIGHT, size[0]), points(_GAP, size[0])
    x1, y1, x2, y2 = box.tolist()
    middle = ((x1 + x2 - width) / 2, (y1 + y2 - height) / 2)
    corners = [
        (middle[0], y2),
        (middle[0], y1 - height - gap),
        (x2 + gap, middle[1]),
        (x1 - gap - width, middle[1]),
    ]
    if x2 - x1 > 1.5 * width and y2 - y1 > 3 * height:
        corners.append((middle[0], y2 - height - gap))
    return [np.array([x, y, x + width, y + height]) for x, y in corners]


def _width(text: str, size: tuple[int, int]) -> float:
    return points(_LETTER * len(text) + _MARGIN, size[0])


def _overlaps(area: _Boxes, others: _Boxes) -> bool:
    apart = (others[:, 2:] <= area[:2]) | (others[:, :2] >= area[2:])
    return bool((~apart.any(axis=1)).any())
