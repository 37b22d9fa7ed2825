"""Names the objects of a still: a classifier on the crop, or the detector on the picture with stills pasted in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from hvt_common.inference.classify import Classifier
from hvt_common.inference.detect import FailingDetector, OnnxDetector
from hvt_common.inference.retried import RetriedDetector
from hvt_common.values import Boxes, Detections, Image, Posterior, View, iou
from hvt_ground.perception.stills.composite import composite
from hvt_ground.perception.stills.decode import Box, DecodedStill, box_of

_SAME_OBJECT_IOU = 0.4
"""A detection on the composite that overlaps an object's box less is of something else."""
_NEW_OBJECT_IOU = 0.2
"""A detection that overlaps a named object more is not of a new one: a second box of the same, most often."""
_INSIDE_SHARE = 0.9
"""How much of a new object's box must lie inside a still: elsewhere the picture is the old one."""

_PADDING = 0.15
"""Share of an object's width and height on each side, as the edge pads a crop."""


@dataclass(frozen=True, slots=True)
class ObjectReading:
    """The reading of one object in a still."""

    posterior: Posterior | None = None
    """None is no opinion."""
    box_base_px: Box | None = None
    """The object's box at the still's frame; None if the reader finds no boxes."""


@dataclass(frozen=True, slots=True)
class FrameReadings:
    """The readings of all stills of one frame."""

    objects: tuple[tuple[ObjectReading, ...], ...]
    """For each still, in order: the lead object's reading, then one for each ``also`` box."""
    found: Detections = field(default_factory=Detections.none)
    """Objects that were seen inside a still and are none of the named ones; base pixels, class ids of the reader's
    ``class_names``. Some may be tracks that the caller knows already."""


class StillReader(Protocol):
    """Names the objects in stills."""

    @property
    def wants_base(self) -> bool:
        """It uses the base frame: all stills wait for theirs, not only residuals."""

    @property
    def class_names(self) -> tuple[str, ...]:
        """The classes of the posteriors, and of ``found``."""

    def read(self, stills: Sequence[DecodedStill], base_bgr: Image | None) -> FrameReadings:
        """One reading for every object of every still.

        All stills are of one frame, ``base_bgr`` is that frame decoded, where it is still at hand.
        """


def _silent(stills: Sequence[DecodedStill]) -> FrameReadings:
    return FrameReadings(tuple((ObjectReading(),) * len(still.boxes_base_px) for still in stills))


class NoReader:
    """Shows stills without any names: the reader of a ground without models."""

    wants_base = False
    class_names: tuple[str, ...] = ("object",)

    def read(self, stills: Sequence[DecodedStill], base_bgr: Image | None) -> FrameReadings:  # noqa: ARG002
        return _silent(stills)


class CropReader:
    """An image classifier on the crop alone, all objects of a frame's stills in one call."""

    wants_base = False

    def __init__(self, classifier: Classifier, *, view: View) -> None:
        self._classifier = classifier
        self._view = view

    @property
    def class_names(self) -> tuple[str, ...]:
        return self._classifier.class_names

    def read(self, stills: Sequence[DecodedStill], base_bgr: Image | None) -> FrameReadings:  # noqa: ARG002
        """The classifier's posteriors; it finds neither boxes nor new objects."""
        crops = [crop for still in stills for crop in object_crops(still, view=self._view)]
        said = self._classifier.classify(crops)
        if len(said) < len(crops):  # its model fails
            return _silent(stills)
        answers = iter(said)
        return FrameReadings(
            tuple(tuple(ObjectReading(next(answers)) for _ in still.boxes_base_px) for still in stills)
        )


