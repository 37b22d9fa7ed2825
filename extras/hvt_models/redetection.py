"""``--classifier detector``: the detector again, on the base picture with the sharp stills in their places.

Crops map to base pixels by `View`, which is affine, so a still is pasted with sub-pixel alignment: boxes map by
their edges, `cv2.warpAffine` by pixel centres. The picture may also be made larger than the base (``zoom``), for a
network whose input is: it would enlarge the base itself, and the stills have the detail that the base has not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from hvt_common.inference.detect import FailingDetector, OnnxDetector
from hvt_common.inference.retried import RetriedDetector
from hvt_common.values import Boxes, Detections, Image, Posterior, View, intersections, iou
from hvt_common.video.base_crop import resampled
from hvt_ground.perception.stills.classify import FrameReadings, ObjectReading, silent
from hvt_ground.perception.stills.decode import DecodedStill, box_of

_SAME_OBJECT_IOU = 0.4
"""A detection on the composite that overlaps an object's box less is of something else."""
_NEW_OBJECT_IOU = 0.2
"""A detection that overlaps a named object more is not of a new one: a second box of the same, most often."""
_INSIDE_SHARE = 0.9
"""How much of a new object's box must lie inside a still: elsewhere the picture is the old one."""
_FEATHER_PX = 1.5
"""Width of the seam in pixels of the result. A detector takes a hard edge for a contour."""


def composite(base_bgr: Image, stills: Sequence[DecodedStill], *, view: View, zoom: float = 1.0) -> Image:
    """The base picture with each still in its place, ``zoom`` times as large as the base; a copy.

    Later stills lie over earlier ones. Cubic where it is enlarged, area means where it is shrunk.
    """
    if zoom == 1:
        picture = base_bgr.copy()
    else:
        height, width = base_bgr.shape[:2]
        size = (max(1, round(width * zoom)), max(1, round(height * zoom)))
        picture = resampled(base_bgr, (0.0, 0.0), (1 / zoom, 1 / zoom), size)
    for still in stills:
        _paste(picture, still, view, zoom)
    return picture


def _paste(picture: Image, still: DecodedStill, view: View, zoom: float) -> None:
    offset = view.offset_px * 2
    x1, y1, x2, y2 = (
        (edge * view.scale + offset[axis]) * zoom for axis, edge in enumerate(still.crop_source_px)
    )
    left, top = max(0, math.floor(x1)), max(0, math.floor(y1))
    right, bottom = min(picture.shape[1], math.ceil(x2)), min(picture.shape[0], math.ceil(y2))
    if right <= left or bottom <= top:
        return
    still_height, still_width = still.image_bgr.shape[:2]
    step_x, step_y = still_width / (x2 - x1), still_height / (y2 - y1)
    origin = ((left - x1) * step_x, (top - y1) * step_y)
    image = resampled(still.image_bgr, origin, (step_x, step_y), (right - left, bottom - top))
    across = _coverage(np.arange(left, right) + 0.5, x1, x2)
    down = _coverage(np.arange(top, bottom) + 0.5, y1, y2)
    opacity = np.outer(down, across).astype(np.float32)[..., None]
    place = picture[top:bottom, left:right]
    np.copyto(place, np.rint(place * (1 - opacity) + image * opacity).astype(np.uint8))


def _coverage(centres: npt.NDArray[np.floating[Any]], first: float, last: float) -> npt.NDArray[np.float64]:
    # How much each pixel of a line shows of the interval ``first``…``last``, rising over the feather.
    depth = np.minimum(centres - first, last - centres) + 0.5
    return np.asarray(np.clip(depth / _FEATHER_PX, 0, 1), np.float64)


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
            return silent(stills)
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


def _share_inside(boxes: Boxes, areas: Boxes) -> npt.NDArray[np.float64]:
    # (N, M): how much of each of N boxes lies in each of M areas, 0…1.
    whole = np.clip(boxes[:, 2:] - boxes[:, :2], 1e-6, None).prod(axis=1)
    return np.asarray(intersections(boxes, areas) / whole[:, None], np.float64)
