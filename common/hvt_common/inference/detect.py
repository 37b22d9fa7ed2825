"""Detectors: an ONNX network with one of the known heads, plain motion, or another package's."""

import logging
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.inference.class_names import group_of
from hvt_common.inference.heads import HEAD_NAMES
from hvt_common.inference.heads.choose import Trial, check_head_name, choose_head, trial_pictures
from hvt_common.inference.heads.contract import HeadOutput, is_like
from hvt_common.inference.labels import (
    USUAL_CONFIDENCE,
    class_labels,
    counts_from_one,
    default_confidence,
    detector_labels,
    read_labels,
)
from hvt_common.inference.letterbox import Letterbox, Letterboxer, as_bgr, prepared_as, without_palette
from hvt_common.inference.nms import MAX_DETECTIONS, WEAK, averaged, suppress
from hvt_common.inference.runtimes.model import TRAINED_HERE, ModelSettings, OnnxModel, open_model, own_steps
from hvt_common.inference.runtimes.plug_in import PlugInDetector, plug_in_names, plug_in_of
from hvt_common.inference.store import MOTION, library_part, model_names, needed_part, parts_of, resolve_model
from hvt_common.runtime.failures import Failures
from hvt_common.values import Detections, Image

_log = logging.getLogger(__name__)

_CELL = 32  # input sides are multiples of the largest usual stride
_CELLS = (_CELL, 64, 128)
"""Larger ones of networks with more levels (P6, P7)."""
_TRIAL_CELLS = (9, 7)
"""Odd: a network of a larger stride than assumed shows it."""
_USUAL_SIDE = 640
_MAX_FREE_SIDE = 1920
_MAX_SIDE = 8192
_ENLARGE_TO = "hvt.enlarge_to"
_MOST_ENLARGED = 2.0
"""Beyond that nothing more is found, and the time grows with the square."""
_THERMAL_SHARE, _SECOND_SHARE = 0.65, 0.76
"""A small picture without colour is enlarged to this share of that side: larger, 640x512 shows people that are none.
The second network of a file is silent there; a second run, at this share of the size, agrees instead (`averaged`).
"""
_CONTRAST, _ALIKE = 64, 20
"""Of a picture in which a network's scores differ from place to place, as they do in one of so many.

Scores in steps of 1/127 are all 0 in many a picture without objects.
"""
_BROKEN = 0.1
"""Where no more of an answer is no number, that is some cells; the scores of one class are a fifth."""
_TWIN_IOU = 0.8
"""Two boxes that overlap more are one object, whatever their classes: networks call one vehicle a car and a van. A
rider and the bicycle below overlap less."""


class FailingDetector(Protocol):
    """A detector, or one that may not work at the moment."""

    @property
    def class_names(self) -> tuple[str, ...]:
        """The names that ``class_ids`` index."""

    def detect(self, image_bgr: Image) -> Detections | None:
        """As `Detector.detect`; None while it does not work."""


