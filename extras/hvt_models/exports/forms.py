"""From the numbers of a network to boxes; each class is one form in which foreign exports write them.

Boxes that all lie within 1.5 are shares of the input, for no object has less than two pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hvt_common.errors import UserError
from hvt_common.inference.heads.contract import Array, HeadOutput, best, rows_of, valid
from hvt_common.values import Boxes

MOST_RELATIVE = 1.5
"""Boxes up to here are shares of the input: those of networks end at 1, or a little beyond."""

Form = Literal["centre", "corners", "corners-yx"]
"""Centre x, y, width, height; x1 y1 x2 y2; or y1 x1 y2 x2 as TensorFlow writes it."""


@dataclass(frozen=True, slots=True)
class Dense:
    """(1, A, 4[+1]+C) or, transposed, (1, 4+C, A): a box, objectness where there is one, and a score a class."""

    objectness: bool = False
    transposed: bool = False
    one_class: bool = False
    """Objectness is the score: YOLOv7 trains no score of a single class, and writes one near 0.5."""

    def __call__(
        self, outputs: Sequence[Array], *, confidence: float, input_size: tuple[int, int]
    ) -> HeadOutput:
        """Score is the best class score, times objectness; of ``one_class`` objectness alone."""
        table = outputs[0][0] if self.transposed else rows_of(outputs[0]).T  # (columns, A)
        first = 5 if self.objectness else 4
        sure = table[4] if self.objectness else table[4:].max(axis=0, initial=0)
        picked = table[:, np.flatnonzero(sure >= confidence)].T
        columns = picked[:, 4:5] if self.one_class else picked[:, first:]
        scores, class_ids = best(columns, picked[:, 4] if self.objectness and not self.one_class else None)
        boxes = _pixels(_corners(picked[:, :4], "centre"), input_size)
        return valid(boxes, scores, class_ids, confidence)


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
        return valid(boxes, picked[:, self.score], picked[:, self.kind], confidence)


@dataclass(frozen=True, slots=True)
class Parallel:
    """Boxes, scores and classes as outputs of their own, and how many rows count where a fourth one says so."""

    form: Form = "corners"
    first_class: int = 0

    def __call__(
        self, outputs: Sequence[Array], *, confidence: float, input_size: tuple[int, int]
    ) -> HeadOutput:
        """Rows beyond the count are padding. `UserError` for a class below the first: all others have wrong names."""
        boxes, scores, kinds = outputs[0].reshape(-1, 4), outputs[1].ravel(), outputs[2].ravel()
        count = min(len(boxes), len(scores), len(kinds))
        if len(outputs) > 3 and outputs[3].size and np.isfinite(outputs[3].flat[0]):
            count = min(count, max(0, int(outputs[3].flat[0])))
        picked = np.flatnonzero(scores[:count] >= confidence)
        if self.first_class and (kinds[picked] == self.first_class - 1).any():
            raise UserError(
                f"lists class {self.first_class - 1}, and its classes are taken to count from {self.first_class}: add"
                " 1 to them in its graph"
            )
        pixels = _pixels(_corners(boxes[picked], self.form), input_size)
        return valid(pixels, scores[picked], kinds[picked] - self.first_class, confidence)


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
            sure = 1 / (1 + np.exp(-np.clip(table, -30, 30)))
            table = np.where(table == np.inf, table, sure).astype(np.float32)
        picked = np.flatnonzero(table.max(axis=1, initial=0) >= confidence)
        scores, class_ids = best(table[picked], None)
        pixels = _pixels(_corners(boxes[picked], self.form), input_size)
        return valid(pixels, scores, class_ids, confidence)


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
        return valid(boxes, table[picked, 4], kinds[picked], confidence)


def _pixels(boxes: Boxes, input_size: tuple[int, int]) -> Boxes:
    finite = boxes[np.isfinite(boxes).all(axis=1)]
    if len(finite) and np.abs(finite).max() <= MOST_RELATIVE:
        return boxes * np.array([*input_size, *input_size], np.float32)
    return boxes


def _corners(boxes: Array, form: Form) -> Boxes:
    # (N, 4) x1 y1 x2 y2 of boxes in that form.
    if form == "centre":
        half = boxes[:, 2:] / 2
        return np.concatenate([boxes[:, :2] - half, boxes[:, :2] + half], axis=1)
    return boxes[:, [1, 0, 3, 2]] if form == "corners-yx" else boxes
