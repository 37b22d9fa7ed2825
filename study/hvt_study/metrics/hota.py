"""HOTA, after Luiten et al., "HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking", IJCV 129 (2021).

Written here because the authors' package (``trackeval``) brings ``opencv-python`` with it, which overwrites the
headless OpenCV of HVT. It gives the authors' figures to the last digit (tests/study/metrics/test_tracking.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from hvt_common.values import iou

ALPHAS: Final = np.arange(0.05, 0.99, 0.05)
"""(19,) least IoU of a match; HOTA is the mean over them (section 3.4 of the paper)."""

_EPSILON: Final = float(np.finfo(float).eps)

IdBoxes = tuple[npt.NDArray[np.integer[Any]], npt.NDArray[np.floating[Any]]]
"""Ids (N,), each once, and their boxes (N, 4) x1 y1 x2 y2, of one frame."""

_Overlaps = list[tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.float64]]]


def _zeros() -> npt.NDArray[np.float64]:
    return np.zeros(len(ALPHAS))


@dataclass(frozen=True, slots=True)
class Hota:
    """Counts for each alpha, (19,); those of several sequences can be added up, which is how benchmarks pool them."""

    true_positives: npt.NDArray[np.float64] = field(default_factory=_zeros)
    false_negatives: npt.NDArray[np.float64] = field(default_factory=_zeros)
    false_positives: npt.NDArray[np.float64] = field(default_factory=_zeros)
    association: npt.NDArray[np.float64] = field(default_factory=_zeros)
    """Sum of A(c) over all true positives c (equation 13)."""

    def __add__(self, other: Hota) -> Hota:
        return Hota(
            self.true_positives + other.true_positives,
            self.false_negatives + other.false_negatives,
            self.false_positives + other.false_positives,
            self.association + other.association,
        )

    @property
    def hota(self) -> float:
        """Mean over alpha of sqrt(DetA AssA) (equations 12 and 17); NaN where no track was labelled."""
        return self._mean(np.sqrt(self._detection() * self._association()))

    @property
    def deta(self) -> float:
        """Detection accuracy, mean over alpha of TP / (TP + FN + FP) (equation 14)."""
        return self._mean(self._detection())

    @property
    def assa(self) -> float:
        """Association accuracy, mean over alpha of the mean of A(c) (equation 15)."""
        return self._mean(self._association())

    def _detection(self) -> npt.NDArray[np.float64]:
        total = self.true_positives + self.false_negatives + self.false_positives
        return np.asarray(self.true_positives / np.maximum(1, total))

    def _association(self) -> npt.NDArray[np.float64]:
        return np.asarray(self.association / np.maximum(1, self.true_positives))

    def _mean(self, values: npt.NDArray[np.float64]) -> float:
        labelled = self.true_positives[0] + self.false_negatives[0] > 0
        return float(values.mean()) if labelled else math.nan


def hota(frames: Iterable[tuple[IdBoxes, IdBoxes]]) -> Hota:
    """Of one sequence: for each frame the true tracks and those that are shown, in one pixel space.

    As in the authors' program one matching serves all alphas of a frame: the assignment of the greatest sum of
    overlap times global alignment of the two tracks (section 3.3 of the paper and its appendix).
    """
    overlaps, true_lengths, lengths = _overlaps(frames)
    together = np.zeros((len(true_lengths), len(lengths)))
    for true, shown, overlap in overlaps:
        rest = overlap.sum(axis=0)[None, :] + overlap.sum(axis=1)[:, None] - overlap
        share = np.divide(overlap, rest, out=np.zeros_like(overlap), where=rest > _EPSILON)
        together[true[:, None], shown[None, :]] += share
    either = true_lengths[:, None] + lengths[None, :]
    alignment = together / (either - together)
    pairs = [np.empty(0, np.int64)]
    at = [np.empty(0)]
    for true, shown, overlap in overlaps:
        value = alignment[true[:, None], shown[None, :]] * overlap
        rows, columns = linear_sum_assignment(value, maximize=True)
        pairs.append(true[rows] * len(lengths) + shown[columns])
        at.append(overlap[rows, columns])
    known, pair = np.unique(np.concatenate(pairs), return_inverse=True)
    enough = np.concatenate(at)[None, :] >= ALPHAS[:, None] - _EPSILON
    matches = np.stack([np.bincount(pair[row], minlength=len(known)) for row in enough])  # (19, pairs)
    hits = matches.sum(axis=1).astype(np.float64)
    return Hota(
        true_positives=hits,
        false_negatives=true_lengths.sum() - hits,
        false_positives=lengths.sum() - hits,
        association=(matches**2 / np.maximum(1, either.ravel()[known] - matches)).sum(axis=1),
    )


def _overlaps(
    frames: Iterable[tuple[IdBoxes, IdBoxes]],
) -> tuple[_Overlaps, npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Rows of true and of shown tracks with their IoU, of each frame that has both; then all lengths of tracks."""
    true_of: dict[int, int] = {}
    shown_of: dict[int, int] = {}
    seen: list[list[int]] = [[], []]
    overlaps: _Overlaps = []
    for (true_ids, true_boxes), (ids, boxes) in frames:
        true, shown = _numbered(true_ids, true_of), _numbered(ids, shown_of)
        seen[0] += true.tolist()
        seen[1] += shown.tolist()
        if len(true) and len(shown):
            overlaps.append((true, shown, iou(true_boxes, boxes)))
    return overlaps, _lengths(seen[0], len(true_of)), _lengths(seen[1], len(shown_of))


def _numbered(ids: npt.NDArray[np.integer[Any]], row_of: dict[int, int]) -> npt.NDArray[np.int64]:
    return np.array([row_of.setdefault(one, len(row_of)) for one in ids.tolist()], np.int64)


def _lengths(rows: Sequence[int], count: int) -> npt.NDArray[np.float64]:
    return np.bincount(np.asarray(rows, np.int64), minlength=count).astype(np.float64)
