"""How good a list of objects is, tick by tick: F1 of the boxes, and the share of right classes among those found."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from operator import eq

import numpy as np

from hvt_common.values import Boxes
from hvt_study.metrics.match import matched_rows

__all__ = ["ListScore", "Listed", "score_lists"]

_IGNORED_SHARE = 0.5
"""A box with so much of it in one ignored region is neither right nor wrong."""


def _no_boxes() -> Boxes:
    return np.empty((0, 4), np.float32)


@dataclass(frozen=True, slots=True)
class Listed:
    """The objects of one tick, as shown or as they are."""

    boxes_base_px: Boxes = field(default_factory=_no_boxes)
    """(N, 4) float32, x1 y1 x2 y2, base pixels."""
    classes: tuple[str, ...] = ()
    """N names."""
    ignored_base_px: Boxes = field(default_factory=_no_boxes)
    """(K, 4): regions of which the truth says nothing; only a truth has any."""


@dataclass(frozen=True, slots=True)
class ListScore:
    """Counts over some ticks."""

    matched: int = 0
    right: int = 0
    """Of these, those with the right class."""
    wanted: int = 0
    """Objects of the truth."""
    shown: int = 0
    """Boxes that were shown, without those in ignored regions."""

    @property
    def f1(self) -> float:
        """2 matched / (wanted + shown), whatever the classes; 1 where nothing was there and nothing was shown."""
        total = self.wanted + self.shown
        return 2 * self.matched / total if total else 1.0

    @property
    def precision(self) -> float:
        """Share of what was shown that is there."""
        return self.matched / max(1, self.shown)

    @property
    def recall(self) -> float:
        """Share of what is there that was shown."""
        return self.matched / max(1, self.wanted)

    @property
    def class_agreement(self) -> float:
        """Share of the matched objects that are shown with their class; 0 where none was matched."""
        return self.right / max(1, self.matched)

    def __add__(self, other: ListScore) -> ListScore:
        return ListScore(
            self.matched + other.matched,
            self.right + other.right,
            self.wanted + other.wanted,
            self.shown + other.shown,
        )


def score_lists(
    pairs: Iterable[tuple[Listed, Listed]], *, same_class: Callable[[str, str], bool] = eq
) -> ListScore:
    """Score (truth, shown) of each tick and add up.

    Boxes are matched one to one with an IoU of at least 0.5, as many pairs as possible and then the most overlap,
    whatever their classes. ``same_class(shown, true)`` says which names agree.
    """
    total = ListScore()
    for truth, shown in pairs:
        total += _tick(truth, shown, same_class)
    return total


def _tick(truth: Listed, shown: Listed, same_class: Callable[[str, str], bool]) -> ListScore:
    matches = matched_rows(truth.boxes_base_px, shown.boxes_base_px).tolist()
    right = sum(same_class(shown.classes[column], truth.classes[row]) for row, column in matches)
    free = np.ones(len(shown.classes), bool)
    free[[column for _, column in matches]] = False
    passed_over = int(_inside(shown.boxes_base_px[free], truth.ignored_base_px).sum())
    return ListScore(len(matches), right, len(truth.classes), len(shown.classes) - passed_over)


def _inside(boxes: Boxes, regions: Boxes) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which boxes lie mostly in one of the regions."""
    if not len(boxes) or not len(regions):
        return np.zeros(len(boxes), bool)
    first = np.maximum(boxes[:, None, :2], regions[None, :, :2])
    last = np.minimum(boxes[:, None, 2:], regions[None, :, 2:])
    shared = np.clip(last - first, 0, None).prod(axis=2)
    areas = np.clip(boxes[:, 2:] - boxes[:, :2], 1e-6, None).prod(axis=1)
    return np.asarray((shared / areas[:, None] >= _IGNORED_SHARE).any(axis=1))
