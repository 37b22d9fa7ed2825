"""Models whose run may raise: a flight goes on without them, and they are opened again with growing pauses."""

from __future__ import annotations

from collections.abc import Sequence

from hvt_common.inference.classify import Classifier
from hvt_common.inference.detect import Detector
from hvt_common.inference.tiles import detect_whole
from hvt_common.runtime.failures import Retried
from hvt_common.values import Detections, Image, Posterior


class RetriedDetector(Retried[Detector]):
    """A `FailingDetector`: it finds None while its model fails."""

    @property
    def class_names(self) -> tuple[str, ...]:
        return self.part.class_names

    def detect(self, image_bgr: Image) -> Detections | None:
        return self.run(lambda model: model.detect(image_bgr))

    def detect_whole(self, image_bgr: Image) -> Detections | None:
        return self.run(lambda model: detect_whole(model, image_bgr))


class RetriedClassifier(Retried[Classifier]):
    """Has no opinion while its model fails."""

    @property
    def class_names(self) -> tuple[str, ...]:
        return self.part.class_names

    def classify(self, crops_bgr: Sequence[Image]) -> list[Posterior]:
        return self.run(lambda model: model.classify(crops_bgr)) or []
