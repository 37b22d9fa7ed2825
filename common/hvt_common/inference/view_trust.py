"""Says once in a run that the detector does not know the view.

How far a view can be trusted is measured by the mean calibrated confidence of its boxes, weak ones among them: where
the view is unlike the training pictures, most boxes are weak. Of ten measures it ranks views by precision best
(docs/embedded-models.md). It costs no run.
"""

from __future__ import annotations

import logging
import threading
from collections import deque

import numpy as np

from hvt_common.inference.labels import default_confidence
from hvt_common.inference.store import EMBEDDED_DETECTOR
from hvt_common.values import Detections

_log = logging.getLogger(__name__)
_RUNS = 45
"""Detections on pictures: 15 s at the defaults (15 fps, every fifth frame)."""
_LEAST_BOXES, _LEAST_PICTURES = 45, 10
"""The newest pictures with 45 boxes together decide, 10 at least: older ones may be of another scene."""
_UNLIKE_BELOW = 0.47
"""Vehicles of 40 pixels aslant, of which it finds none, have .37; views that it knows .5 to .8."""
_LIKE_FROM = 0.5


def trust_from(detector: str) -> float | None:
    """`ViewTrust.counts_from` of a detector: half its confidence; it is measured for ``aerial-nano`` alone."""
    return default_confidence(detector) / 2 if detector == EMBEDDED_DETECTOR else None


class ViewTrust:
    """Trust in the detector on one video. Boxes count from a confidence of ``counts_from``; None trusts every view.

    ``unlike`` holds while the detector does not know the view; that is said once, with the consequence ``hence``.
    ``mean`` is the mean confidence of the boxes that count, None before there were enough. From any thread.
    """

    def __init__(self, counts_from: float | None, *, hence: str) -> None:
        self._counts_from = counts_from
        self._recent: deque[tuple[float, int]] = deque(maxlen=_RUNS)
        self._lock = threading.Lock()
        self._hence = hence
        self._said = False
        self.unlike = False
        self.mean: float | None = None

    def take(self, found: Detections) -> None:
        """Count the detections of the next picture."""
        if self._counts_from is None:
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
