"""Classifiers of crops: ImageNet-style networks in ONNX.

How pixels are prepared, first rule that applies:

1. The model's metadata says it: ``hvt.mean`` and ``hvt.scale`` (one number or three, network value =
   (pixel - mean) * scale, pixels 0…255, numbers in the order of the network's channels) and ``hvt.channel_order``
   (``RGB`` or ``BGR``).
2. The network takes uint8, or its first steps subtract a mean or divide: plain pixels, 0…1 or 0…255 as these say.
3. The metadata say Ultralytics' classify (``author``, ``task``): RGB, pixel / 255.
4. 1001 classes, TensorFlow's ImageNet with a background class: RGB, (pixel - 128) / 128.
5. An OpenVINO model (``.xml``): BGR 0…255, as the Open Model Zoo takes them.
6. Anything else, as torchvision and the ONNX model zoo train (ResNet-50): RGB, mean 123.675 116.28 103.53, scale
   1/58.395 1/57.12 1/57.375. The last two are guesses, and are said.

The crop is resized to the network's input as a whole, without keeping its shape. The usual "shorter side 256, centre
crop 224" is meant for photographs; a crop around a box is already centred on its object and must not lose its ends.
"""

import logging
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.inference.class_names import IMAGENET_NAMES
from hvt_common.inference.labels import class_labels, first_synonym, read_labels, unnamed
from hvt_common.inference.letterbox import Preparation, as_bgr, prepared_as
from hvt_common.inference.runtimes.model import ModelSettings, OnnxModel, open_model, own_steps
from hvt_common.inference.runtimes.model_file import is_ir
from hvt_common.inference.store import resolve_model
from hvt_common.values import Image, Posterior

_log = logging.getLogger(__name__)

_IMAGENET_CLASSES = 1000
_BACKGROUND = "background"
_MAX_BATCH = 32
_MAX_SIDE = 2048
_USUAL_SIDE = 224
_OPPOSITE = -30.0
"""Times noise of 1: with it logits leave 0…1."""


class Classifier(Protocol):
    """Classifies crops."""

    @property
    def class_names(self) -> tuple[str, ...]:
        """The classes of ``probabilities``, in order."""

    def classify(self, crops_bgr: Sequence[Image]) -> list[Posterior]:
        """One posterior a crop, in order."""


_TENSORFLOW = Preparation(mean=(128.0,) * 3, scale=(1 / 128,) * 3)
_OPEN_MODEL_ZOO = Preparation(mean=(0.0,) * 3, scale=(1.0,) * 3, rgb=False)
_ULTRALYTICS = Preparation(mean=(0.0,) * 3, scale=(1 / 255,) * 3)


def open_classifier(
    spec: str, *, labels: Path | None = None, threads: int = 1, provider: str = "cpu"
) -> Classifier:
    """Open an ONNX classifier by the name of a model (see `resolve_model`) or the path of a file.

    ``labels`` are class names, one a line; else those of the metadata, ImageNet's, or "class 0" and so on. 1000
    names fit a model of 1001 classes (a background comes first), and the reverse. The first synonym is shown.
    Raises `UserError` where there is no such model, it is not a classifier, or metadata or labels do not fit.
    """
    path = resolve_model(spec, role="classifier")
    model = open_model(path, settings=ModelSettings(threads=threads, provider=provider))
    return OnnxClassifier(model, labels=labels)


