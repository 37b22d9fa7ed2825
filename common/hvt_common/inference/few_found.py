"""A hint, once in a run: the embedded detector finds next to nothing, and another model may know this view."""

from __future__ import annotations

import logging
import threading

from hvt_common.inference.store import EMBEDDED_DETECTOR
from hvt_common.values import Detections

__all__ = ["FewFoundHint"]

_log = logging.getLogger(__name__)
_RUNS = 45
"""Detections on pictures: 15 s at the defaults (15 fps, every fifth frame)."""
_LEAST_SHARE = 0.1
"""Of the runs that found something at the confidence of use."""
_OTHER = "yolox-s"


class FewFoundHint:
    """Says so after the first runs, for ``aerial-nano`` alone: who chose a model of his own needs no advice.

    ``confidence`` is that from which a detection starts a track. For any thread.
    """

    def __init__(self, detector: str, *, confidence: float) -> None:
        self._confidence = confidence
        self._lock = threading.Lock()
        self._open = detector == EMBEDDED_DETECTOR
        self._runs = self._with_something = 0

    def take(self, found: Detections) -> None:
        """Count what was found on one picture; at the last run that counts it may be said."""
        if not self._open:
            return
        with self._lock:
            self._runs += 1
            self._with_something += bool((found.confidences >= self._confidence).any())
            if self._runs < _RUNS or not self._open:
                return
            self._open = False
        if self._with_something < _LEAST_SHARE * _RUNS:
            _log.warning(
                "%s found something on %d of the first %d pictures: it knows vehicles and people from above; for "
                "other views try hvt-models fetch %s and --detector %s (hvt-models list says what each is good for)",
                EMBEDDED_DETECTOR,
                self._with_something,
                _RUNS,
                _OTHER,
                _OTHER,
            )
