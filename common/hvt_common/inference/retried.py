"""Models whose run may raise: a flight goes on without them, and they are opened again with growing pauses."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from hvt_common.inference.classify import Classifier
from hvt_common.inference.detect import Detector
from hvt_common.inference.few_found import FewFoundHint
from hvt_common.inference.tiles import detect_whole
from hvt_common.runtime.failures import Failures, Retried
from hvt_common.values import Detections, Image, Posterior


class RetriedDetector(Retried[Detector]):
    """A `FailingDetector`; ``hint`` may say that it finds little."""

    def __init__(
        self,
        open_part: Callable[[], Detector],
        failures: Failures,
        *,
        clock: Callable[[], int] = time.monotonic_ns,
        hint: FewFoundHint | None = None,
    ) -> None:
        super().__init__(open_part, "detector", failures, clock=clock)
        self._hint = hint

    @property
    def class_names(self) -> tuple[str, ...]:
        """The model's."""
        return self.part.class_names

    def detect(self, image_bgr: Image) -> Detections | None:
        """Like the model's; None while it fails."""
        found = self.run(lambda model: model.detect(image_bgr))
        if found is not None and self._hint is not None:
            self._hint.take(found, image_bgr, lambda other: self.run(lambda model: model.detect(other)))
        return found

    def detect_whole(self, image_bgr: Image) -> Detections | None:
        """Like `hvt_common.inference.tiles.detect_whole`; None while it fails."""
        found = self.run(lambda model: detect_whole(model, image_bgr))
        if self._hint is not None:
            self._hint.take_also(found)
        return found


class RetriedClassifier(Retried[Classifier]):
    """Has no opinion while its model fails."""

    @property
    def class_names(self) -> tuple[str, ...]:
        """The model's."""
        return self.part.class_names

    def classify(self, crops_bgr: Sequence[Image]) -> list[Posterior]:
        """Like the model's; empty while it fails."""
        return self.run(lambda model: model.classify(crops_bgr)) or []
