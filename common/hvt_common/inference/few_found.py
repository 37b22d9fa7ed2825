"""Hints, once in a run: the detector finds next to nothing where something else does, or does not know the view.

How far a view can be trusted is measured by the mean calibrated confidence of the boxes that count. Of five measures
it predicted precision best, with a correlation of .74 over 70 views of five labelled sets, at the usual size and at a
quarter of it (docs/embedded-models.md). It costs no run.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable

import cv2
import numpy as np

from hvt_common.inference.labels import default_confidence
from hvt_common.inference.letterbox import as_bgr
from hvt_common.inference.store import EMBEDDED_DETECTOR, MOTION, library_part
from hvt_common.values import Detections, Image

_log = logging.getLogger(__name__)
_RUNS = 45
"""Detections on pictures: 15 s at the defaults (15 fps, every fifth frame)."""
_LEAST_SHARE = 0.1
"""Share of the runs that found something at the confidence of use, or in which something moved."""
_OTHER = "yolox-s"
_LEAST_BOXES, _LEAST_PICTURES = 45, 10
"""The newest pictures tell, no more of them than hold so many boxes: older ones may be of another scene."""
_UNLIKE_BELOW = 0.58
"""People and boats on water have .53, vehicles of 40 pixels aslant .55, every view that it knows .62 to .85."""
_LIKE_FROM = 0.6


class FewFoundHint:
    """Says so after the first runs. For any thread.

    Of ``aerial-nano`` it is said where it finds next to nothing, with another model that may know the view. Of
    another model it is said where it finds nothing at all, though something moves in the pictures, or though it finds
    something in the middle of the picture at twice or half the size. ``confidence`` is that from which a detection
    starts a track.
    """

    def __init__(self, detector: str, *, confidence: float) -> None:
        self._detector = detector
        self._confidence = confidence
        self._lock = threading.Lock()
        self._open = detector != MOTION
        self._runs = self._with_something = self._with_motion = 0
        self._also = False
        motion = library_part(MOTION) if self._open and detector != EMBEDDED_DETECTOR else None
        self._motion = None if motion is None else motion()

    def take(self, found: Detections, image_bgr: Image, detect: Callable[[Image], Detections | None]) -> None:
        """Count what was found on one picture; at the last run that counts it may be said.

        ``detect`` runs the detector once more, on another picture.
        """
        if not self._open:
            return
        with self._lock:
            self._runs += 1
            self._with_something += self._has(found) or self._also
            self._also = False
            if self._motion is not None and not self._with_something:
                self._with_motion += bool(len(self._motion.detect(image_bgr)))
            if self._runs < _RUNS or not self._open:
                return
            self._open = False
            self._motion = None
        if self._detector == EMBEDDED_DETECTOR:
            if self._with_something < _LEAST_SHARE * _RUNS:
                self._say_other_model()
        elif not self._with_something:
            self._say_what_does(image_bgr, detect)

    def take_also(self, found: Detections | None) -> None:
        """What another run has found on that picture, as on a part of it that was enlarged."""
        with self._lock:
            self._also |= self._has(found)

    def _has(self, found: Detections | None) -> bool:
        return found is not None and bool((found.confidences >= self._confidence).any())

    def _say_other_model(self) -> None:
        _log.warning(
            "%s found something on %d of the first %d pictures: it knows vehicles and people from above; for "
            "other views try hvt-models fetch %s and --detector %s (hvt-models list says what each is good for)",
            EMBEDDED_DETECTOR,
            self._with_something,
            _RUNS,
            _OTHER,
            _OTHER,
        )

    def _say_what_does(self, image_bgr: Image, detect: Callable[[Image], Detections | None]) -> None:
        image = as_bgr(image_bgr)
        sizes = {"twice": _middle_enlarged(image), "half": _shrunk(image)}
        others = [
            f"it finds something at {name} the size" for name, one in sizes.items() if self._has(detect(one))
        ]
        if self._with_motion >= _LEAST_SHARE * _RUNS:
            others.append(f"something moves in {self._with_motion} of them")
        if others:
            _log.warning(
                "%s found nothing on the first %d pictures, and %s: hvt-models info %s says what it is taken for; "
                "another --size, and of one network --tiles, changes the size, --confidence what counts",
                self._detector,
                _RUNS,
                ", and ".join(others),
                self._detector,
            )


class ViewTrust:
    """Of one video. It is measured for ``aerial-nano`` alone; every other detector's views are trusted.

    ``unlike`` holds while the view is unlike what the detector knows; that is said once, with ``hence``, what follows
    from it. ``mean`` is the mean confidence of the boxes that count, None before there were enough. From any thread.
    """

    def __init__(self, detector: str, *, hence: str) -> None:
        self._measured = detector == EMBEDDED_DETECTOR
        self._counts_from = default_confidence(detector) if self._measured else 0.0
        self._recent: deque[tuple[float, int]] = deque(maxlen=_RUNS)
        self._lock = threading.Lock()
        self._hence = hence
        self._said = False
        self.unlike = False
        self.mean: float | None = None

    def take(self, found: Detections) -> None:
        """Count what was found on the next picture."""
        if not self._measured:
            return
        counted = found.confidences[found.confidences >= self._counts_from]
        with self._lock:
            self._recent.append((float(np.sum(counted, dtype=np.float64)), len(counted)))
            total, boxes = 0.0, 0
            for pictures, (of_one, count) in enumerate(reversed(self._recent), start=1):
                total, boxes = total + of_one, boxes + count
                if pictures >= _LEAST_PICTURES and boxes >= _LEAST_BOXES:
                    break
            else:
                return  # too few tell nothing new
            self.mean = total / boxes
            self.unlike = self.mean < (_LIKE_FROM if self.unlike else _UNLIKE_BELOW)
            if not self.unlike or self._said:
                return
            self._said = True
        _log.warning(
            "this view is unlike what %s knows: its last %d boxes have a mean confidence of %.2f, and %s; for other "
            "views try hvt-models fetch yolox-s and --detector yolox-s, or teach it yours: hvt-study train",
            EMBEDDED_DETECTOR,
            boxes,
            self.mean,
            self._hence,
        )


def _middle_enlarged(image: Image) -> Image:
    # The middle half of the picture at its full size.
    height, width = image.shape[:2]
    middle = image[height // 4 : height - height // 4, width // 4 : width - width // 4]
    return np.asarray(cv2.resize(middle, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)


def _shrunk(image: Image) -> Image:
    # The picture at half its size, in the middle of grey.
    height, width = image.shape[:2]
    small = cv2.resize(image, (max(1, width // 2), max(1, height // 2)), interpolation=cv2.INTER_AREA)
    whole = np.full_like(image, 114)
    top, left = (height - small.shape[0]) // 2, (width - small.shape[1]) // 2
    whole[top : top + small.shape[0], left : left + small.shape[1]] = small
    return whole
