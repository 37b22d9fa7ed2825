"""A detector without weights: objects that move against the ground, seen from a camera that may move itself.

Each image is compared with the last few, brought into its own coordinates by the camera's motion:

1. The camera's motion since the last call (`CameraMotion`) is chained, so that each stored image can be warped onto
   the new one.
2. A pixel differs from a stored image by as much as it lies outside the values of its 3x3 neighbourhood there
   (tolerant difference): a misalignment of a pixel, or the ringing of a coarse quantiser along an edge, costs
   nothing.
3. The lower median over the stored images counts: an object differs from most of them, the ground that it has just
   left only from a few, so nothing trails behind and no background model is learnt. A region must also differ, in
   part, from all stored images but one: the place that a parked object has left is gone after two more calls.
4. The threshold follows the noise of these very differences (median absolute deviation, Rousseeuw and Croux 1993), so
   coding noise stays below it; closing, connected components and merging make boxes.

It is meant to be called on every n-th frame, three to five times a second, and finds objects that move by about their
own size within the calls it remembers. Limits: it is silent in its first calls, a shadow belongs to its object,
parallax of tall things near a fast camera looks like motion, and an object that stood still for a second or two is
not seen.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.camera_motion import Affine, CameraMotion
from hvt_common.inference.class_names import MOVING
from hvt_common.inference.letterbox import as_bgr
from hvt_common.inference.nms import MAX_DETECTIONS, components
from hvt_common.values import Detections, Image

_Gray = npt.NDArray[np.uint8]
_Floats = npt.NDArray[np.float64]

_SQUARE = np.ones((3, 3), np.uint8)
_INSET_PX = np.array([[2, 2], [-3, 2], [-3, -3], [2, -3]], float)  # the rim of a warped image is no view
_STILL_PX = 0.1  # a camera that moved the corners less than this is not worth a warp


@dataclass(frozen=True, slots=True)
class MotionSettings:
    """The limits of a moving object; lengths are pixels of the working image (`max_side_px`)."""

    memory_calls: int = 6
    """The number of earlier images to compare with."""
    least_calls: int = 2
    """Silent until this many images are stored."""
    max_side_px: int = 1280
    """A larger image is first scaled down to this longer side."""
    noise_factor: float = 6.0
    """A pixel moves when its difference exceeds this many standard deviations of this image's differences …"""
    least_difference: float = 9.0
    """… and this many grey levels of 255."""
    seed_share: float = 0.2
    """Share of a region that must differ from all stored images but one."""
    join_px: int = 7
    """Parts nearer than this become one region."""
    near_share: float = 0.3
    """Regions that overlap when grown by this share of their shortest side become one object."""
    least_area_px: int = 24
    """Smaller specks are noise, and so is …"""
    least_side_px: int = 4
    """… a region thinner than this, or …"""
    largest_aspect: float = 8.0
    """… longer than this many times its width: the border of a letterboxed picture, for one."""
    largest_share: float = 0.25
    """A larger share of the image is no object."""
    scene_change_share: float = 0.4
    """When more than this share of the image differs, it is a scene change, and the history is cleared."""


