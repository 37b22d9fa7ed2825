"""What a detector is worth at the confidence at which it is used, and whether its confidence is true.

A box is right where it is matched one to one, at IoU 0.5 or more, with a label of its class (`judged.matched_rows`).
Expected calibration error is that of Guo et al. 2017 (https://arxiv.org/abs/1706.04599), over boxes instead of
pictures as Küppers et al. 2020 (https://arxiv.org/abs/2004.13546): boxes fall into 15 bins of equal width by their
confidence; the difference between mean confidence and share of right boxes of each bin, weighted by its boxes.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hvt_study.metrics.judged import Judged, matched_rows

BINS = 15
_DRAWS = 200
_EPSILON = 1e-4


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """Counts at one confidence; shares are NaN where nothing can be divided."""

    right: int
    boxes: int
    labels: int

    @property
    def precision(self) -> float:
        """Right boxes of all boxes."""
        return self.right / self.boxes if self.boxes else math.nan

    @property
    def recall(self) -> float:
        """Right boxes of all labels."""
        return self.right / self.labels if self.labels else math.nan

    @property
    def f1(self) -> float:
        """Harmonic mean of both: 2 right / (boxes + labels)."""
        return 2 * self.right / (self.boxes + self.labels) if self.boxes + self.labels else math.nan


def right_boxes(
    frame: Judged, *, classes: Collection[str]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Rows of the labels, and of the boxes, that are matched with one of the same class."""
    names, shown = np.array(frame.class_names, str), np.array(frame.view.class_names, str)
    pairs = [np.empty((0, 2), np.int64)]
    for name in classes:
        there, here = np.flatnonzero(names == name), np.flatnonzero(shown == name)
        found = matched_rows(frame.boxes_xyxy_px[there], frame.view.boxes_xyxy_px[here].astype(np.float64))
        pairs.append(np.stack((there[found[:, 0]], here[found[:, 1]]), axis=1))
    both = np.concatenate(pairs)
    return both[:, 0], both[:, 1]


def operating_point(frames: Sequence[Judged], *, name: str) -> OperatingPoint:
    """Of one class, over pictures that hold only boxes at or above the confidence of use."""
    right = sum(len(right_boxes(frame, classes=[name])[0]) for frame in frames)
    boxes = sum(frame.view.class_names.count(name) for frame in frames)
    return OperatingPoint(right, boxes, sum(frame.class_names.count(name) for frame in frames))


def calibration_error(confidences: npt.NDArray[np.float64], right: npt.NDArray[np.bool_]) -> float:
    """Expected calibration error, 0…1, of (N,) confidences in 0…1 and whether each was right; NaN of none."""
    if not len(confidences):
        return math.nan
    which = np.minimum((confidences * BINS).astype(np.int64), BINS - 1)
    count = np.bincount(which, minlength=BINS)
    gap = np.abs(np.bincount(which, confidences, BINS) - np.bincount(which, right, BINS))
    return float(gap[count > 0].sum() / len(confidences))


def chance_error(confidences: npt.NDArray[np.float64]) -> float:
    """The calibration error that so few boxes have in the mean though each confidence is true; NaN of none."""
    draws = np.random.default_rng(0).random((_DRAWS, len(confidences))) < confidences
    return float(np.mean([calibration_error(confidences, right) for right in draws]))


def fitted_line(confidences: npt.NDArray[np.float64], right: npt.NDArray[np.bool_]) -> tuple[float, float]:
    """Slope and shift of the line through the logits that makes these true (Platt 1999), by Newton's method."""
    count = np.count_nonzero(right)
    target = np.where(
        right, (count + 1) / (count + 2), 1 / (len(right) - count + 2)
    )  # where all are right too
    logits = np.column_stack((_logits(confidences), np.ones(len(confidences))))
    line = np.array([1.0, 0.0])
    for _ in range(20):
        true = (1 + np.tanh(logits @ line / 2)) / 2
        bend = logits.T @ (logits * (true * (1 - true))[:, None]) + _EPSILON * np.eye(2)
        line += np.linalg.solve(bend, logits.T @ (target - true))
    return float(line[0]), float(line[1])


def along_line(confidences: npt.NDArray[np.float64], line: tuple[float, float]) -> npt.NDArray[np.float64]:
    """(N,) confidences after a line through their logits."""
    return np.asarray((1 + np.tanh((line[0] * _logits(confidences) + line[1]) / 2)) / 2)


def _logits(confidences: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    clipped = np.clip(confidences, _EPSILON, 1 - _EPSILON)
    return np.asarray(np.log(clipped / (1 - clipped)))
