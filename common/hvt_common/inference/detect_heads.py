"""What the outputs of detector networks mean.

=====================  ===========  =======================================================================
head                   output       columns
=====================  ===========  =======================================================================
YOLOX                  (1, A, 5+C)  x, y relative to the cell and log w, log h in strides; objectness; C scores
YOLOX, decoded         (1, A, 5+C)  centre x, y, w, h in input pixels; objectness; C scores
Ultralytics            (1, 4+C, A)  centre x, y, w, h in input pixels; C scores (rows, not columns)
end-to-end             (1, N, 6)    x1, y1, x2, y2 in input pixels; score; class
=====================  ===========  =======================================================================

A is the number of cells of all strides for the input size, which no class count equals by accident: that is how the
first and the third are told apart. All scores are probabilities already. The two kinds of YOLOX export differ in
nothing but values: raw boxes lie within a cell or so of zero, decoded ones near their own cell, and whichever of the
two distances is smaller on a trial run decides. Sources: YOLOX `yolo_head.py` and `demo_utils.py` (Megvii);
Ultralytics `Detect` head and its export with and without NMS.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from hvt_common.inference.letterbox import Anchor
from hvt_common.values import Boxes

__all__ = [
    "ACCEPTED_HEADS",
    "EndToEndHead",
    "Head",
    "HeadOutput",
    "UltralyticsHead",
    "YoloxHead",
    "anchor_count",
    "choose_head",
]

Array = npt.NDArray[np.float32]

ACCEPTED_HEADS = "YOLOX (1, A, 5+C), Ultralytics (1, 4+C, A) and end-to-end (1, N, 6)"

_YOLOX_STRIDES: tuple[tuple[int, ...], ...] = ((8, 16, 32), (8, 16, 32, 64), (8, 16, 32, 12, 24, 48))
_ULTRALYTICS_STRIDES: tuple[tuple[int, ...], ...] = ((8, 16, 32), (8, 16, 32, 64), (4, 8, 16, 32), (16, 32))
_MAX_LOG_SIZE = 20.0  # e^20 strides: far outside every image, and still finite in float32


@dataclass(frozen=True, slots=True)
class HeadOutput:
    """Boxes above the confidence, before suppression, in no particular order."""

    boxes_input_px: Boxes
    """(N, 4) x1 y1 x2 y2 in pixels of the network's input, finite, not clipped."""
    scores: Array
    """(N,) 0…1."""
    class_ids: npt.NDArray[np.int32]


class Head(Protocol):
    """How one family of networks wants its input and writes its output."""

    @property
    def classes(self) -> int | None:
        """Number of classes; None where the output does not tell."""

    @property
    def anchor(self) -> Anchor:
        """Where the letterboxed image lies."""

    @property
    def rgb(self) -> bool:
        """The network wants RGB, not BGR."""

    @property
    def gain(self) -> float:
        """The network wants pixels times this."""

    @property
    def suppresses(self) -> bool:
        """The output still needs non-maximum suppression."""

    def decode(self, output: Array, *, confidence: float, input_size: tuple[int, int]) -> HeadOutput:
        """Decode the (1, …) output into boxes of at least this confidence."""


class YoloxHead:
    """YOLOX: BGR 0…255, image in the top-left corner.

    ``strides`` are cell sizes in input pixels, in the order of the output; ``decoded``: the network already wrote
    pixels.
    """

    anchor: Anchor = "top-left"
    rgb = False
    gain = 1.0
    suppresses = True

    def __init__(self, classes: int, *, strides: tuple[int, ...], decoded: bool) -> None:
        self.classes: int | None = classes
        self._strides = strides
        self._decoded = decoded
        self._grid_size = (0, 0)

    def decode(self, output: Array, *, confidence: float, input_size: tuple[int, int]) -> HeadOutput:
        """Score is objectness times the best class score."""
        rows = np.flatnonzero(output[0, :, 4] >= confidence)
        picked = output[0, rows]
        class_ids = picked[:, 5:].argmax(axis=1)
        scores = picked[:, 4] * picked[np.arange(len(rows)), 5 + class_ids]
        centres, sizes = picked[:, :2], picked[:, 2:4]
        if not self._decoded:
            grid, stride = self._cells(input_size)
            centres = (centres + grid[rows]) * stride[rows]
            sizes = np.exp(np.minimum(sizes, _MAX_LOG_SIZE)) * stride[rows]
        return _valid(_corners(centres, sizes), scores, class_ids, confidence)

    def _cells(self, input_size: tuple[int, int]) -> tuple[Array, Array]:
        if self._grid_size != input_size:
            self._grid, self._stride = _cells(input_size, self._strides)
            self._grid_size = input_size
        return self._grid, self._stride


