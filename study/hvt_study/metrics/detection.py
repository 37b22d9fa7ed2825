"""Detection: mean average precision after COCO, by the kept library ``faster-coco-eval``.

Average precision is COCO's: precision interpolated at 101 recalls, mean over classes that have labels, at IoU 0.5 and
as the mean over 0.5, 0.55 … 0.95 (Lin et al. 2014, https://cocodataset.org/#detection-eval). Two things are as in
VisDrone's toolkit (Zhu et al. 2021, VisDrone2018-DET-toolkit) and not as in COCO: up to 500 boxes of a class count in
a frame instead of 100, because aerial frames hold more; and ignored regions (see `judged`).

In a flight it is of base frames: those that the ground has decoded and detected on, not the list at every frame.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from faster_coco_eval import COCO
from faster_coco_eval.core.faster_eval_api import COCOeval_faster

from hvt_study.metrics.judged import LARGEST_PX2, LIMITS_PX2, SIZES, Judged, Size

_MOST_BOXES: Final = 500
_Precision = npt.NDArray[np.float64]
_Frame = tuple[npt.NDArray[Any], Sequence[str], npt.NDArray[Any]]
"""Boxes, names and confidences."""


@dataclass(frozen=True, slots=True)
class AveragePrecision:
    """0…1; NaN where there is no label of the kind."""

    at_50: float = math.nan
    at_50_95: float = math.nan
    """Mean over IoU 0.5, 0.55 … 0.95."""


@dataclass(frozen=True, slots=True)
class DetectionScore:
    """Score of one sequence."""

    mean: AveragePrecision
    """Over the classes that have labels."""
    by_class: Mapping[str, AveragePrecision]
    by_size: Mapping[Size, AveragePrecision]
    """Mean over classes, of labels of one size; boxes of other sizes that match nothing do not count."""


def detection_score(frames: Sequence[Judged]) -> DetectionScore:
    """Average precision of boxes and names as shown, by confidence, over frames that were detected on."""
    names = sorted({name for one in frames for name in one.class_names})
    if not names:
        nothing = AveragePrecision()
        return DetectionScore(nothing, {}, dict.fromkeys(SIZES, nothing))
    by_name = _precision(frames, names)
    return DetectionScore(
        mean=_mean(by_name[:, :, :, 0]),
        by_class={name: _mean(by_name[:, :, k, 0]) for k, name in enumerate(names)},
        by_size={size: _mean(by_name[:, :, :, a]) for a, size in enumerate(SIZES, start=1)},
    )


def _precision(frames: Sequence[Judged], names: Sequence[str]) -> _Precision:
    """(10 IoUs, 101 recalls, classes, 4 sizes with all of them first); -1 where there is no label."""
    category = {name: number for number, name in enumerate(names, start=1)}
    labels = [(frame.boxes_xyxy_px, frame.class_names, np.ones(len(frame.ids))) for frame in frames]
    boxes = [(one.view.boxes_xyxy_px, one.view.class_names, one.view.confidences) for one in frames]
    truth, found = _dataset(category, labels), _dataset(category, boxes)
    small, large = LIMITS_PX2
    ranges = {"small": [0.0, small], "medium": [small, large], "large": [large, LARGEST_PX2]}
    run = COCOeval_faster(COCO(truth), COCO(found), "bbox", ranges=ranges)
    run.params.maxDets = [_MOST_BOXES]
    run.evaluate()
    run.accumulate()
    return np.asarray(run.eval["precision"], np.float64)[..., 0]


def _dataset(category: Mapping[str, int], frames: Sequence[_Frame]) -> dict[str, Any]:
    """COCO's, of boxes whose names are categories."""
    found = [
        (number, box, category[name], score)
        for number, (boxes, names, scores) in enumerate(frames, start=1)
        for box, name, score in zip(boxes.tolist(), names, scores.tolist(), strict=True)
        if name in category
    ]
    return {
        "info": {},
        "images": [{"id": number, "width": 1, "height": 1} for number in range(1, len(frames) + 1)],
        "categories": [{"id": number, "name": name} for name, number in category.items()],
        "annotations": [
            {
                "id": number,
                "image_id": frame,
                "category_id": kind,
                "score": score,
                "iscrowd": 0,
                "bbox": [x1, y1, x2 - x1, y2 - y1],
                "area": (x2 - x1) * (y2 - y1),
            }
            for number, (frame, (x1, y1, x2, y2), kind, score) in enumerate(found, start=1)
        ],
    }


def _mean(precision: _Precision) -> AveragePrecision:
    """Mean of (IoUs, recalls, …), over classes with labels."""
    return AveragePrecision(_known_mean(precision[0]), _known_mean(precision))


def _known_mean(precision: _Precision) -> float:
    known = precision[precision > -1]
    return float(known.mean()) if known.size else math.nan
