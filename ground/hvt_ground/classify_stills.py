"""What a still shows: a classifier on the crop, or the detector again on the picture with the still pasted in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from hvt_common.values import Image, Posterior, View
from hvt_common.vision.boxes import iou
from hvt_common.vision.classify import Classifier
from hvt_common.vision.detect import Detector

__all__ = ["CropReader", "Decoded", "NoReader", "Redetection", "StillReader"]

_SAME_OBJECT_IOU = 0.4
"""A detection on the composite that overlaps the still's box less is of something else."""


@dataclass(frozen=True, slots=True)
class Decoded:
    """A decoded still and where it belongs."""

    image_bgr: Image
    crop_source_px: tuple[int, int, int, int]
    box_base_px: tuple[float, float, float, float]
    frame_index: int


class StillReader(Protocol):
    """Names what stills show."""

    @property
    def class_names(self) -> tuple[str, ...]:
        """Of the posteriors."""
        ...

    def read(self, stills: Sequence[Decoded], base_bgr: Image | None) -> list[Posterior | None]:
        """One answer a still, None where there is nothing to say.

        All stills are of one frame, ``base_bgr`` is that frame decoded, where it is still at hand.
        """
        ...


class NoReader:
    """Shows stills and says nothing of them: what a ground without any model does."""

    class_names: tuple[str, ...] = ("object",)

    def read(self, stills: Sequence[Decoded], base_bgr: Image | None) -> list[Posterior | None]:  # noqa: ARG002
        """Nothing."""
        return [None] * len(stills)


class CropReader:
    """An image classifier on the crop alone, all stills of a frame in one call."""

    def __init__(self, classifier: Classifier) -> None:
        self._classifier = classifier

    @property
    def class_names(self) -> tuple[str, ...]:
        """The classifier's."""
        return self._classifier.class_names

    def read(self, stills: Sequence[Decoded], base_bgr: Image | None) -> list[Posterior | None]:  # noqa: ARG002
        """The classifier's posteriors."""
        return list(self._classifier.classify([still.image_bgr for still in stills]))


class Redetection:
    """Pastes the stills into the decoded frame at their places and detects on the composite, once a frame.

    The detector sees the object sharp and in its surroundings, which is what it was trained on.
    """

    def __init__(self, detector: Detector, *, view: View) -> None:
        self._detector = detector
        self._view = view

    @property
    def class_names(self) -> tuple[str, ...]:
        """The detector's."""
        return self._detector.class_names

    def read(self, stills: Sequence[Decoded], base_bgr: Image | None) -> list[Posterior | None]:
        """The class of the detection that overlaps each still's box best; None where there is none."""
        if base_bgr is None:
            return [None] * len(stills)
        found = self._detector.detect(composite(base_bgr, stills, view=self._view))
        answers: list[Posterior | None] = []
        for still in stills:
            overlaps = iou(np.array([still.box_base_px], np.float32), found.boxes_xyxy_px)[0]
            best = int(overlaps.argmax()) if len(overlaps) else -1
            if best < 0 or overlaps[best] < _SAME_OBJECT_IOU:
                answers.append(None)
            else:
                answers.append(self._posterior(int(found.class_ids[best]), float(found.confidences[best])))
        return answers

    def _posterior(self, class_id: int, confidence: float) -> Posterior:
        """A detector scores one class only; what is left is spread evenly over the others."""
        names = self.class_names
        rest = (1 - confidence) / max(1, len(names) - 1)
        probabilities = np.full(len(names), rest, np.float32)
        probabilities[class_id] = confidence if len(names) > 1 else 1.0
        known = probabilities[probabilities > 0]
        entropy = float(-(known * np.log(known)).sum())
        return Posterior(names[class_id], confidence, entropy, probabilities)


def composite(base_bgr: Image, stills: Sequence[Decoded], *, view: View) -> Image:
    """The base frame with each still in its place, at base resolution; a copy."""
    picture = base_bgr.copy()
    height, width = picture.shape[:2]
    for still in stills:
        corners = view.to_base(np.array([still.crop_source_px], np.float32))[0]
        x1, y1, x2, y2 = (round(float(value)) for value in corners)
        if x2 <= x1 or y2 <= y1:
            continue
        size = (x2 - x1, y2 - y1)
        shrinks = size[0] * size[1] < still.image_bgr.shape[0] * still.image_bgr.shape[1]
        patch = cv2.resize(
            still.image_bgr, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
        )
        left, top, right, bottom = max(0, x1), max(0, y1), min(width, x2), min(height, y2)
        if right > left and bottom > top:
            picture[top:bottom, left:right] = patch[top - y1 : bottom - y1, left - x1 : right - x1]
    return picture
