"""From the numbers of a network to boxes; each class is one form in which they are written.

No form trusts a number: what is not finite, has no area, is no probability or names no class is left out. Boxes that
all lie within 1.5 are shares of the input, for no object has less than two pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from hvt_common.inference.heads.contract import Array, HeadOutput
from hvt_common.values import Boxes

MOST_RELATIVE = 1.5
"""Boxes up to here are shares of the input: those of networks end at 1, or a little beyond."""

Form = Literal["centre", "corners", "corners-yx"]
"""Centre x, y, width, height; x1 y1 x2 y2; or y1 x1 y2 x2 as TensorFlow writes it."""

_MAX_LOG_SIZE = 20.0  # e^20 strides: far outside every image, and still finite in float32
_MOST_CLASSES = 1e6


class YoloxCells:
    """(1, A, 5+C): x, y relative to the cell and log w, log h in strides; objectness; scores.

    ``strides`` are cell sizes in input pixels, in the order of the output.
    """

    def __init__(self, strides: tuple[int, ...]) -> None:
        self._strides = strides
        self._grid_size = (0, 0)
        self._grid: Array
        self._stride: Array

    def __call__(
        self, outputs: Sequence[Array], *, confidence: float, input_size: tuple[int, int]
    ) -> HeadOutput:
        """Score is objectness times the best class score."""
        if self._grid_size != input_size:
            self._grid, self._stride = cell_grid(input_size, self._strides)
            self._grid_size = input_size
        table = rows_of(outputs[0])
        rows = np.flatnonzero(table[:, 4] >= confidence)
        picked, grid, stride = table[rows], self._grid[rows], self._stride[rows]
        scores, class_ids = _best(picked[:, 5:], picked[:, 4])
        centres = (picked[:, :2] + grid) * stride
        sides = np.exp(np.minimum(picked[:, 2:4], _MAX_LOG_SIZE)) * stride
        boxes = _corners(np.hstack([centres, sides]), "centre")
        return _valid(boxes, scores, class_ids, confidence)


@dataclass(frozen=True, slots=True)
class Dense:
    """(1, A, 4[+1]+C) or, transposed, (1, 4+C, A): a box, objectness where there is one, and a score a class."""

    objectness: bool = False
    transposed: bool = False

    def __call__(
        self, outputs: Sequence[Array], *, confidence: float, input_size: tuple[int, int]
    ) -> HeadOutput:
        """Score is the best class score, times objectness."""
        table = outputs[0][0] if self.transposed else rows_of(outputs[0]).T  # (columns, A)
        first = 5 if self.objectness else 4
        sure = table[4] if self.objectness else table[4:].max(axis=0, initial=0)
        picked = table[:, np.flatnonzero(sure >= confidence)].T
        scores, class_ids = _best(picked[:, first:], picked[:, 4] if self.objectness else None)
        boxes = _pixels(_corners(picked[:, :4], "centre"), input_size)
        return _valid(boxes, scores, class_ids, confidence)


@dataclass(frozen=True, slots=True)
class Listed:
    """Rows of one object each, with these columns; the network has chosen, and the confidence is applied again."""

    box: int
    score: int
    kind: int
    form: Form = "corners"
    image: int | None = None
    """The column of the image's number, below 0 from where the list ends."""

    def __call__(
        self, outputs: Sequence[Array], *, confidence: float, input_size: tuple[int, int]
    ) -> HeadOutput:
        """Rows below the confidence, and whatever follows the end, are left out."""
        table = outputs[0].reshape(-1, outputs[0].shape[-1])
        if self.image is not None:
            table = table[: np.argmax(np.append(table[:, self.image] < 0, True))]
        picked = table[table[:, self.score] >= confidence]
        boxes = _pixels(_corners(picked[:, self.box : self.box + 4], self.form), input_size)
        return _valid(boxes, picked[:, self.score], picked[:, self.kind], confidence)


@dataclass(frozen=True, slots=True)
class Parallel:
    """Boxes, scores and classes as outputs of their own, and how many rows count where a fourth one says so."""

    form: Form = "corners"
    first_class: int = 0

    def __call__(
        self, outputs: Sequence[Array], *, confidence: float, input_size: tuple[int, int]
    ) -> HeadOutput:
        """Rows beyond the count are padding."""
        boxes, scores, kinds = outputs[0].reshape(-1, 4), outputs[1].ravel(), outputs[2].ravel()
        count = min(len(boxes), len(scores), len(kinds))
        if len(outputs) > 3 and outputs[3].size and np.isfinite(outputs[3].flat[0]):
            count = min(count, max(0, int(outputs[3].flat[0])))
        picked = np.flatnonzero(scores[:count] >= confidence)
        corners = _pixels(_corners(boxes[picked], self.form), input_size)
        return _valid(corners, scores[picked], kinds[picked] - self.first_class, confidence)


