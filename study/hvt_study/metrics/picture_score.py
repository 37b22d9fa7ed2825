"""One table of what a detector is worth on labelled pictures: at the confidence of use, and over the whole curve."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from hvt_common.inference.class_names import kind_of
from hvt_study.metrics.detection import AveragePrecision, DetectionScore
from hvt_study.metrics.frames import LabelledFrame
from hvt_study.metrics.judged import Judged
from hvt_study.metrics.operating_point import OperatingPoint, calibration_error, operating_point, right_boxes

_VEHICLE = "vehicle"
VEHICLES = frozenset({"car", "truck", "bus", _VEHICLE})
"""Kinds that `as_one` takes for one."""


def as_one(name: str) -> str:
    """The kind of a class, all vehicles being one."""
    kind = kind_of(name)
    return _VEHICLE if kind in VEHICLES or kind.endswith(_VEHICLE) else kind


def above(frames: Sequence[LabelledFrame], confidence: float) -> list[LabelledFrame]:
    """Only boxes at or above a confidence."""
    return [(labels, view.rows(view.confidences >= confidence)) for labels, view in frames]


def picture_score(
    used: Sequence[Judged], curve: DetectionScore, *, recall_only: bool = False
) -> dict[str, Any]:
    """What ``score.json`` holds; None stands for what cannot be said.

    Args:
        used: pictures that hold only boxes at or above the confidence of use.
        curve: average precision, of boxes of all confidences.
        recall_only: not all objects are labelled, so that no box is known to be wrong.
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
    return None if math.isnan(value) else round(value, 4)
