"""Detectors: an ONNX network with one of the known heads, plain motion, or what another package brings."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.inference.class_names import COCO_NAMES, VISDRONE_NAMES, group_of
from hvt_common.inference.detect_heads import ACCEPTED_HEADS, Head, choose_head
from hvt_common.inference.labels import metadata_labels, read_labels
from hvt_common.inference.letterbox import Letterboxer, as_bgr
from hvt_common.inference.motion import MotionDetector
from hvt_common.inference.nms import MAX_DETECTIONS, suppress
from hvt_common.inference.runtimes.model import ModelSettings, OnnxModel, open_model
from hvt_common.inference.runtimes.plug_in import PlugInDetector, plug_in_names, plug_in_of
from hvt_common.inference.store import model_names, resolve_model
from hvt_common.values import Detections, Image

__all__ = [
    "MOTION",
    "USUAL_CONFIDENCE",
    "Detector",
    "OnnxDetector",
    "detect_every",
    "open_detector",
    "warm_up",
]

MOTION = "motion"
"""The word that stands for the detector without weights."""

USUAL_CONFIDENCE = 0.25
"""From where detections count, where neither the user nor the model says."""

_CELL = 32  # input sides are multiples of the largest usual stride
_TRIAL_SIDE = 256
_MAX_FREE_SIDE = 1920
_MAX_SIDE = 8192
_ENLARGE_TO = "hvt.enlarge_to"
_MOST_ENLARGED = 2.0
"""Beyond that nothing more is found, and the time grows with the square."""
_TWIN_IOU = 0.8
"""Two boxes that overlap more are one object, whatever their classes: networks call one vehicle a car and a van. A
rider and the bicycle below overlap less."""


class Detector(Protocol):
    """Finds objects in one image after the other, of any sizes. One thread at a time calls it.

    This is also the contract of a plug-in (``hvt.detectors``, docs/models.md): its answer depends on the image alone,
    and it may raise; then the flight goes on without detections, and it is opened again after a pause.
    """

    @property
    def class_names(self) -> tuple[str, ...]:
        """What ``class_ids`` index."""

    def detect(self, image_bgr: Image) -> Detections:
        """Detections in (height, width, 3) uint8, which must not be written to: in its pixels, inside it, best first.

        One box an object (after NMS). A plug-in may give them all: those below the confidence of use are left out.
        """


def open_detector(
    spec: str,
    *,
    labels: Path | None = None,
    confidence: float = USUAL_CONFIDENCE,
    nms_iou: float = 0.45,
    size: tuple[int, int] | None = None,
    threads: int = 1,
    provider: str = "cpu",
) -> Detector:
    """Open a detector: ``motion``, the name of a model (see `resolve_model`), an ONNX file, or a plug-in's name.

    ``labels`` are class names, one a line; else those of the metadata, COCO (80), VisDrone (10), or "class 0" and
    so on. ``confidence`` is the least of a detection, ``nms_iou`` the largest overlap of two of one class, both
    0…1. ``size`` is (width, height) of the network's input where the model leaves it free; else each image gets the
    multiples of 32 that hold it (at most 1920 on the longer side). A plug-in gets none of these; ``confidence`` is
    applied to its answer. Raises `UserError` where there is no such model, it is not a detector, its labels do not
    fit, or a setting is out of its range.
    """
    for name, value in (("confidence", confidence), ("NMS IoU", nms_iou)):
        if not 0 <= value <= 1:
            raise UserError(f"{name} {value} is not accepted; a number from 0 to 1 is")
    if spec == MOTION:
        return MotionDetector(confidence=confidence)
    plug_in = plug_in_of(spec, taken=model_names)
    if plug_in is not None:
        if labels is not None:
            raise UserError(f"labels file {labels} has no say: detector {spec!r} brings its own class names")
        return PlugInDetector(plug_in, spec, confidence=confidence)
    path = resolve_model(spec, role="detector", words=(MOTION, *plug_in_names()))
    model = open_model(path, settings=ModelSettings(threads=threads, provider=provider))
    return OnnxDetector(model, labels=labels, confidence=confidence, nms_iou=nms_iou, size=size)


def detect_every(given: int | None, *, fps: float) -> int:
    """Frames from one detection to the next: as given, else three a second, and every fifth frame at least.

    In a third of a second most objects still overlap themselves; with few frames a second every frame counts.
    """
    return given or min(5, max(1, round(fps / 3)))


def warm_up(detector: Detector, size: tuple[int, int]) -> None:
    """Run a network once at the (width, height) it will get: a runtime may compile for it, which takes 0.2 s.

    The motion detector, which remembers pictures, is left alone.
    """
    if not isinstance(detector, MotionDetector):
        detector.detect(np.zeros((size[1], size[0], 3), np.uint8))


class OnnxDetector:
    """A network with one of the known heads; arguments as of `open_detector`.

    Construction runs the network once on grey: that tells the head by its values too, and warms it up. Raises
    `UserError` where the model is not a detector, or the labels or the size do not fit it.
    """

    def __init__(
        self,
        model: OnnxModel,
        *,
        labels: Path | None = None,
        confidence: float = USUAL_CONFIDENCE,
        nms_iou: float = 0.45,
        size: tuple[int, int] | None = None,
    ) -> None:
        self.model = model
        self.head: Head
        self._confidence = confidence
        self._nms_iou = nms_iou
        self._fixed_size = _fixed_size(model, size)
        self._enlarge_to = _enlarge_to(model)
        self._output_index, self.head = _find_head(model, self._fixed_size or (_TRIAL_SIDE, _TRIAL_SIDE))
        self.class_names = _class_names(model, self.head, labels)
        self._group_ids = _group_ids(self.class_names)
        dtype = model.inputs[0].dtype
        assert dtype is not None
        self._letterboxer = Letterboxer(
            anchor=self.head.anchor, rgb=self.head.rgb, gain=self.head.gain, dtype=dtype
        )

    def detect(self, image_bgr: Image) -> Detections:
        """Run the network on one (height, width, 3) uint8 image of any size; grey is accepted too."""
        image = as_bgr(image_bgr)
        input_size = self.input_size((image.shape[1], image.shape[0]))
        tensor, letterbox = self._letterboxer.fill(image, input_size)
        output = self.model.run(tensor)[self._output_index].astype(np.float32, copy=False)
        found = self.head.decode(output, confidence=self._confidence, input_size=input_size)
        if self.head.suppresses:
            group_ids = self._group_ids[np.minimum(found.class_ids, len(self._group_ids) - 1)]
            candidates = found.boxes_input_px, found.scores, group_ids
            selected = suppress(*candidates, iou=self._nms_iou, any_class_iou=_TWIN_IOU)
        else:
            selected = np.argsort(-found.scores, kind="stable")[:MAX_DETECTIONS]
        boxes = letterbox.to_image(found.boxes_input_px[selected])
        class_ids = found.class_ids[selected]
        inside = (boxes[:, 2:] > boxes[:, :2]).all(axis=1) & (class_ids < len(self.class_names))
        return Detections(boxes[inside], found.scores[selected][inside], class_ids[inside])

    def input_size(self, image_size: tuple[int, int]) -> tuple[int, int]:
        """(width, height) in pixels that the network gets for an image of this (width, height).

        A network that was trained for small objects may want small images enlarged (``hvt.enlarge_to`` in its
        metadata): on a base stream of 640x360 a car is six pixels long, and lies within one cell.
        """
        if self._fixed_size is not None:
            return self._fixed_size
        longest = max(image_size)
        scale = min(max(1.0, min(self._enlarge_to / longest, _MOST_ENLARGED)), _MAX_FREE_SIDE / longest)
        width, height = (-int(-side * scale // _CELL) * _CELL for side in image_size)
        return max(width, _CELL), max(height, _CELL)


def _enlarge_to(model: OnnxModel) -> int:
    """The longer side in pixels to which small images are enlarged, ``hvt.enlarge_to`` of the metadata; 0: none."""
    text = model.metadata.get(_ENLARGE_TO, "0")
    if not (text.isascii() and text.isdigit() and len(text) <= 4 and int(text) <= _MAX_FREE_SIDE):
        raise UserError(
            f"model {model.path} has {_ENLARGE_TO} '{text:.80}' in its metadata; a whole number up to"
            f" {_MAX_FREE_SIDE} is accepted"
        )
    return int(text)


def _group_ids(class_names: tuple[str, ...]) -> npt.NDArray[np.int32]:
    """(C,) the number of the group of each class: one place holds one vehicle, whatever it is called.

    A class without a group stands for itself.
    """
    groups = [group_of(name) or name for name in class_names]
    return np.array([groups.index(group) for group in groups], np.int32)


def _fixed_size(model: OnnxModel, size: tuple[int, int] | None) -> tuple[int, int] | None:
    """(width, height) of the input, from the model or the user; None where every image chooses its own."""
    if len(model.inputs) != 1 or len(model.inputs[0].shape) != 4 or model.inputs[0].shape[1] not in (3, None):
        raise UserError(_not_a_detector(model, "its input is not one (1, 3, height, width) image"))
    batch, _, height, width = model.inputs[0].shape
    if batch not in (1, None):
        raise UserError(_not_a_detector(model, f"it takes {batch} images at once"))
    if model.inputs[0].dtype not in (np.float32, np.float16):
        raise UserError(_not_a_detector(model, "its input is neither float32 nor float16"))
    if size is None:
        # One free side gives a square; with both free, every image chooses.
        side = width or height
        return (width or side, height or side) if side else None
    if any(side % _CELL or not 0 < side <= _MAX_SIDE for side in size):
        raise UserError(
            f"detector size {size[0]}x{size[1]} is not accepted; multiples of {_CELL} to {_MAX_SIDE} are"
        )
    if size[0] != (width or size[0]) or size[1] != (height or size[1]):
        raise UserError(
            f"detector size {size[0]}x{size[1]} does not fit {model.path}, whose input is {width}x{height}"
        )
    return size


def _find_head(model: OnnxModel, trial_size: tuple[int, int]) -> tuple[int, Head]:
    """Run the network once on grey and find the one output that a known head explains."""
    width, height = trial_size
    dtype = model.inputs[0].dtype
    outputs = model.run(np.full((1, 3, height, width), 0.5, dtype))
    task = model.metadata.get("task", "detect")
    if task != "detect":
        raise UserError(_not_a_detector(model, f"its task is '{task}'"))
    heads = [(index, choose_head(output, trial_size)) for index, output in enumerate(outputs)]
    known = [(index, head) for index, head in heads if head is not None]
    if len(known) != 1:
        raise UserError(
            _not_a_detector(model, "of its outputs " + ("several" if known else "none") + " fit a known head")
        )
    return known[0]


def _not_a_detector(model: OnnxModel, why: str) -> str:
    outputs = "; ".join(map(str, model.outputs))
    return (
        f"model {model.path} is not a detector that is known here: {why}"
        f" (outputs: {outputs}; accepted heads: {ACCEPTED_HEADS})"
    )


def _class_names(model: OnnxModel, head: Head, labels: Path | None) -> tuple[str, ...]:
    names = read_labels(labels) if labels is not None else metadata_labels(model.metadata)
    origin = f"labels file {labels}" if labels is not None else f"metadata of {model.path}"
    if head.classes is None:
        if names is None:
            raise UserError(f"model {model.path} does not say its class names; give them with a labels file")
        return names
    if names is not None and len(names) != head.classes:
        raise UserError(f"{origin} has {len(names)} class names; {model.path} has {head.classes} classes")
    defaults = {len(COCO_NAMES): COCO_NAMES, len(VISDRONE_NAMES): VISDRONE_NAMES}
    numbered = tuple(f"class {index}" for index in range(head.classes))
    return names or defaults.get(head.classes, numbered)