class Detector(FailingDetector, Protocol):
    """Finds objects in one image after the other, of any sizes. One thread at a time calls it.

    This is also the contract of a plug-in (``hvt.detectors``, docs/models.md): its answer depends on the image alone,
    and it may raise; then the flight goes on without detections, and it is opened again after a pause.
    """

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
    head: str | None = None,
    threads: int = 1,
    provider: str = "cpu",
    failures: Failures | None = None,
) -> Detector:
    """Open a detector: ``motion``, the name of a model (see `resolve_model`), a file, a plug-in's name, or ``A+B``.

    ``labels`` are class names, see `read_labels`; else those of the metadata, or "class 0" and so on, which is said.
    ``head`` is one of `heads.HEAD_NAMES`; else the file tells, or what it answers. ``confidence`` is the least
    of a detection, ``nms_iou`` the largest overlap of two of one class, both 0…1. ``size`` is (width, height) of the
    network's input where the model leaves it free; else each image gets the multiples of the network's stride that
    hold it (at most 1920 on the longer side, or ``imgsz`` of the metadata). ``confidence`` of a plug-in is applied to
    its answer, that of ``A+B`` (`hvt_models.detectors`) is on the scale of A. For these and for `MOTION` ``labels``,
    ``head`` and ``size`` are refused. With ``failures`` a part of ``A+B`` that raises is opened again alone; the
    others go on.
    Raises `UserError` where there is no such model, it is no detector, its labels do not fit, or a setting is out of
    its range.
    """
    for name, value in (("confidence", confidence), ("NMS IoU", nms_iou)):
        if not 0 <= value <= 1:
            raise UserError(f"{name} {value} is not accepted; a number from 0 to 1 is")
    check_head_name(head)
    parts = parts_of(spec)
    plug_in = None if spec == MOTION or parts[1:] else plug_in_of(spec, taken=model_names)
    if spec == MOTION or parts[1:] or plug_in is not None:
        for word, given in (("labels file", labels), ("--head", head), ("detector size", size)):
            if given is not None:
                raise UserError(f"{word} {given} has no effect: {spec!r} is no network of one file")
    if parts[1:]:
        settings = {"nms_iou": nms_iou, "threads": threads, "provider": provider}
        return _open_ensemble(parts, confidence=confidence, settings=settings, failures=failures)
    if spec == MOTION:
        motion: Detector = needed_part(MOTION, f"detector {MOTION}")(confidence=confidence)
        return motion
    if plug_in is not None:
        return PlugInDetector(plug_in, spec, confidence=confidence)
    path = resolve_model(spec, role="detector", words=(MOTION, *plug_in_names()))
    model = open_model(path, settings=ModelSettings(threads=threads, provider=provider))
    return OnnxDetector(model, labels=labels, confidence=confidence, nms_iou=nms_iou, size=size, head=head)


def _open_ensemble(
    parts: tuple[str, ...], *, confidence: float, settings: Mapping[str, Any], failures: Failures | None
) -> Detector:
    name = "+".join(parts)
    if MOTION in parts:
        raise UserError(
            f"detector {name!r} is not accepted: {MOTION} looks at several pictures, and stands alone"
        )
    ensemble: Detector = needed_part("ensemble", f"detector {name!r}")(
        lambda part, confidence: open_detector(part, confidence=confidence, **settings),
        {part: default_confidence(part) for part in parts},
        confidence=confidence,
        failures=failures,
    )
    return ensemble


def detect_every(given: int | None, *, fps: float) -> int:
    """Frames from one detection to the next: as given, else three a second, and every fifth frame at least.

    In a third of a second most objects still overlap themselves; with few frames a second every frame counts.
    """
    return given or min(5, max(1, round(fps / 3)))


def detect_still_every(given: int | None, *, fps: float) -> int:
    """The most, while nothing is seen that was not predicted (`ByteTracker.is_due`): a second, or as given."""
    return given or max(detect_every(None, fps=fps), round(fps))


def warm_up(detector: FailingDetector, size: tuple[int, int]) -> bool:
    """Run a network once at the (width, height) it will get: a runtime may compile for it, which takes 0.2 s.

    Returns whether it works. The motion detector, which remembers pictures, is left alone.
    """
    motion = library_part(MOTION)
    return (motion is not None and isinstance(detector, motion)) or detector.detect(
        np.full((size[1], size[0], 3), (9, 0, 0), np.uint8)
    ) is not None