class UltralyticsHead:
    """YOLOv8, 11 and kin, and YOLOv5-u: RGB 0…1, image centred."""

    anchor: Anchor = "centre"
    rgb = True
    gain = 1 / 255
    suppresses = True

    def __init__(self, classes: int) -> None:
        self.classes: int | None = classes

    def decode(self, output: Array, *, confidence: float, input_size: tuple[int, int]) -> HeadOutput:
        """Score is the best class score."""
        del input_size
        columns = np.flatnonzero(output[0, 4:].max(axis=0) >= confidence)
        picked = output[0][:, columns]
        class_ids = picked[4:].argmax(axis=0)
        scores = picked[4 + class_ids, np.arange(len(columns))]
        return _valid(_corners(picked[:2].T, picked[2:4].T), scores, class_ids, confidence)


class EndToEndHead:
    """YOLOv10, YOLO26 and exports with suppression inside: RGB 0…1, image centred."""

    anchor: Anchor = "centre"
    rgb = True
    gain = 1 / 255
    suppresses = False
    classes: int | None = None

    def decode(self, output: Array, *, confidence: float, input_size: tuple[int, int]) -> HeadOutput:
        """The network has chosen; only the confidence is applied."""
        del input_size
        picked = output[0, output[0, :, 4] >= confidence]
        picked = picked[np.isfinite(picked[:, 5])]
        return _valid(picked[:, :4], picked[:, 4], np.rint(np.clip(picked[:, 5], -1, 1e6)), confidence)


def anchor_count(input_size: tuple[int, int], strides: Sequence[int]) -> int:
    """Number of cells of all strides on an input of (width, height) pixels."""
    return sum((input_size[0] // stride) * (input_size[1] // stride) for stride in strides)


def choose_head(output: npt.NDArray[Any], input_size: tuple[int, int]) -> Head | None:
    """The head that this output of a trial run belongs to; None where it is none of them."""
    if output.ndim != 3 or output.shape[0] != 1 or not np.issubdtype(output.dtype, np.floating):
        return None
    values = output.astype(np.float32)
    _, first, second = values.shape
    for strides in _YOLOX_STRIDES:
        if (
            first == anchor_count(input_size, strides)
            and second >= 6
            and _are_probabilities(values[0, :, 4:])
        ):
            return YoloxHead(second - 5, strides=strides, decoded=_is_decoded(values[0], input_size, strides))
    for strides in _ULTRALYTICS_STRIDES:
        if second == anchor_count(input_size, strides) and first >= 5 and _are_probabilities(values[0, 4:]):
            return UltralyticsHead(first - 4)
    if second == 6 and _are_probabilities(values[0, :, 4]) and _are_whole(values[0, :, 5]):
        return EndToEndHead()
    return None


def _is_decoded(rows: Array, input_size: tuple[int, int], strides: tuple[int, ...]) -> bool:
    """Whether the centres of a YOLOX output lie nearer to their cells in pixels than to zero in cells."""
    grid, stride = _cells(input_size, strides)
    as_raw = np.abs(rows[:, :2]).mean()
    as_decoded = np.abs(rows[:, :2] / stride - grid).mean()
    return bool(as_decoded < as_raw)


def _cells(input_size: tuple[int, int], strides: Sequence[int]) -> tuple[Array, Array]:
    """(A, 2) cell indices x, y and (A, 1) strides in the order of the output: stride by stride, row by row."""
    grids, sizes = [], []
    for stride in strides:
        rows, columns = np.indices((input_size[1] // stride, input_size[0] // stride), np.float32)
        grids.append(np.stack([columns.ravel(), rows.ravel()], axis=1))
        sizes.append(np.full((columns.size, 1), stride, np.float32))
    return np.concatenate(grids), np.concatenate(sizes)


def _corners(centres: Array, sizes: Array) -> Boxes:
    half = sizes / 2
    return np.concatenate([centres - half, centres + half], axis=1)


def _valid(boxes: Boxes, scores: Array, class_ids: npt.NDArray[Any], confidence: float) -> HeadOutput:
    """Drop what is not finite, has no area, or falls below the confidence; a broken number is never a detection."""
    valid = np.isfinite(boxes).all(axis=1) & (scores >= confidence) & (scores <= 1.01) & (class_ids >= 0)
    valid &= (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
    return HeadOutput(
        boxes[valid].astype(np.float32, copy=False),
        np.minimum(scores[valid], np.float32(1)),
        class_ids[valid].astype(np.int32),
    )


def _are_probabilities(scores: Array) -> bool:
    return bool(np.isfinite(scores).all() and scores.min() >= -0.01 and scores.max() <= 1.01)


def _are_whole(numbers: Array) -> bool:
    return bool(np.isfinite(numbers).all() and np.abs(numbers - np.rint(numbers)).max() < 1e-3)
