"""The detector and the classifier of a ground: opened once, for all its sessions."""

from __future__ import annotations

from functools import partial

from hvt_common.inference.classify import Classifier, open_classifier
from hvt_common.inference.detect import Detector, open_detector, warm_up
from hvt_common.inference.few_found import FewFoundHint
from hvt_common.runtime.clock import SteadyClock
from hvt_common.runtime.failures import Failures
from hvt_common.tracking.bytetrack import weak_confidence
from hvt_ground.config import DETECTOR, MOTION, NONE, GroundConfig
from hvt_ground.perception.retried import RetriedClassifier, RetriedDetector

__all__ = ["ModelSet", "Models"]

_USUAL_SIZE = (1280, 720)
"""Of base streams; what an edge really sends is known only when its first picture comes."""

ModelSet = tuple[Detector, Classifier | None]


class Models:
    """Opens detector and classifier once; all sessions take turns with them.

    Two pictures at once would each have half the cores, and take twice the memory and threads.
    """

    def __init__(self, config: GroundConfig) -> None:
        self._config = config
        self.failures = Failures(SteadyClock())
        """Models whose run raised."""
        self._set = self._open()

    def take(self) -> ModelSet:
        """A detector, and a classifier where one is wanted; a motion detector is a new one: it remembers pictures."""
        return (self._open_detector(), self._set[1]) if self._config.detector == MOTION else self._set

    def _open_detector(self) -> Detector:
        config = self._config
        open_one = partial(
            open_detector,
            config.detector,
            labels=config.detector_labels,
            confidence=weak_confidence(config.confidence),
            nms_iou=config.nms_iou,
            threads=config.threads,
            provider=config.provider,
        )
        hint = FewFoundHint(config.detector, confidence=config.confidence)
        return RetriedDetector(open_one, "detector", self.failures, hint=hint)

    def _open(self) -> ModelSet:
        config = self._config
        detector = self._open_detector()
        if config.detector != MOTION:  # it remembers pictures
            warm_up(detector, _USUAL_SIZE)
        if config.classifier in (None, DETECTOR, NONE):
            return detector, None
        open_one = partial(
            open_classifier,
            config.classifier,
            labels=config.labels,
            threads=config.threads,
            provider=config.provider,
        )
        return detector, RetriedClassifier(open_one, "classifier", self.failures)
