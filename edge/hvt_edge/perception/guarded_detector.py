"""A detector that may fail in flight: without it there are no detections, until it was opened again."""

from __future__ import annotations

from collections.abc import Callable

from hvt_common.inference.detect import Detector
from hvt_common.runtime.failures import Failures, Retried, RetryPause
from hvt_common.values import Detections, Image

__all__ = ["GuardedDetector"]


class GuardedDetector(Retried[Detector]):
    """``opened`` is the first one, ``open_again`` opens the model anew."""

    def __init__(
        self,
        opened: Detector,
        *,
        open_again: Callable[[], Detector],
        failures: Failures,
        clock: Callable[[], int],
        pause: RetryPause | None = None,
    ) -> None:
        ready = [opened]
        super().__init__(
            lambda: ready.pop() if ready else open_again(), "detector", failures, clock=clock, pause=pause
        )
        self.class_names = opened.class_names

    def detect(self, image_bgr: Image) -> Detections | None:
        """As `Detector.detect`; None while it does not work."""
        return self.run(lambda model: model.detect(image_bgr))