class MotionDetector:
    """Finds moving objects; stateful: one instance for one stream of images in order."""

    class_names: tuple[str, ...] = (MOVING,)

    def __init__(self, *, confidence: float = 0.25) -> None:
        self._settings = MotionSettings()
        self._confidence = confidence
        self._camera = CameraMotion()
        self._history: deque[tuple[_Gray, Affine]] = deque(maxlen=self._settings.memory_calls)

    def detect(self, image_bgr: Image) -> Detections:
        """Moving objects in this image, in its pixels, best first; the image is remembered for the next calls.

        An image of another size than the last starts afresh.
        """
        image = _shrunk(as_bgr(image_bgr), self._settings.max_side_px)
        gray = np.asarray(cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), (3, 3), 0), np.uint8)
        if self._history and self._history[-1][0].shape != gray.shape:
            self.reset()
        self._move_history(self._camera.step(image))
        boxes, confidences = self._objects(gray)
        self._history.append((gray, np.eye(2, 3)))
        best = np.argsort(-confidences, kind="stable")[:MAX_DETECTIONS]
        to_image = np.tile([image_bgr.shape[1] / gray.shape[1], image_bgr.shape[0] / gray.shape[0]], 2)
        return Detections(
            (boxes[best] * to_image).astype(np.float32),
            confidences[best].astype(np.float32),
            np.zeros(len(best), np.int32),
        )

    def reset(self) -> None:
        self._history.clear()
        self._camera.reset()

    def _move_history(self, step: Affine) -> None:
        # Chain the camera's last step onto the maps of all stored images.
        moved = [(gray, _compose(step, affine)) for gray, affine in self._history]
        self._history.clear()
        self._history.extend(moved)

    def _objects(self, gray: _Gray) -> tuple[_Floats, _Floats]:
        # Boxes (N, 4) in working pixels and confidences (N,) of at least the wanted confidence.
        settings = self._settings
        if len(self._history) < settings.least_calls:
            return np.empty((0, 4)), np.empty(0)
        strict, median = self._differences(gray)
        threshold = max(settings.least_difference, settings.noise_factor * _noise(median))
        mask = np.asarray(median > threshold, np.uint8)
        if mask.mean() > settings.scene_change_share:
            self._history.clear()
            return np.empty((0, 4)), np.empty(0)
        regions = _regions(mask, strict > threshold, (median / threshold).astype(np.float32), settings)
        boxes, confidences = _merged(*regions, near_share=settings.near_share)
        sure = confidences >= self._confidence
        return boxes[sure], confidences[sure]

    def _differences(self, gray: _Gray) -> tuple[_Gray, _Gray]:
        # The second smallest and the lower median of the differences to the stored images, smoothed.
        rank = (len(self._history) - 1) // 2
        smallest = [np.full(gray.shape, 255, np.uint8) for _ in range(rank + 1)]
        for earlier, affine in self._history:
            larger = _tolerant_difference(gray, earlier, affine)
            for place, value in enumerate(smallest):
                smallest[place] = np.asarray(cv2.min(value, larger), np.uint8)
                larger = np.asarray(cv2.max(value, larger), np.uint8)
        strict, median = (
            np.asarray(cv2.blur(smallest[place], (3, 3)), np.uint8) for place in (min(1, rank), rank)
        )
        return strict, median


def _shrunk(image: Image, max_side_px: int) -> Image:
    height, width = image.shape[:2]
    scale = max_side_px / max(height, width)
    if scale >= 1:
        return image
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _tolerant_difference(gray: _Gray, earlier: _Gray, affine: Affine) -> _Gray:
    # How far each pixel lies outside its 3x3 neighbourhood in the earlier image; 0 where that image has no view.
    height, width = gray.shape
    edge = np.array([[0, 0], [width, 0], [width, height], [0, height]]) + _INSET_PX
    moved = edge @ affine[:, :2].T + affine[:, 2]
    still = np.abs(moved - edge).max() < _STILL_PX
    warped = earlier if still else np.asarray(cv2.warpAffine(earlier, affine, (width, height)), np.uint8)
    above = cv2.subtract(gray, np.asarray(cv2.dilate(warped, _SQUARE), np.uint8))
    below = cv2.subtract(np.asarray(cv2.erode(warped, _SQUARE), np.uint8), gray)
    difference = np.asarray(cv2.max(above, below), np.uint8)
    if not still:
        view = np.zeros(gray.shape, np.uint8)
        cv2.fillConvexPoly(view, np.rint(moved).astype(np.int32), 255)
        cv2.bitwise_and(difference, view, dst=difference)
    return difference


def _noise(difference: _Gray) -> float:
    # Robust scale of the differences: median plus 1.4826 median absolute deviations, on every fourth pixel.
    sample = difference[::4, ::4].astype(np.float32)
    median = np.median(sample)
    return float(median + 1.4826 * np.median(np.abs(sample - median)))