class Redetection:
    """Pastes the stills into the decoded frame at their places and detects on the composite, once a frame.

    The detector sees the objects sharp and in their surroundings, as in its training. Where its input
    is larger than the base, so is the composite, and the stills keep their detail. A class or a box counts from the
    detector's confidence on, an object that nobody has named from ``new_confidence`` on.
    """

    wants_base = True

    def __init__(self, detector: FailingDetector, *, view: View, new_confidence: float = 0.5) -> None:
        self._detector = detector
        self._view = view
        self._new_confidence = new_confidence

    @property
    def class_names(self) -> tuple[str, ...]:
        return self._detector.class_names

    def read(self, stills: Sequence[DecodedStill], base_bgr: Image | None) -> FrameReadings:
        """Class and box of the detection at each object's place; no opinion without one."""
        if base_bgr is None or not stills:
            return _silent(stills)
        found = self._detect(stills, base_bgr)
        named = np.array([box for still in stills for box in still.boxes_base_px], np.float32)
        overlaps = iou(named, found.boxes_xyxy_px)
        answers = iter(self._readings(found, overlaps))
        return FrameReadings(
            tuple(tuple(next(answers) for _ in still.boxes_base_px) for still in stills),
            self._new(found, overlaps, stills),
        )

    def _detect(self, stills: Sequence[DecodedStill], base_bgr: Image) -> Detections:
        # On the composite; base pixels.
        zoom = self._zoom((base_bgr.shape[1], base_bgr.shape[0]))
        found = self._detector.detect(composite(base_bgr, stills, view=self._view, zoom=zoom))
        found = found or Detections.none()
        boxes = (found.boxes_xyxy_px / zoom).astype(np.float32)
        return Detections(boxes, found.confidences, found.class_ids)

    def _zoom(self, base_size: tuple[int, int]) -> float:
        # Objects keep the size that the network sees on the base: enlarging them beyond it made classes worse.
        detector = self._detector.part if isinstance(self._detector, RetriedDetector) else self._detector
        if not isinstance(detector, OnnxDetector):
            return 1.0
        width, height = detector.input_size(base_size)
        return max(1.0, min(width / base_size[0], height / base_size[1], 1 / self._view.scale))

    def _readings(self, found: Detections, overlaps: npt.NDArray[np.float64]) -> list[ObjectReading]:
        if not len(found):
            return [ObjectReading()] * len(overlaps)
        owners = overlaps.argmax(axis=0)
        readings = []
        for row, overlap in enumerate(overlaps):
            at_place = np.flatnonzero((overlap >= _SAME_OBJECT_IOU) & (owners == row))
            if not len(at_place):
                readings.append(ObjectReading())
                continue
            # The best box, not the most confident: that is right more often, since a
            # neighbour's detection may be more confident than the object's own.
            best = int(at_place[np.argmax(overlap[at_place])])
            readings.append(
                ObjectReading(self._posterior(found, best, at_place), box_of(found.boxes_xyxy_px[best]))
            )
        return readings

    def _posterior(self, found: Detections, best: int, others: npt.NDArray[np.intp]) -> Posterior:
        # Another class with a box of its own there is a second opinion: its score counts, for no more than ``best``.
        names, score = self.class_names, float(found.confidences[best])
        scores = np.zeros(len(names), np.float64)
        np.maximum.at(scores, found.class_ids[others], np.minimum(found.confidences[others], score))
        unseen = scores == 0
        if unseen.any():
            scores[unseen] = max(0.0, 1 - scores.sum()) / unseen.sum()
        probabilities = (scores / scores.sum()).astype(np.float32)
        named = int(found.class_ids[best])
        known = probabilities[probabilities > 0]
        entropy = max(0.0, float(-(known * np.log(known)).sum()))
        return Posterior(names[named], float(probabilities[named]), entropy, probabilities)

    def _new(
        self, found: Detections, overlaps: npt.NDArray[np.float64], stills: Sequence[DecodedStill]
    ) -> Detections:
        crops = self._view.to_base(np.array([still.crop_source_px for still in stills], np.float32))
        inside = _share_inside(found.boxes_xyxy_px, crops).max(axis=1) >= _INSIDE_SHARE
        unnamed = overlaps.max(axis=0) < _NEW_OBJECT_IOU
        new = inside & unnamed & (found.confidences >= self._new_confidence)
        return found.take(new)


def object_crops(still: DecodedStill, *, view: View) -> list[Image]:
    """The picture of each object in a still, the lead's first: its box with the still's padding.

    A still of one object is that picture already.
    """
    if len(still.boxes_base_px) == 1:
        return [still.image_bgr]
    height, width = still.image_bgr.shape[:2]
    x1, y1, x2, y2 = still.crop_source_px
    boxes = view.to_source(np.array(still.boxes_base_px, np.float32)).astype(np.float64)
    sides = boxes[:, 2:] - boxes[:, :2]
    grown = boxes + np.hstack([-sides, sides]) * _PADDING
    pixels = (grown - [x1, y1, x1, y1]) * ([width / (x2 - x1), height / (y2 - y1)] * 2)
    first = np.clip(np.floor(pixels[:, :2]), 0, [width - 1, height - 1]).astype(int)
    last = np.clip(np.ceil(pixels[:, 2:]), first + 1, [width, height]).astype(int)
    return [
        still.image_bgr[top:bottom, left:right]
        for (left, top), (right, bottom) in zip(first.tolist(), last.tolist(), strict=True)
    ]


def _share_inside(boxes: Boxes, areas: Boxes) -> npt.NDArray[np.float64]:
    # (N, M): how much of each of N boxes lies in each of M areas, 0…1.
    first = np.maximum(boxes[:, None, :2], areas[None, :, :2])
    last = np.minimum(boxes[:, None, 2:], areas[None, :, 2:])
    shared = np.clip(last - first, 0, None).prod(axis=2)
    whole = np.clip(boxes[:, 2:] - boxes[:, :2], 1e-6, None).prod(axis=1)
    return np.asarray(shared / whole[:, None], np.float64)
