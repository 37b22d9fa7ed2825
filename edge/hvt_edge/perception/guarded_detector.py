"""A detector that may fail in flight: without it there are no detections, until it was opened again."""

from __future__ import annotations

from collections.abc import Callable

from hvt_common.inference.detect import Detector
from hvt_common.runtime.failures import Failures, RetryPause
from hvt_common.values import Detections, Image

__all__ = ["GuardedDetector"]

_PART = "detector"


class GuardedDetector:
    """Used from one thread; ``open_again`` opens the model anew and may raise whatever it likes."""

    def __init__(
        self,
        detector: Detector,
        *,
        open_again: Callable[[], Detector],
        failures: Failures,
        clock: Callable[[], int],
        pause: RetryPause | None = None,
    ) -> None:
        self._detector: Detector | None = detector
        self.class_names = detector.class_names
        self._open_again = open_again
        self._failures = failures
        self._clock = clock
        self._pause = pause or RetryPause()

    def detect(self, image_bgr: Image) -> Detections | None:
        """As `Detector.detect`; None while it does not work."""
        try:
            if self._detector is None:
                if not self._pause.due(self._clock()):
                    return None
                self._detector = self._open_again()
            found = self._detector.detect(image_bgr)
        except Exception as error:  # noqa: BLE001 - a runtime raises what it likes
            self._detector = None
            self._pause.failed(self._clock())
            self._failures.failed(_PART, f"the model failed, so no stills are chosen ({error})")
            return None
        self._failures.works(_PART)
        return found
