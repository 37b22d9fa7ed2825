"""Models whose run may raise: a flight goes on without them, and they are opened again with growing pauses."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Generic, Protocol, TypeVar, cast

from hvt_common.errors import UserError
from hvt_common.inference.classify import Classifier
from hvt_common.inference.detect import Detector, FailingDetector
from hvt_common.inference.tiles import detect_whole
from hvt_common.runtime.failures import Failures, Retried
from hvt_common.values import Detections, Image, Posterior

_Model = TypeVar("_Model", bound=Detector | Classifier)


class _RetriedModel(Retried[_Model], Generic[_Model]):
    # Its numbers mean the names that it began with: a file with others, put in its place meanwhile, does not run.

    def __init__(
        self, open_part: Callable[[], _Model], name: str, failures: Failures, **settings: Any
    ) -> None:
        begun: list[tuple[str, ...]] = []

        def open_same() -> _Model:  # it does not hold this object: a model would outlast its session
            part = open_part()
            if not begun:
                begun.append(part.class_names)
            elif part.class_names != begun[0]:
                raise UserError(f"the {name} is another now, with other class names: a new start takes it")
            return part

        super().__init__(open_same, name, failures, **settings)
        self.class_names = self.part.class_names


class RetriedDetector(_RetriedModel[Detector]):
    """A `FailingDetector`: it finds None while its model fails."""

    def detect(self, image_bgr: Image) -> Detections | None:
        return self.run(lambda model: model.detect(image_bgr))

    def detect_whole(self, image_bgr: Image, *, share: float = 1.0) -> Detections | None:
        return self.run(lambda model: detect_whole(model, image_bgr, share=share))


class _Whole(Protocol):
    def __call__(self, image_bgr: Image, *, share: float = 1.0) -> Detections | None: ...


def without_tiles(detector: FailingDetector) -> _Whole:
    """`detect_whole` of a detector, which may be one that is opened again."""
    if isinstance(detector, RetriedDetector):
        return detector.detect_whole
    return partial(detect_whole, cast("Detector", detector))


class RetriedClassifier(_RetriedModel[Classifier]):
    """Has no opinion while its model fails."""

    def classify(self, crops_bgr: Sequence[Image]) -> list[Posterior]:
        return self.run(lambda model: model.classify(crops_bgr)) or []
