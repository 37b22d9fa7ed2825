"""Says once in a run that the detector does not know the view.

How far a view can be trusted is measured by the mean calibrated confidence of its boxes, weak ones among them: where
the view is unlike the training pictures, most boxes are weak. Of ten measures it ranks views by precision best
(docs/embedded-models.md). It costs no run.
"""

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
_ENOUGH_BOXES, _ENOUGH_PICTURES = 45, 10
"""The newest pictures with 45 boxes together decide, 10 at least: older ones may be of another scene."""
_LEAST_PICTURES = 5
"""The first of a flight are coded coarsely, and their boxes weak."""
_BEFORE = 0.6
"""As if each picture had one more box of this confidence: few boxes must be weaker to tell of an unknown view."""
_UNLIKE_BELOW, _LIKE_FROM = 0.48, 0.5
"""Vehicles of 40 pixels aslant, of which it finds none, have .37; views that it knows .5 to .8."""


def trust_from(detector: str) -> float | None:
    """`ViewTrust.counts_from` of a detector: half its confidence; it is measured for ``aerial-nano`` alone."""
    return default_confidence(detector) / 2 if detector == EMBEDDED_DETECTOR else None


class ViewTrust:
    """Trust in the detector on one video. Boxes count from a confidence of ``counts_from``; None trusts every view.

    A picture tells of the view if it shows an object: a box of twice that confidence. A faint spot tells nothing.

    ``unlike`` holds while the detector does not know the view; that is said once, with the consequence ``hence``, if
    ten pictures tell it. ``mean`` is the mean confidence of the boxes that count, with those of `_BEFORE`; None
    before the fifth picture. From any thread.
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
        if not (counted >= 2 * self._counts_from).any():
            return
        with self._lock:
            self._recent.append((float(np.sum(counted, dtype=np.float64)), len(counted)))
            total, boxes = 0.0, 0
            for pictures, (of_one, count) in enumerate(reversed(self._recent), start=1):
                total, boxes = total + of_one, boxes + count
                if pictures >= _ENOUGH_PICTURES and boxes >= _ENOUGH_BOXES:
                    break
            if pictures < _LEAST_PICTURES:
                return
            self.mean = (total + _BEFORE * pictures) / (boxes + pictures)
            self.unlike = self.mean < (_LIKE_FROM if self.unlike else _UNLIKE_BELOW)
            if not self.unlike or self._said or pictures < _ENOUGH_PICTURES:
                return
            self._said = True
        _log.warning(
            "this view is unlike what %s knows: its last %d boxes have a mean confidence of %.2f, and %s; for other "
            "views try hvt-models fetch yolox-s and --detector yolox-s, or teach it yours: hvt-study train",
            EMBEDDED_DETECTOR,
            boxes,
            total / boxes,
            self._hence,
        )