class OnnxClassifier:
    """A network from one image to one row of scores; arguments as of `open_classifier`.

    Construction runs the network once on noise, to distinguish logits (softmax is applied) from probabilities
    (each row sums to one). Raises `UserError` where the model is not a classifier, or its metadata or the
    labels do not fit.
    """

    def __init__(self, model: OnnxModel, *, labels: Path | None = None) -> None:
        self.model = model
        self._channels_first, self._batch, self._size = _geometry(model)
        names = read_labels(labels) if labels is not None else class_labels(model.path, model.metadata)
        self._output_index, classes, self._logits = self._try_out(None if names is None else len(names))
        self.preparation, self.why = _preparation(model, classes)
        _log.info("%s is taken for a classifier; pixels %s: %s", model.path.name, self.preparation, self.why)
        self.class_names = _class_names(model, classes, names, labels)

    def classify(self, crops_bgr: Sequence[Image]) -> list[Posterior]:
        """Classify (height, width, 3) uint8 crops of any size (or grey); a free batch takes all of them at once."""
        batch = self._batch or _MAX_BATCH
        posteriors = []
        for start in range(0, len(crops_bgr), batch):
            crops = [self._prepared(crop) for crop in crops_bgr[start : start + batch]]
            missing = self._batch - len(crops) if self._batch else 0
            stack = np.stack(crops + crops[:1] * missing)
            output = self.model.run(stack)[self._output_index]
            if output.size != len(stack) * len(self.class_names) or len(output) != len(stack):
                raise UserError(
                    f"model {self.model.path} answers {len(stack)} crops with {output.shape}, and has"
                    f" {len(self.class_names)} classes"
                )
            posteriors += [self._posterior(row) for row in self._probabilities(output)[: len(crops)]]
        return posteriors

    def _prepared(self, crop_bgr: Image) -> npt.NDArray[Any]:
        # The network's input for one crop, without the batch axis.
        crop = as_bgr(crop_bgr)
        shrinks = crop.shape[1] >= self._size[0] and crop.shape[0] >= self._size[1]
        resized = cv2.resize(crop, self._size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
        ordered = resized[..., ::-1] if self.preparation.rgb else resized
        mean, scale = (np.array(v, np.float32) for v in (self.preparation.mean, self.preparation.scale))
        values = (ordered - mean) * scale
        return (values.transpose(2, 0, 1) if self._channels_first else values).astype(
            self.model.inputs[0].dtype
        )

    def _probabilities(self, output: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
        rows = output.reshape(len(output), -1).astype(np.float64)
        # A row that is not finite says nothing: the uniform distribution.
        rows[~np.isfinite(rows).all(axis=1)] = 1.0
        if self._logits:
            rows = np.exp(rows - rows.max(axis=1, keepdims=True))
        rows = np.maximum(rows, 0)
        return np.asarray(rows / np.maximum(rows.sum(axis=1, keepdims=True), 1e-12), np.float32)

    def _posterior(self, probabilities: npt.NDArray[np.float32]) -> Posterior:
        best = int(probabilities.argmax())
        some = probabilities[probabilities > 0].astype(np.float64)
        return Posterior(
            class_name=self.class_names[best],
            confidence=float(probabilities[best]),
            entropy_nats=max(0.0, float(-(some * np.log(some)).sum())),
            probabilities=probabilities,
        )

    def _try_out(self, names: int | None) -> tuple[int, int, bool]:
        # (output, classes, whether logits): probabilities add up to 1, or lie in 0…1; of several, as many as names.
        batch, (width, height) = self._batch or 1, self._size
        shape = (batch, 3, height, width) if self._channels_first else (batch, height, width, 3)
        noise = np.random.default_rng(0).normal(0, 1, shape)
        pictures = [noise, noise * _OPPOSITE]
        if self.model.inputs[0].dtype == np.uint8:
            pictures = [np.clip(128 + 64 * one, 0, 255) for one in (noise, -noise)]
        rows = self._rows(pictures, batch)
        if not all(np.isfinite(row[0]).all() for row in rows.values()):
            # It may take a root of its pixels, and no picture has one below 0.
            rows = self._rows([np.full(shape, 0.5), np.abs(pictures[1])], batch)
        if not rows:
            raise UserError(_not_a_classifier(self.model, "no output is one row of scores an image"))
        sizes = {row.shape[1] for row in rows.values()}
        fitting = (
            [index for index, row in rows.items() if row.shape[1] == names] if len(sizes) > 1 else list(rows)
        )
        if not fitting:
            raise UserError(
                _not_a_classifier(
                    self.model, "several outputs are scores, which --labels decides by their number"
                )
            )
        row = rows[fitting[0]]
        if not np.isfinite(row[0]).all():
            raise UserError(_not_a_classifier(self.model, "its scores of a picture are no numbers (NaN)"))
        if any((rows[index].argmax(axis=1) != row.argmax(axis=1)).any() for index in fitting):
            raise UserError(_not_a_classifier(self.model, "several outputs are scores, and not of the same"))
        sums_to_one = row[0].min() >= 0 and abs(row[0].sum() - 1) < 1e-2
        each = bool(np.isfinite(row).all() and row.min() >= 0 and row.max() <= 1)
        if each and not sums_to_one:
            _log.warning(
                "%s says a probability of each class by itself (sigmoid): they are made to add up to 1",
                self.model.path.name,
            )
        return fitting[0], row.shape[1], not (sums_to_one or each)

    def _rows(self, pictures: Sequence[npt.NDArray[Any]], batch: int) -> dict[int, npt.NDArray[np.float64]]:
        # By output that may be scores: a row of each picture.
        runs = [self.model.run(one.astype(self.model.inputs[0].dtype)) for one in pictures]
        return {
            index: np.stack([run[index].reshape(batch, -1)[0].astype(np.float64) for run in runs])
            for index, output in enumerate(runs[0])
            if _is_scores(output, batch)
        }


def _geometry(model: OnnxModel) -> tuple[bool, int | None, tuple[int, int]]:
    # Whether channels come first, the batch (None: free), and the (width, height) of the input.
    shape = model.inputs[0].shape if len(model.inputs) == 1 else ()
    if len(shape) != 4 or (3 not in (shape[1], shape[3]) and shape[1] is not None):
        raise UserError(_not_a_classifier(model, "its input is not one image of three channels"))
    if model.inputs[0].dtype not in (np.float32, np.float16, np.uint8):
        raise UserError(_not_a_classifier(model, "its input is neither float32, float16 nor uint8"))
    channels_first = shape[1] == 3 or shape[3] != 3
    said = [int(word) for word in re.findall(r"\d{2,4}", model.metadata.get("imgsz", ""))]  # height, width
    usual = (said * 2)[:2] if said else [_USUAL_SIDE, _USUAL_SIDE]
    declared = shape[2:] if channels_first else shape[1:3]
    height, width = (side or free for side, free in zip(declared, usual, strict=True))
    if max(width, height) > _MAX_SIDE:
        raise UserError(_not_a_classifier(model, f"its input is {width}x{height} pixels"))
    return channels_first, shape[0], (width, height)


def _is_scores(output: npt.NDArray[Any], batch: int) -> bool:
    # (batch, C), or (batch, C, 1, 1) as some exports leave it, with at least two classes.
    if not np.issubdtype(output.dtype, np.floating) or output.ndim < 2 or len(output) != batch:
        return False
    return output.shape[1] >= 2 and all(size == 1 for size in output.shape[2:])


def _not_a_classifier(model: OnnxModel, why: str) -> str:
    ports = "; ".join(map(str, (*model.inputs, *model.outputs)))
    return (
        f"model {model.path} is not a classifier that is known here: {why}"
        f" (it has {ports}; accepted: an image (N, 3, H, W) or (N, H, W, 3) in, scores (N, C) out)"
    )


def _preparation(model: OnnxModel, classes: int) -> tuple[Preparation, str]:
    said = model.metadata
    if said.get("author") == "Ultralytics" or said.get("task") == "classify":
        usual, why = _ULTRALYTICS, "its metadata say Ultralytics' classify"
    elif classes == _IMAGENET_CLASSES + 1:
        usual, why = _TENSORFLOW, "1001 classes, as TensorFlow trains"
    elif is_ir(model.path):
        usual, why = _OPEN_MODEL_ZOO, "assumed, as the Open Model Zoo takes them"
    else:
        usual, why = Preparation.torchvision(), "assumed, as torchvision trains"
    own, dtype = own_steps(model), model.inputs[0].dtype
    usual = usual.beside(own)
    why = "it scales them itself" if own.top is not None or dtype == np.uint8 else why
    if any(key.startswith("hvt.") for key in said):
        why = "its metadata say so"
    return prepared_as(model.path, said, usual, dtype), why


def _class_names(
    model: OnnxModel, classes: int, names: tuple[str, ...] | None, labels: Path | None
) -> tuple[str, ...]:
    if names is None and classes in (_IMAGENET_CLASSES, _IMAGENET_CLASSES + 1):
        _log.info("%s has no class names: its %d classes are taken for ImageNet's", model.path.name, classes)
        names = IMAGENET_NAMES
    if names is None:
        return unnamed(model.path, classes, "--labels FILE names them")
    fit = (len(names), classes)
    if fit == (_IMAGENET_CLASSES, _IMAGENET_CLASSES + 1):
        names = (_BACKGROUND, *names)
    elif fit == (_IMAGENET_CLASSES + 1, _IMAGENET_CLASSES) and names[0].lower() == _BACKGROUND:
        names = names[1:]
    if len(names) != classes:
        origin = f"labels file {labels}" if labels is not None else f"metadata of {model.path}"
        raise UserError(
            f"{origin} has {len(names)} class names, {model.path} has {classes} classes; as many are expected"
            f" (or {_IMAGENET_CLASSES} for {_IMAGENET_CLASSES + 1}, or the reverse if the first is '{_BACKGROUND}')"
        )
    return tuple(first_synonym(name) for name in names)