class OnnxDetector:
    """A network with one of the known heads; arguments as of `open_detector`.

    Construction runs the network on a few made pictures: that tells the head by its values too, and warms it up.
    Raises `UserError` where the model is not a detector, its head is open, or the labels or the size do not fit it.
    """

    def __init__(
        self,
        model: OnnxModel,
        *,
        labels: Path | None = None,
        confidence: float = USUAL_CONFIDENCE,
        nms_iou: float = 0.45,
        size: tuple[int, int] | None = None,
        head: str | None = None,
    ) -> None:
        self.model = model
        self._confidence = confidence
        self._nms_iou = nms_iou
        # Of others the surest box counts, as their authors have it.
        self._averages = TRAINED_HERE in model.metadata
        task = model.metadata.get("task", "")
        if task and "detect" not in task.lower():
            raise UserError(_not_a_detector(model, f"its task is '{task:.80}', and detect is accepted"))
        self._channels_last, declared = _geometry(model)
        names = read_labels(labels) if labels is not None else class_labels(model.path, model.metadata)
        self._cells = _cells(model)
        self._fixed_size = _fixed_size(model, declared, size, self._cells[0])
        self._enlarge_to, self._trained_at = _enlarge_to(model), _trained_at(model)
        trial = self._try_out(None if names is None else len(names))
        try:
            self.head = choose_head(trial, wanted=head)
        except UserError as error:
            raise UserError(_not_a_detector(model, str(error), channels_last=self._channels_last)) from None
        if any(model.outputs[index].dtype in (np.int8, np.uint8) for index in self.head.outputs):
            why = "its answer is 8-bit numbers without their scale: end its graph with DequantizeLinear"
            raise UserError(_not_a_detector(model, why))
        usual = self.head.preparation.beside(own_steps(model))
        dtype = model.inputs[0].dtype
        assert dtype is not None
        self.preparation = prepared_as(model.path, model.metadata, usual, dtype)
        said_by = f"labels file {labels}" if labels is not None else f"metadata of {model.path}"
        self.class_names = detector_labels(
            *(model.path, names, said_by),
            head=self.head.name,
            classes=self.head.classes,
            inputs=len(model.inputs),
        )
        self._group_ids = _group_ids(self.class_names)
        self._are_names, self._beyond_said = names is not None, False
        self._alike_left = _ALIKE if self.head.suppresses else 0
        self._letterboxer = Letterboxer(
            anchor=self.head.anchor,
            preparation=self.preparation,
            dtype=dtype,
            channels_last=self._channels_last,
        )
        _log.info("%s is taken for %s: %s; %s", model.path.name, self.head.name, self.head.why, self.pixels)

    @property
    def pixels(self) -> str:
        """The network's preparation of pixels, in words."""
        how = (
            "stretched" if self.head.anchor == "stretch" else f"letterbox {self.head.anchor}, filled with 114"
        )
        return f"{self.preparation}, {how}{', channels last' if self._channels_last else ''}"

    def detect(self, image_bgr: Image, *, share: float = 1.0) -> Detections:
        """Run the network on one (height, width, 3) uint8 image of any size; grey is accepted too.

        ``share`` is as of `input_size`.
        Raises `UserError` where it does not run, or no number comes out: that is no picture without objects.
        """
        image = as_bgr(image_bgr)
        image, is_grey = without_palette(image) if self._enlarge_to else (image, False)
        thermal = is_grey and max(image.shape) < self._enlarge_to
        least = min(self._confidence, WEAK) if self._averages else self._confidence
        size = (image.shape[1], image.shape[0])
        whole, smaller = (
            self.input_size(size, share=share * part, thermal=thermal) for part in (1.0, _SECOND_SHARE)
        )
        found, letterbox = self._candidates(image, whole, least)
        if thermal and smaller != whole and self._averages and self.head.suppresses:
            found = _joined(found, letterbox, *self._candidates(image, smaller, least))
        if self.head.suppresses:
            group_ids = self._group_ids[np.minimum(found.class_ids, len(self._group_ids) - 1)]
            candidates = found.boxes_input_px, found.scores, group_ids
            selected = suppress(*candidates, iou=self._nms_iou, any_class_iou=_TWIN_IOU)
        else:
            selected = np.argsort(-found.scores, kind="stable")[:MAX_DETECTIONS]
        boxes, scores = found.boxes_input_px[selected], found.scores[selected]
        if self.head.suppresses and self._averages:
            boxes, scores = averaged(*candidates, selected, iou=self._nms_iou, second=found.second)
            best = np.argsort(-scores, kind="stable")[: np.count_nonzero(scores >= self._confidence)]
            boxes, scores, selected = boxes[best], scores[best], selected[best]
        boxes = letterbox.to_image(boxes)
        class_ids = found.class_ids[selected]
        named = class_ids < len(self.class_names)
        if self._are_names and not named.all() and counts_from_one(self.head.name):
            raise UserError(
                f"model {self.model.path} lists class {class_ids.max()}, and has names of class 0 to class"
                f" {len(self.class_names) - 1}: the names are of other numbers; --labels names all, a background too"
            )
        if not named.all() and not self._beyond_said:
            self._beyond_said = True
            _log.warning(
                "%s lists class %d, and has names up to class %d: what has no name is left out; --labels names all",
                self.model.path.name,
                int(class_ids.max()),
                len(self.class_names) - 1,
            )
        inside = (boxes[:, 2:] > boxes[:, :2]).all(axis=1) & named
        return Detections(boxes[inside], scores[inside], class_ids[inside])

    def _candidates(
        self, image: Image, input_size: tuple[int, int], least: float
    ) -> tuple[HeadOutput, Letterbox]:
        # The answer of the network to the picture at one size, from a score of ``least`` on.
        tensor, letterbox = self._letterboxer.fill(image, input_size)
        outputs = self._run(tensor)
        try:
            found = self.head.decode(outputs, confidence=least, input_size=input_size)
        except UserError as error:
            raise UserError(f"model {self.model.path} {error}") from None
        if self._alike_left and int(image.max()) - int(image.min()) > _CONTRAST:
            scores = self.head.decode(outputs, confidence=0.0, input_size=input_size).scores
            alike = not len(scores) or scores.min() == scores.max()
            self._alike_left = self._alike_left - 1 if alike else 0
            if alike and not self._alike_left:
                _log.warning(
                    "%s gave all places of each of %d pictures one score (%.3g), and told no object: if it was"
                    " made smaller (INT8), boxes and scores need a scale each; one of floating point is accepted",
                    self.model.path.name,
                    _ALIKE,
                    max(scores, default=0.0),
                )
        used = [outputs[index] for index in self.head.outputs]
        if not len(found.scores) and any(np.isnan(one).sum() > _BROKEN * one.size for one in used):
            raise UserError(f"model {self.model.path} answers a picture with what is no number (NaN)")
        if found.wrong:
            raise UserError(
                f"model {self.model.path} answers a picture with {found.wrong}: it is not {self.head.name}, or is"
                " broken"
            )
        return found, letterbox

    def input_size(
        self, image_size: tuple[int, int], *, share: float = 1.0, thermal: bool = False
    ) -> tuple[int, int]:
        """(width, height) in pixels that the network gets for an image of this (width, height).

        A network that was trained for small objects may want small images enlarged (``hvt.enlarge_to`` in its
        metadata): on a base stream of 640x360 a car is six pixels long, and lies within one cell. One that says the
        side that it was trained at (``imgsz``) gets that side. A ``share`` of these sides is for slow machines.
        """
        if self._fixed_size is not None:
            return self._fixed_size
        longest = max(image_size)
        wanted = self._enlarge_to * (_THERMAL_SHARE if thermal else 1) or self._trained_at
        scale = min(wanted / longest, _MOST_ENLARGED) if wanted else 1.0
        if not self._trained_at or self._enlarge_to:
            scale = max(1.0, scale)
        scale = min(scale, _MAX_FREE_SIDE / longest) * share
        cell = self._cells[0]
        width, height = (-int(-side * scale // cell) * cell for side in image_size)
        return max(width, cell), max(height, cell)

    def _run(self, tensor: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
        # A second input is the picture's width and height (``orig_target_sizes``); turned round if called a shape.
        if len(self.model.inputs) == 1:
            return self.model.run(tensor)
        port = self.model.inputs[1]
        height, width = tensor.shape[1:3] if self._channels_last else tensor.shape[2:]
        sides = (height, width) if "shape" in port.name.lower() else (width, height)
        return self.model.run(tensor, np.array([sides], port.dtype))

    def _try_out(self, names: int | None) -> Trial:
        # Run the network on `trial_pictures`; where its sides are free, at the least multiples that it takes.
        if self._fixed_size is not None:
            return self._tried(self._fixed_size, names)
        failure: UserError | None = None
        for index, cell in enumerate(self._cells):
            try:
                trial = self._tried((_TRIAL_CELLS[0] * cell, _TRIAL_CELLS[1] * cell), names)
            except UserError as error:
                failure = failure or error
                continue
            self._cells = self._cells[index:]
            return trial
        side = self._trained_at or _USUAL_SIDE
        try:  # its sides are free by name alone
            trial = self._tried((side, side), names)
        except UserError:
            assert failure is not None
            raise failure from None
        self._fixed_size = (side, side)
        _log.info("%s runs at %dx%d alone, though its file says any size", self.model.path.name, side, side)
        return trial

    def _tried(self, size: tuple[int, int], names: int | None) -> Trial:
        dtype = self.model.inputs[0].dtype
        assert dtype is not None
        runs: list[list[npt.NDArray[Any]]] = []
        tops: list[int] = []
        for picture, top in trial_pictures(size, dtype):
            laid = np.ascontiguousarray(picture.transpose(0, 2, 3, 1)) if self._channels_last else picture
            try:
                outputs = self._run(laid)
            except UserError:
                if not runs:
                    raise
                continue  # a network that fails on some pictures only is opened again in flight
            # Half precision may overflow where the range of the pixels is not the network's.
            if not top or all(_is_finite(output) for output in outputs):
                runs.append(outputs)
                tops.append(top)
        return Trial(
            self.model.outputs, _of_one_form(self.model, runs), tops, size, self.model.metadata, names
        )


def _joined(a: HeadOutput, a_lies: Letterbox, b: HeadOutput, b_lies: Letterbox) -> HeadOutput:
    # Two looks at one picture: boxes in the pixels of the first, ``second`` tells those of the other.
    (a_corner, a_size), (b_corner, b_size) = (np.array(one.content).reshape(2, 2) for one in (a_lies, b_lies))
    boxes = (b.boxes_input_px.reshape(-1, 2, 2) - b_corner) * (a_size / b_size) + a_corner
    return HeadOutput(
        np.concatenate([a.boxes_input_px, boxes.reshape(-1, 4).astype(np.float32)]),
        np.concatenate([a.scores, b.scores]),
        np.concatenate([a.class_ids, b.class_ids]),
        second=np.arange(len(a.scores) + len(b.scores)) >= len(a.scores),
    )


def _of_one_form(model: OnnxModel, runs: list[list[npt.NDArray[Any]]]) -> list[list[npt.NDArray[Any]]]:
    # Where nothing is found some networks write an empty output of another form: here none of the usual one.
    usual = next((run for run in runs if all(one.size for one in run)), runs[0])
    boxed = {one.shape[:-1] for one in usual if one.shape[-1:] == (4,)}
    for run in runs:
        for index, (one, first) in enumerate(zip(run, usual, strict=True)):
            if is_like(one.shape, first.shape):
                continue
            if one.size or not first.ndim:
                said = f"it answers one picture with {first.shape}, another with {one.shape}"
                raise UserError(_not_a_detector(model, said))
            listed = first.ndim < 2 or first.shape in boxed
            run[index] = first[..., :0] if listed else first[..., :0, :]
    return runs


def _is_finite(output: npt.NDArray[Any]) -> bool:
    return not np.issubdtype(output.dtype, np.floating) or bool(np.isfinite(output).all())


def _cells(model: OnnxModel) -> tuple[int, ...]:
    # Multiples that the sides of a free input may have, likeliest first: ``stride`` of the metadata, if it says.
    text = model.metadata.get("stride", "")
    if text.isascii() and text.isdigit() and int(text) in (8, 16, *_CELLS):
        return (max(_CELL, int(text)),)
    return _CELLS


def _trained_at(model: OnnxModel) -> int:
    # The longer side of ``imgsz`` in the metadata, pixels: ``[640, 640]`` or ``640``; 0 where it does not say.
    sides = [int(word) for word in re.findall(r"\d{2,4}", model.metadata.get("imgsz", ""))]
    return min(max(sides), _MAX_FREE_SIDE) if 1 <= len(sides) <= 2 else 0


def _enlarge_to(model: OnnxModel) -> int:
    # The longer side in pixels to which small images are enlarged, ``hvt.enlarge_to`` of the metadata; 0: none.
    text = model.metadata.get(_ENLARGE_TO, "0")
    if not (text.isascii() and text.isdigit() and len(text) <= 4 and int(text) <= _MAX_FREE_SIDE):
        raise UserError(
            f"model {model.path} has {_ENLARGE_TO} '{text:.80}' in its metadata; a whole number up to"
            f" {_MAX_FREE_SIDE} is accepted"
        )
    return int(text)


def _group_ids(class_names: tuple[str, ...]) -> npt.NDArray[np.int32]:
    # (C,) one place holds one vehicle, whatever it is called; a class without a group stands for itself.
    groups = [group_of(name) or name for name in class_names]
    return np.array([groups.index(group) for group in groups], np.int32)


def _geometry(model: OnnxModel) -> tuple[bool, tuple[int | None, int | None]]:
    # Whether channels come last, and the (width, height) that the file declares, None where free.
    image, *more = model.inputs
    one = len(image.shape) == 4 and (3 in (image.shape[1], image.shape[3]) or image.shape[1] is None)
    if not one or len(more) > 1 or any(port.shape[1:] != (2,) or port.dtype is None for port in more):
        why = "its input is not one (1, 3, height, width) image, or that and its size"
        raise UserError(_not_a_detector(model, why))
    if more and "scale" in more[0].name.lower():
        what = f"its second input {more[0].name!r} is no size of the picture: export it without"
        raise UserError(_not_a_detector(model, what))
    if image.shape[0] not in (1, None):
        raise UserError(_not_a_detector(model, f"it takes {image.shape[0]} images at once"))
    if image.dtype not in (np.float32, np.float16, np.uint8):
        raise UserError(_not_a_detector(model, "its input is neither float32, float16 nor uint8"))
    channels_last = image.shape[3] == 3 and image.shape[1] != 3
    height, width = image.shape[1:3] if channels_last else image.shape[2:]
    return channels_last, (width, height)


def _fixed_size(
    model: OnnxModel, declared: tuple[int | None, int | None], size: tuple[int, int] | None, cell: int
) -> tuple[int, int] | None:
    # (width, height) of the input, from the model or the user; None where every image chooses its own.
    width, height = declared
    if size is None:
        # One free side gives a square; with both free, every image chooses.
        side = width or height
        return (width or side, height or side) if side else None
    if any(side % cell or not 0 < side <= _MAX_SIDE for side in size):
        raise UserError(
            f"detector size {size[0]}x{size[1]} is not accepted; multiples of {cell} to {_MAX_SIDE} are"
        )
    if size[0] != (width or size[0]) or size[1] != (height or size[1]):
        raise UserError(
            f"detector size {size[0]}x{size[1]} does not fit {model.path}, whose input is {width}x{height}"
        )
    return size


def _not_a_detector(model: OnnxModel, why: str, *, channels_last: bool = False) -> str:
    inputs = "; ".join(map(str, model.inputs)) + (", channels last" if channels_last else "")
    outputs = "; ".join(map(str, model.outputs))
    return (
        f"model {model.path} is not a detector that is known here: {why}"
        f" (input: {inputs}; outputs: {outputs}; accepted heads: {', '.join(HEAD_NAMES)})"
    )
