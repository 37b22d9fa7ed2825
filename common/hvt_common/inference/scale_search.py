"""The scales at which a detector promises most objects, found in flight.

A network that learnt cars at twenty pixels finds hardly one of five pixels, and nearly all in the same picture
enlarged. So now and then it also searches one quarter of the picture enlarged. Where that promises far more objects
(the sum of calibrated confidences is the expected number of true ones), the whole picture is searched so from then
on, part by part, until it promises no more than one run. And where few objects are sure, each third picture is
searched reduced too, or each one while it shows a large object: a network overlooks one that fills a third. See
docs/embedded-models.md.
"""

import logging
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.inference.tiles import Tile, are_large, tile_boxes, with_large, with_tiles
from hvt_common.values import Detections, Image

_log = logging.getLogger(__name__)
_GRID: Final = (2, 2)
_OVERLAP: Final = 0.05
"""Share that two neighbouring parts overlap: objects in enlarged parts are small."""
_MOST_SIDE: Final = 1280
"""A larger picture is searched at the scale of its pixels already (`hvt_common.inference.tiles`)."""
_FIRST, _APART, _EVERY = 3, 3, 45
"""The second picture is probed, the fifth and the eighth, then every 45th: a slow machine measures by its first
pictures how often it can search, and a probe takes as long as three of them."""
_OTHER: Final = 2.0
"""Twice or half as many promised as at the last probe: another scene, which is probed at once."""
_MORE, _LEAST_MORE = 3.0, 8.0
"""Enlarged, the part must promise 3 times as many objects, and 8 more."""
_SEEN_WHOLE_PX: Final = 80
"""The whole picture's run sees objects from this length on; an enlarged part sees a bus in a crossing's stripes."""
_STILL_MORE: Final = 2.0
_IN_VAIN: Final = 3
"""The search enlarged ends after this many pictures in a row that promise less than `_STILL_MORE` times as much."""
_REDUCED_EVERY: Final = 3
_SURE: Final = 0.5
_RIGHT: Final = 5
"""With 5 sure objects that are not large the scale is right: reduced, planters between them would be buses."""
_RARER: Final = 3
"""A search with five runs in place of one is due a third as often."""


class ScaleSearch:
    """Finds the scale of one video, whose detector's scores are probabilities; for one thread.

    ``detect`` runs the detector on a picture of any size, None while it fails. Boxes from ``confidence`` on count.
    """

    def __init__(self, detect: Callable[[Image], Detections | None], *, confidence: float) -> None:
        self._detect = detect
        self._confidence = confidence
        self._pictures = self._probes = self._in_vain = 0
        self._due, self._before = 2, math.inf
        self._large = True
        """The picture before surely showed something large, or there was none."""
        self.enlarged = False
        """Each picture is looked at in parts, enlarged."""

    def interval(self, frames: int) -> int:
        """Frames from one detection to the next; ``frames`` are those with one run for each."""
        return frames * _RARER if self.enlarged else frames

    def take(self, whole: Detections, image_bgr: Image) -> Detections:
        """All objects of the next picture; ``whole`` are those of its one run."""
        size = (image_bgr.shape[1], image_bgr.shape[0])
        self._pictures += 1
        whole = self._with_large(whole, image_bgr)
        if max(size) > _MOST_SIDE:
            return whole
        tiles = tile_boxes(size, _GRID, overlap=_OVERLAP)
        if self.enlarged:
            found = with_tiles(whole, image_bgr, tiles, self._detect_enlarged)
            self._note_gain(self._promise(found), self._promise(whole))
            return found
        promised = self._promise(whole)
        low, high = sorted((promised, self._before))
        if math.isinf(high):
            self._before = promised
        elif self._pictures >= self._due or high > _OTHER * low + _LEAST_MORE:
            self._before = promised
            self._probe(whole, image_bgr, tiles[self._probes % len(tiles)])
        return whole

    def _with_large(self, whole: Detections, image_bgr: Image) -> Detections:
        sure = whole.boxes_xyxy_px[whole.confidences >= _SURE]
        if (~are_large(sure, image_bgr)).sum() >= _RIGHT or not (
            self._large or self._pictures % _REDUCED_EVERY == 0
        ):
            return whole
        found = with_large(whole, image_bgr, self._detected)
        self._large = bool(are_large(found.boxes_xyxy_px[found.confidences >= _SURE], image_bgr).any())
        return found

    def _probe(self, whole: Detections, image_bgr: Image, tile: Tile) -> None:
        x1, y1, x2, y2 = tile
        self._probes += 1
        self._due = self._pictures + (_APART if self._probes < _FIRST else _EVERY)
        middles = (whole.boxes_xyxy_px[:, :2] + whole.boxes_xyxy_px[:, 2:]) / 2
        inside = (middles >= (x1, y1)) & (middles < (x2, y2))
        here = self._promise(whole, inside[:, 0] & inside[:, 1])
        there = self._promise(self._detect_enlarged(image_bgr[y1:y2, x1:x2]))
        if there < _MORE * here + _LEAST_MORE:
            return
        self.enlarged, self._in_vain = True, 0
        _log.info(
            "objects are small here: a quarter of the picture promises %.0f of them enlarged, %.0f as it is; each "
            "picture is looked at in parts, enlarged, a third as often",
            there,
            here,
        )

    def _note_gain(self, found: float, whole: float) -> None:
        self._in_vain = self._in_vain + 1 if found < _STILL_MORE * whole + _LEAST_MORE else 0
        if self._in_vain == _IN_VAIN:
            self.enlarged, self._before = False, whole
            self._due = self._pictures + _EVERY

    def _detect_enlarged(self, part_bgr: Image) -> Detections:
        scale = _MOST_SIDE / max(part_bgr.shape[:2])
        large = cv2.resize(part_bgr, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        found = self._detected(np.asarray(large, np.uint8))
        found = replace(found, boxes_xyxy_px=found.boxes_xyxy_px / np.float32(scale))
        sides = found.boxes_xyxy_px[:, 2:] - found.boxes_xyxy_px[:, :2]
        return found.take(np.flatnonzero(sides.max(axis=1, initial=0) < _SEEN_WHOLE_PX))

    def _detected(self, image_bgr: Image) -> Detections:
        return self._detect(image_bgr) or Detections.none()

    def _promise(self, found: Detections, among: npt.NDArray[np.bool_] | None = None) -> float:
        counted = found.confidences >= self._confidence
        return float(found.confidences[counted if among is None else counted & among].sum())
