"""Scores that mean something: a line through the logits, fitted on pictures that were not trained on (Platt 1999)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import log_softmax
from sklearn.linear_model import LogisticRegression

from hvt_common.inference.classify import Classifier
from hvt_common.inference.detect import Detector
from hvt_common.values import Image, iou
from hvt_train.pictures.real import HeldOut

_LEAST_IOU = 0.5
_EPSILON = 1e-4


@dataclass(frozen=True, slots=True)
class Calibration:
    """A score s becomes sigmoid(slope * logit(s) + shift)."""

    slope: float = 1.0
    shift: float = 0.0
    confidence: float = 0.25
    """Calibrated score from which on boxes should be shown: where F1 is best on the held-out pictures."""


NONE = Calibration()


def fit_calibration(detector: Detector, pictures: Iterable[HeldOut]) -> Calibration:
    """Fit to how often a box of a score is right: on a label, at IoU 0.5, whatever its class.

    ``detector`` should show boxes from a low confidence on (0.02).
    """
    scores, right, objects = [], [], 0
    for picture in pictures:
        objects += len(picture.boxes_px)
        found = detector.detect(picture.image_bgr)
        boxes, taken = found.boxes_xyxy_px, np.zeros(len(picture.boxes_px), bool)
        on_label, on_ignored = iou(boxes, picture.boxes_px), iou(boxes, picture.ignored_px)
        for row, kind in enumerate(found.class_ids.tolist()):
            if detector.class_names[kind] not in picture.judged:
                continue
            free = np.where(taken, 0.0, on_label[row])
            hit = bool(len(free)) and free.max() >= _LEAST_IOU
            if hit:
                taken[free.argmax()] = True
            elif len(picture.ignored_px) and on_ignored[row].max() > 0:
                continue
            scores.append(float(found.confidences[row]))
            right.append(hit)
    values = np.clip(np.array(scores), _EPSILON, 1 - _EPSILON)
    logits = np.log(values / (1 - values))[:, None]
    line = LogisticRegression(C=1e6).fit(logits, np.array(right))
    best = _best_threshold(line.predict_proba(logits)[:, 1], np.array(right), objects)
    return Calibration(float(line.coef_[0, 0]), float(line.intercept_[0]), best)


def fit_temperature(classifier: Classifier, stills: Iterable[tuple[Image, str]]) -> float:
    """The number by which logits are divided so that probabilities are true on ``stills`` (Guo et al., 2017)."""
    images, names = zip(*stills, strict=True)
    truth = np.array([classifier.class_names.index(name) for name in names])
    logits = np.log(np.array([said.probabilities for said in classifier.classify(list(images))]) + 1e-9)

    def surprise(temperature: float) -> float:
        return float(-log_softmax(logits / temperature, axis=1)[np.arange(len(truth)), truth].mean())

    return min((float(one) for one in np.geomspace(0.3, 6, 61)), key=surprise)


def _best_threshold(scores: npt.NDArray[np.float64], right: npt.NDArray[np.bool_], objects: int) -> float:
    """The step of a twentieth where F1 = 2 PR / (P + R) is greatest."""

    def quality(threshold: float) -> float:
        shown = scores >= threshold
        hits = float((shown & right).sum())
        return 2 * hits / max(objects + float(shown.sum()), 1e-9)

    return max((round(0.05 * step, 2) for step in range(2, 17)), key=quality)
