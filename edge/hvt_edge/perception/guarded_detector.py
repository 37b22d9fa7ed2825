"""A detector that may fail in flight: without it there are no detections, until it was opened again."""

from __future__ import annotations

from collections.abc import Callable

from hvt_common.inference.detect import Detector
from hvt_common.inference.few_found import FewFoundHint
from hvt_common.inference.tiles import detect_whole
from hvt_common.runtime.failures import Failures, Retried, RetryPause
from hvt_common.values import Detections, Image


class OpenedOnUse:
    """A detector that is opened when it is first used, for who may never use it; its class names are known."""

    def __init__(self, open_detector: Callable[[], Detector], class_names: tuple[str, ...]) -> None:
        self._open = open_detector
        self._opened: Detector | None = None
        self.class_names = class_names

    def detect(self, image_bgr: Image) -> Detections:
        """Like the detector's. Raises the error of opening it."""
        self._opened = self._opened or self._open()
        return self._opened.detect(image_bgr)


class GuardedDetector(Retried[Detector]):
    """``opened`` is the first one, ``open_again`` opens the model anew; ``hint`` may say that it finds little."""

    def __init__(
        self,
        opened: Detector,
        *,
        open_again: Callable[[], Detector],
        failures: Failures,
        clock: Callable[[], int],
        hint: FewFoundHint | None = None,
        pause: RetryPause | None = None,
    ) -> None:
        self._hint = hint
        ready = [opened]
        super().__init__(
            lambda: ready.pop() if ready else open_again(), "detector", failures, clock=clock, pause=pause
        )
        self.class_names = opened.class_names

    def detect(self, image_bgr: Image) -> Detections | None:
        """Like `Detector.detect`; None while it does not work."""
        found = self.run(lambda model: model.detect(image_bgr))
        if found is not None and self._hint is not None:
            self._hint.take(found, image_bgr, lambda other: self.run(lambda model: model.detect(other)))
        return found

    def detect_whole(self, image_bgr: Image) -> Detections | None:
        """Like `hvt_common.inference.tiles.detect_whole`; None while it does not work."""
        return self.run(lambda model: detect_whole(model, image_bgr))
