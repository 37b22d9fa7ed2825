"""The contract of a head: which outputs it reads, how it wants its pixels, and the steps from its numbers to boxes.

No form trusts a number: boxes that are not finite, have no area, no probability or no class are left out. Raw YOLOX
is here, as the embedded detector writes it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.inference.letterbox import Anchor, Preparation
from hvt_common.values import Boxes

Array = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class HeadOutput:
    """Boxes above the confidence, before suppression, in no particular order."""

    boxes_input_px: Boxes
    """(N, 4) x1 y1 x2 y2 in pixels of the network's input, finite, not clipped."""
    scores: Array
    """(N,) 0…1."""
    class_ids: npt.NDArray[np.int32]
    second: npt.NDArray[np.bool_] | None = None
    """(N,) which are of the second one of two networks in one file; None where there is one."""
    wrong: str = ""
    """What most of the boxes had that were left out and no such network answers, in words; empty for nothing."""


class Decoder(Protocol):
    """Numbers to boxes."""

    def __call__(
        self, outputs: Sequence[Array], *, confidence: float, input_size: tuple[int, int]
    ) -> HeadOutput:
        """Boxes of at least this confidence; ``outputs`` are those that the head names, of one image."""


@dataclass(frozen=True, slots=True)
class Head:
    """Input and output of one family of networks."""

    name: str
    """The name for ``--head``."""
    classes: int | None
    """Number of classes; None where the outputs do not tell."""
    outputs: tuple[int, ...]
    """Which of the network's outputs ``decoder`` gets."""
    anchor: Anchor
    preparation: Preparation
    suppresses: bool
    """The boxes still need non-maximum suppression."""
    decoder: Decoder
    why: str
    """The evidence for it, half a sentence."""
    shapes: tuple[tuple[int, ...], ...]
    """Shapes of ``outputs`` when they were tried; one axis may change with the picture, or be empty."""

    def decode(
        self, outputs: Sequence[npt.NDArray[Any]], *, confidence: float, input_size: tuple[int, int]
    ) -> HeadOutput:
        """Decode all outputs of one run into boxes of at least this confidence.

        Raises `UserError`, half a sentence, where they have another form than when they were tried.
        """
        used = [outputs[index].astype(np.float32, copy=False) for index in self.outputs]
        if not all(one.size for one in used):
            return valid(np.empty((0, 4), np.float32), np.empty(0, np.float32), np.empty(0), confidence)
        for one, usual in zip(used, self.shapes, strict=True):
            if not is_like(one.shape, usual):
                raise UserError(f"answers a picture with {one.shape}, and others with {usual}")
        return self.decoder(used, confidence=confidence, input_size=input_size)


def is_like(shape: tuple[int, ...], other: tuple[int, ...]) -> bool:
    """Whether they differ in one axis at most: in the number of cells, or of objects."""
    return len(shape) == len(other) and sum(a != b for a, b in zip(shape, other, strict=True)) <= 1


_MAX_LOG_SIZE = 20.0  # e^20 strides: far outside every image, and still finite in float32
_MOST_CLASSES = 1e6
_MOST_SCORE = 1.01  # half precision rounds


class YoloxCells:
    """(1, A, 5+C): x, y relative to the cell and log w, log h in strides; objectness; scores.

    ``strides`` are cell sizes in input pixels, in the order of the output; from the first that was there before on
    they are of a second network.
    """

    def __init__(self, strides: tuple[int, ...]) -> None:
        self._strides = strides
        again = (level for level, stride in enumerate(strides) if stride in strides[:level])
        self._first = strides[: next(again, None)]
        self._first_cells = 0
        self._grid_size = (0, 0)
        self._grid: Array
        self._stride: Array

    def __call__(
        self, outputs: Sequence[Array], *, confidence: float, input_size: tuple[int, int]
    ) -> HeadOutput:
        """Score is objectness times the best class score."""
        if self._grid_size != input_size:
            self._grid, self._stride = cell_grid(input_size, self._strides)
            self._first_cells = len(cell_grid(input_size, self._first)[0])
            self._grid_size = input_size
        table = rows_of(outputs[0])
        rows = (table[:, 4] >= confidence).nonzero()[0]
        picked, grid, stride = table[rows], self._grid[rows], self._stride[rows]
        scores, class_ids = best(picked[:, 5:], picked[:, 4])
        centres = (picked[:, :2] + grid) * stride
        half: Array = np.exp(np.minimum(picked[:, 2:4], _MAX_LOG_SIZE)) * stride * np.float32(0.5)
        boxes = np.hstack([centres - half, centres + half])
        second = None if self._first == self._strides else rows >= self._first_cells
        return valid(boxes, scores, class_ids, confidence, second=second)


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


def best(scores: Array, objectness: Array | None) -> tuple[Array, npt.NDArray[np.intp]]:
    """(N,) best score of each row, times objectness, and (N,) its class."""
    class_ids = scores.argmax(axis=1) if scores.shape[1] else np.zeros(len(scores), np.intp)
    best = scores[np.arange(len(scores)), class_ids]
    return (best if objectness is None else best * objectness), class_ids


def valid(
    boxes: Boxes,
    scores: Array,
    class_ids: npt.NDArray[Any],
    confidence: float,
    *,
    second: npt.NDArray[np.bool_] | None = None,
) -> HeadOutput:
    """Without boxes that are not finite, have no area or too little confidence; a broken number is no detection."""
    valid = np.isfinite(boxes).all(axis=1) & (scores >= confidence) & (scores <= _MOST_SCORE)
    valid &= np.isfinite(class_ids) & (class_ids >= 0) & (class_ids < _MOST_CLASSES)
    inverted = valid & (boxes[:, 2:] < boxes[:, :2]).any(axis=1)
    valid &= (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
    wrong = "confidences above 1" if (scores > _MOST_SCORE).any() and not valid.any() else ""
    if inverted.sum() > valid.sum():
        wrong = "boxes that end before they begin"
    return HeadOutput(
        boxes[valid].astype(np.float32, copy=False),
        np.minimum(scores[valid], np.float32(1)),
        np.rint(class_ids[valid]).astype(np.int32),
        None if second is None else second[valid],
        wrong,
    )