@dataclass(frozen=True, slots=True)
class PerQuery:
    """Boxes (1, N, 4) and, in an output of their own, a score or a logit a class (1, N, C)."""

    form: Form
    logits: bool = False

    def __call__(
        self, outputs: Sequence[Array], *, confidence: float, input_size: tuple[int, int]
    ) -> HeadOutput:
        """Score is the best class score."""
        boxes, table = rows_of(outputs[0]), rows_of(outputs[1])
        if self.logits:
            table = np.asarray(1 / (1 + np.exp(-np.clip(table, -30, 30))), np.float32)
        picked = np.flatnonzero(table.max(axis=1, initial=0) >= confidence)
        scores, class_ids = _best(table[picked], None)
        corners = _pixels(_corners(boxes[picked], self.form), input_size)
        return _valid(corners, scores, class_ids, confidence)


@dataclass(frozen=True, slots=True)
class Corners:
    """Boxes with their score, (N, 5) x1 y1 x2 y2 score, and classes (N,) beside them."""

    def __call__(
        self, outputs: Sequence[Array], *, confidence: float, input_size: tuple[int, int]
    ) -> HeadOutput:
        """The network has chosen; the confidence is applied again."""
        table, kinds = outputs[0].reshape(-1, 5), outputs[1].ravel()
        count = min(len(table), len(kinds))
        picked = np.flatnonzero(table[:count, 4] >= confidence)
        boxes = _pixels(table[picked, :4], input_size)
        return _valid(boxes, table[picked, 4], kinds[picked], confidence)


def rows_of(output: Array) -> Array:
    """(N, K) of (1, N, K) or (N, K)."""
    return output[0] if output.ndim == 3 else output


def cell_grid(input_size: tuple[int, int], strides: Sequence[int]) -> tuple[Array, Array]:
    """(A, 2) cell indices x, y and (A, 1) strides in the order of the output: stride by stride, row by row."""
    grids, sizes = [], []
    for stride in strides:
        rows, columns = np.indices((input_size[1] // stride, input_size[0] // stride), np.float32)
        grids.append(np.stack([columns.ravel(), rows.ravel()], axis=1))
        sizes.append(np.full((columns.size, 1), stride, np.float32))
    return np.concatenate(grids), np.concatenate(sizes)


def _best(scores: Array, objectness: Array | None) -> tuple[Array, npt.NDArray[np.intp]]:
    # (N,) best score of each row, times objectness, and (N,) its class.
    class_ids = scores.argmax(axis=1) if scores.shape[1] else np.zeros(len(scores), np.intp)
    best = scores[np.arange(len(scores)), class_ids]
    return (best if objectness is None else best * objectness), class_ids


def _corners(boxes: Array, form: Form) -> Boxes:
    if form == "centre":
        half = boxes[:, 2:] / 2
        return np.concatenate([boxes[:, :2] - half, boxes[:, :2] + half], axis=1)
    return boxes[:, [1, 0, 3, 2]] if form == "corners-yx" else boxes


def _pixels(boxes: Boxes, input_size: tuple[int, int]) -> Boxes:
    finite = boxes[np.isfinite(boxes).all(axis=1)]
    if len(finite) and np.abs(finite).max() <= MOST_RELATIVE:
        return boxes * np.array([*input_size, *input_size], np.float32)
    return boxes


def _valid(boxes: Boxes, scores: Array, class_ids: npt.NDArray[Any], confidence: float) -> HeadOutput:
    # Drop boxes that are not finite, have no area or too little confidence; a broken number is no detection.
    valid = np.isfinite(boxes).all(axis=1) & (scores >= confidence) & (scores <= 1.01)
    valid &= np.isfinite(class_ids) & (class_ids >= 0) & (class_ids < _MOST_CLASSES)
    valid &= (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
    return HeadOutput(
        boxes[valid].astype(np.float32, copy=False),
        np.minimum(scores[valid], np.float32(1)),
        np.rint(class_ids[valid]).astype(np.int32),
    )
