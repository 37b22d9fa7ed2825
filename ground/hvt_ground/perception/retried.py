"""Models whose run may raise: the ground goes on without them, and they are opened again with growing pauses."""

from __future__ import annotations

from collections.abc import Sequence

from hvt_common.inference.classify import Classifier
from hvt_common.inference.detect import Detector
from hvt_common.runtime.failures import Retried
from hvt_common.values import Detections, Image, Posterior

__all__ = ["RetriedClassifier", "RetriedDetector"]


class RetriedDetector(Retried[Detector]):
    """Finds nothing while its model fails."""

    @property
    def class_names(self) -> tuple[str, ...]:
        """The model's."""
        return self.part.class_names

    def detect(self, image_bgr: Image) -> Detections:
        """As the model does."""
        found = self.run(lambda model: model.detect(image_bgr))
        return Detections.none() if found is None else found


class RetriedClassifier(Retried[Classifier]):
    """Has no opinion while its model fails."""

    @property
    def class_names(self) -> tuple[str, ...]:
        """The model's."""
        return self.part.class_names

    def classify(self, crops_bgr: Sequence[Image]) -> list[Posterior]:
        """As the model does; empty while it fails."""
        return self.run(lambda model: model.classify(crops_bgr)) or []
