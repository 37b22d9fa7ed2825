"""Models whose run may raise: the ground goes on without them, and they are opened again with growing pauses."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

from hvt_common.inference.classify import Classifier
from hvt_common.inference.detect import Detector
from hvt_common.runtime.failures import Failures, RetryPause, reason_of
from hvt_common.values import Detections, Image, Posterior

__all__ = ["RetriedClassifier", "RetriedDetector"]

_Model = TypeVar("_Model", bound=Detector | Classifier)
_Answer = TypeVar("_Answer")


class _Retried(Generic[_Model]):
    """A model and how to open another; threads take turns. ``failures`` has it under ``part``."""

    def __init__(
        self,
        open_one: Callable[[], _Model],
        part: str,
        failures: Failures,
        *,
        pause: RetryPause | None = None,
    ) -> None:
        self.model: _Model = open_one()
        """The one that is open, or that failed last."""
        self._open_one = open_one
        self._part = part
        self._failures = failures
        self._pause = pause or RetryPause()
        self._failed = False
        self._lock = threading.Lock()

    @property
    def class_names(self) -> tuple[str, ...]:
        """The model's."""
        return self.model.class_names

    def _run(self, use: Callable[[_Model], _Answer]) -> _Answer | None:
        """None where it fails, or has failed and is left alone for a while."""
        with self._lock:
            return self._try(use)

    def _try(self, use: Callable[[_Model], _Answer]) -> _Answer | None:
        now_ns = time.monotonic_ns()
        if self._failed and not self._pause.due(now_ns):
            return None
        try:
            if self._failed:
                self.model = self._open_one()
            answer = use(self.model)
        except Exception as error:  # noqa: BLE001 - whatever a runtime raises
            self._failed = True
            self._pause.failed(now_ns)
            self._failures.failed(self._part, reason_of(error))
            return None
        if self._failed:
            self._failed = False
            self._failures.works(self._part)
        return answer


class RetriedDetector(_Retried[Detector]):
    """Finds nothing while its model fails."""

    def detect(self, image_bgr: Image) -> Detections:
        """As the model does."""
        found = self._run(lambda model: model.detect(image_bgr))
        return Detections.none() if found is None else found


class RetriedClassifier(_Retried[Classifier]):
    """Has no opinion while its model fails."""

    def classify(self, crops_bgr: Sequence[Image]) -> list[Posterior]:
        """As the model does; empty while it fails."""
        return self._run(lambda model: model.classify(crops_bgr)) or []
