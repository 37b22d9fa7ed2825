"""Detectors of other packages: TensorRT, RKNN, Hailo, NCNN or whatever finds boxes, behind an entry point.

An entry point of the group ``hvt.detectors`` is a callable that gives a detector; the whole contract is
`hvt_common.inference.detect.Detector`. ``--detector NAME`` calls it without arguments, ``--detector NAME:TEXT`` with
the text, say the file of a model. The package is imported when it is named. Its answers are checked.
"""

from collections.abc import Callable, Collection
from importlib.metadata import EntryPoint
from typing import Any

import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError, foreign
from hvt_common.inference.letterbox import as_bgr
from hvt_common.inference.nms import MAX_DETECTIONS
from hvt_common.runtime.plug_ins import installed, loaded, origin, the_one
from hvt_common.values import Boxes, Detections, Image

_GROUP = "hvt.detectors"
_WHAT = "detector"
_TRIAL = (256, 320, 3)


def plug_in_names() -> dict[str, str]:
    """The detectors of other packages by name, with where each comes from; none is loaded."""
    return {name: origin(found[0]) for name, found in sorted(installed(_GROUP).items())}


def plug_in_of(spec: str, *, taken: Callable[[], Collection[str]] = tuple) -> EntryPoint | None:
    """The entry point that ``NAME`` or ``NAME:TEXT`` means, or None.

    Raises:
        UserError: two packages bring the name, or it is one of ``taken()``, which mean something else.
    """
    name = spec.partition(":")[0]
    return the_one(_GROUP, name, what=_WHAT, built_in=name in installed(_GROUP) and name in taken())


class PlugInDetector:
    """A detector of another package, whose every answer is checked; itself a `Detector`.

    Construction runs it once on grey. Raises `UserError` where it does not load, does not run or breaks the contract;
    `detect` raises the exceptions of the package, and `ValueError` for an impossible answer.
    """

    def __init__(self, entry: EntryPoint, spec: str, *, confidence: float) -> None:
        self._confidence = confidence
        model = spec.partition(":")[2]
        self._part = loaded(entry, lambda make: make(model) if model else make(), what=_WHAT)
        names: Any = getattr(self._part, "class_names", ())
        text = isinstance(names, list | tuple) and all(
            isinstance(name, str) and name and name.isprintable() for name in names
        )
        self.class_names: tuple[str, ...] = tuple(names) if text else ()
        try:
            if not self.class_names:
                raise ValueError(f"its class_names are {names!r}, and have to be words")
            self.detect(np.full(_TRIAL, 128, np.uint8))
        except foreign() as error:
            raise UserError(
                f"{_WHAT} {entry.name!r} of {origin(entry)} does not work: {type(error).__name__}: {error}"
            ) from error

    def detect(self, image_bgr: Image) -> Detections:
        """Detections from the confidence of use on: inside the image, best first, `MAX_DETECTIONS` at most."""
        image = as_bgr(image_bgr)
        found = self._part.detect(image)
        boxes, sure, kinds = _checked(found, classes=len(self.class_names))
        limits = np.array([image.shape[1], image.shape[0]] * 2, np.float32)
        boxes = np.clip(boxes, 0, limits)
        counts = (sure >= self._confidence) & (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
        best = np.flatnonzero(counts)[np.argsort(-sure[counts], kind="stable")][:MAX_DETECTIONS]
        return Detections(boxes[best], sure[best], kinds[best])


def _checked(found: Any, *, classes: int) -> tuple[Boxes, npt.NDArray[np.float32], npt.NDArray[np.int32]]:
    if not isinstance(found, Detections):
        raise ValueError(f"detect gave {type(found).__name__}, and has to give Detections")  # noqa: TRY004
    boxes = np.asarray(found.boxes_xyxy_px, np.float32)
    sure = np.asarray(found.confidences, np.float32)
    kinds = np.asarray(found.class_ids)
    if sure.ndim != 1 or boxes.shape != (len(sure), 4) or kinds.shape != sure.shape:
        raise ValueError(
            f"detect gave arrays of {boxes.shape}, {sure.shape} and {kinds.shape}, not (N, 4), (N,), (N,)"
        )
    if not np.isfinite(boxes).all() or not ((sure >= 0) & (sure <= 1)).all():
        raise ValueError("detect gave boxes that are not finite, or confidences outside 0…1")
    if len(kinds) and not (
        np.issubdtype(kinds.dtype, np.integer) and kinds.min() >= 0 and kinds.max() < classes
    ):
        raise ValueError(f"detect gave class ids that are no whole numbers from 0 to {classes - 1}")
    return boxes, sure, kinds.astype(np.int32)
