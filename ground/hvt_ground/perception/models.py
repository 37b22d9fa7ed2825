"""The detectors and classifiers of a ground: opened once, checked out by one session at a time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from hvt_common.inference.classify import Classifier, open_classifier
from hvt_common.inference.detect import Detector, open_detector, warm_up
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
    """Opens detector and classifier once to check them; one set serves one session at a time, for its buffers."""

    def __init__(self, config: GroundConfig) -> None:
        self._config = config
        self.failures = Failures(SteadyClock())
        """Models whose run raised."""
        self._ready: list[ModelSet] = [self._open()]
        self._serving: dict[str, ModelSet] = {}
        """By edge, what the session that is open has."""

    def take(self, edge: str | None = None) -> ModelSet:
        """A detector, and a classifier where one is wanted, that no other session uses."""
        try:
            taken = self._ready.pop()
        except IndexError:
            taken = self._open()
        if edge is not None:
            self._serving[edge] = taken
        return taken

    def give_back(self, detector: Detector, classifier: Classifier | None) -> None:
        """Take them back from a session that has ended; a network keeps nothing of it, the motion detector does."""
        for edge, serving in list(self._serving.items()):
            if serving[0] is detector:
                del self._serving[edge]
        if self._config.detector != MOTION:
            self._ready.append((detector, classifier))

    @contextmanager
    def checkout(self, edge: str) -> Iterator[ModelSet]:
        """The set of an edge's open session, for another job of its worker; of an edge without one a set of its own.

        A motion detector is a new one: it remembers pictures, and opening it costs nothing.
        """
        serving = self._serving.get(edge)
        if serving is None:
            taken = self.take()
            try:
                yield taken
            finally:
                self.give_back(*taken)
        elif self._config.detector == MOTION:
            yield self._open_detector(), serving[1]
        else:
            yield serving

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
        return RetriedDetector(open_one, "detector", self.failures)

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