def _regions(
    mask: _Gray, seeds: npt.NDArray[np.bool_], excess: npt.NDArray[np.float32], settings: MotionSettings
) -> tuple[_Floats, _Floats]:
    # Boxes and confidences of possible objects; ``excess`` is the difference in units of the threshold.
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (settings.join_px, settings.join_px))
    closed = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, kernel), np.uint8)
    _, labels, found, _ = cv2.connectedComponentsWithStats(closed, connectivity=8, ltype=cv2.CV_16U)
    stats = np.asarray(found, np.int32)
    boxes, confidences = [], []
    for label in np.flatnonzero(_plausible(stats, settings, mask.size)):
        left, top, width, height = stats[label, :4]
        place = np.s_[top : top + height, left : left + width]
        inside = (labels[place] == label) & (mask[place] > 0)
        if np.count_nonzero(seeds[place] & inside) < settings.seed_share * np.count_nonzero(inside):
            continue
        # The tolerance and the closing took a pixel off each side.
        boxes.append((left - 1, top - 1, left + width + 1, top + height + 1))
        confidences.append(_confidence(excess[place][inside]))
    limits = np.array([mask.shape[1], mask.shape[0]] * 2)
    return np.clip(np.array(boxes, float).reshape(-1, 4), 0, limits), np.array(confidences, float)


def _plausible(
    stats: npt.NDArray[np.int32], settings: MotionSettings, image_area_px: int
) -> npt.NDArray[np.bool_]:
    # Which rows of OpenCV's component statistics (left, top, width, height, area) have the size of an object.
    shorter, longer = stats[:, 2:4].min(axis=1), stats[:, 2:4].max(axis=1)
    plausible = (stats[:, 4] >= settings.least_area_px) & (shorter >= settings.least_side_px)
    plausible &= (longer <= settings.largest_aspect * shorter) & (
        shorter * longer <= settings.largest_share * image_area_px
    )
    plausible[0] = False  # the background
    return np.asarray(plausible, np.bool_)


def _confidence(excess: npt.NDArray[np.float32]) -> float:
    # Grows with contrast and area: 1 - e^(-mean excess / 1.4), times area / (area + 50 px).
    return float((1 - np.exp(-excess.mean() / 1.4)) * excess.size / (excess.size + 50))


def _merged(boxes: _Floats, confidences: _Floats, *, near_share: float) -> tuple[_Floats, _Floats]:
    # Join boxes that overlap by a third of the smaller one, both grown a little; repeated until none do.
    while len(boxes) > 1:
        firsts, groups = np.unique(components(_overlapping(boxes, near_share)), return_inverse=True)
        count = len(firsts)
        if count == len(boxes):
            break
        joined = np.column_stack([np.full((count, 2), np.inf), np.full((count, 2), -np.inf)])
        best = np.zeros(count)
        np.minimum.at(joined[:, :2], groups, boxes[:, :2])
        np.maximum.at(joined[:, 2:], groups, boxes[:, 2:])
        np.maximum.at(best, groups, confidences)
        boxes, confidences = joined, best
    return boxes, confidences


def _overlapping(boxes: _Floats, near_share: float) -> npt.NDArray[np.bool_]:
    # (N, N): whether two boxes belong together.
    sides = boxes[:, 2:] - boxes[:, :2]
    reach = near_share * sides.min(axis=1)
    low = np.maximum(boxes[:, None, :2], boxes[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], boxes[None, :, 2:])
    overlap = np.maximum(high - low + np.minimum(reach[:, None], reach[None])[..., None], 0).prod(axis=2)
    areas = sides.prod(axis=1)
    return np.asarray(overlap > 0.3 * np.minimum(areas[:, None], areas[None]), np.bool_)


def _compose(second: Affine, first: Affine) -> Affine:
    # The affine map that does ``first`` and then ``second``, all (2, 3).
    return np.column_stack([second[:, :2] @ first[:, :2], second[:, :2] @ first[:, 2] + second[:, 2]])
