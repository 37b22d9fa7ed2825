"""The worth of a detector on labelled pictures: at the confidence of use and over the whole curve.

A box is right where it is matched one to one, at IoU 0.5 or more, with a label of its class (`judged.matched_rows`).
Expected calibration error is that of Guo et al. 2017 (https://arxiv.org/abs/1706.04599), over boxes instead of
pictures as Küppers et al. 2020 (https://arxiv.org/abs/2004.13546): boxes fall into 15 bins of equal width by their
confidence; the difference between mean confidence and share of right boxes of each bin, weighted by its boxes.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import expit, logit

from hvt_common.inference.class_names import kind_of
from hvt_study.datasets.class_map import VEHICLE, VEHICLES
from hvt_study.metrics.detection import AveragePrecision, DetectionScore
from hvt_study.metrics.judged import Judged, LabelledFrame, matched_rows

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
        return self.right / self.boxes if self.boxes else math.nan

    @property
    def recall(self) -> float:
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
    """The operating point of one class, over pictures that hold only boxes at or above the confidence of use."""
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
        true = expit(logits @ line)
        bend = logits.T @ (logits * (true * (1 - true))[:, None]) + _EPSILON * np.eye(2)
        line += np.linalg.solve(bend, logits.T @ (target - true))
    return float(line[0]), float(line[1])


def along_line(confidences: npt.NDArray[np.float64], line: tuple[float, float]) -> npt.NDArray[np.float64]:
    """(N,) confidences after a line through their logits."""
    return np.asarray(expit(line[0] * _logits(confidences) + line[1]))


def _logits(confidences: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.asarray(logit(np.clip(confidences, _EPSILON, 1 - _EPSILON)))


def as_one(name: str) -> str:
    """The kind of a class, all vehicles being one."""
    kind = kind_of(name)
    return VEHICLE if kind in VEHICLES or kind.endswith(VEHICLE) else kind


def above(frames: Sequence[LabelledFrame], confidence: float) -> list[LabelledFrame]:
    return [(labels, view.rows(view.confidences >= confidence)) for labels, view in frames]


def picture_score(
    used: Sequence[Judged], curve: DetectionScore, *, recall_only: bool = False
) -> dict[str, Any]:
    """The content of ``score.json``: of boxes from the confidence of use on, and of the whole ``curve``.

    None stands for an unknown figure: with ``recall_only`` no box is known to be wrong.
    """
    seen = sorted({name for one in used for name in (*one.class_names, *one.view.class_names)})
    points = {name: operating_point(used, name=name) for name in seen}
    counts = ([getattr(one, field) for one in points.values()] for field in ("right", "boxes", "labels"))
    all_in_all = _shares(OperatingPoint(*map(sum, counts)), curve.mean)
    by_class = {
        name: _shares(one, curve.by_class.get(name, AveragePrecision())) for name, one in points.items()
    }
    if recall_only:
        found = {name: _recall_of(one) for name, one in by_class.items() if one["labels"]}
        return {"recall_only": True, **_recall_of(all_in_all), "calibration_error": None, "by_class": found}
    return {
        **all_in_all,
        "ap50_95": _number(curve.mean.at_50_95),
        "ap50_by_size": {size: _number(one.at_50) for size, one in curve.by_size.items()},
        "calibration_error": _number(calibration_error(*sure_and_right(used, seen))),
        "by_class": by_class,
    }


def _shares(point: OperatingPoint, curve: AveragePrecision) -> dict[str, Any]:
    return {
        "labels": point.labels,
        "boxes": point.boxes,
        "precision": _number(point.precision),
        "recall": _number(point.recall),
        "f1": _number(point.f1),
        "ap50": _number(curve.at_50),
    }


def _recall_of(shares: dict[str, Any]) -> dict[str, Any]:
    return {name: value if name in ("labels", "recall") else None for name, value in shares.items()}


def sure_and_right(
    frames: Sequence[Judged], names: Collection[str]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """(N,) the confidences of all boxes, and which of them are right."""
    right = [np.zeros(len(frame.view), np.bool_) for frame in frames]
    for flags, frame in zip(right, frames, strict=True):
        flags[right_boxes(frame, classes=names)[1]] = True
    sure = [frame.view.confidences.astype(np.float64) for frame in frames]
    return np.concatenate([*sure, np.zeros(0)]), np.concatenate([*right, np.zeros(0, np.bool_)])


def _number(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 6)
