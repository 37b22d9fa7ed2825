"""One head: the marks by which a network's outputs are known for it; and raw YOLOX, the embedded detector's.

A head *fits* where the outputs have its shape. It is *proven* where the values of the trial, the names of the outputs
or the number of class names leave no other: then `Match.proof` says what. With ``--head`` a fit is enough.

A is the number of cells of all strides for the input size, which no number of classes or objects equals by accident.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hvt_common.inference.heads.contract import Decoder, Head
from hvt_common.inference.heads.decode import YoloxCells, cell_grid, rows_of
from hvt_common.inference.heads.trial import Trial, anchor_count, are_probabilities
from hvt_common.inference.letterbox import Anchor
from hvt_common.inference.preparation import Preparation

STRIDES: tuple[tuple[int, ...], ...] = ((8, 16, 32), (8, 16, 32, 64), (4, 8, 16, 32), (16, 32))
YOLOX_STRIDES: tuple[tuple[int, ...], ...] = (*STRIDES[:2], (8, 16, 32, 12, 24, 48))
LEAST_COLUMNS = 5
BGR_255 = Preparation(mean=(0.0,) * 3, scale=(1.0,) * 3, rgb=False)


@dataclass(frozen=True, slots=True)
class Match:
    """The outputs have the shape of a head."""

    outputs: tuple[int, ...]
    classes: int | None
    decoder: Decoder
    proof: str | None
    """The evidence that excludes all other heads; None if the shape alone fits."""
    possible: bool = True
    """False where the values speak against it, and only the user can know better."""
    by_name: bool = False
    """The names of its outputs tell it, whatever other outputs there are."""


@dataclass(frozen=True, slots=True)
class Kind:
    """One head by its name."""

    text: str
    """Whose it is, and the shape of its outputs."""
    match: Callable[[Trial], Match | None]
    anchor: Anchor
    preparation: Preparation
    suppresses: bool = True

    def fits(self, trial: Trial) -> Match | None:
        """Whether the outputs have its shape, judged by the pictures in the range of its pixels."""
        return self.match(trial.up_to(255 if self.preparation.scale[0] == 1 else 1))

    def head(self, name: str, match: Match, why: str) -> Head:
        """The head that a match means."""
        return Head(
            name,
            match.classes,
            match.outputs,
            self.anchor,
            self.preparation,
            self.suppresses,
            match.decoder,
            why,
        )


def tables(trial: Trial, columns: int | None = None) -> list[int]:
    """Outputs (1, N, K), or (N, K) with so many columns."""
    return [
        index
        for index in range(len(trial.ports))
        for shape in [trial.shape(index)]
        if (len(shape) == 3 and shape[0] == 1 and columns in (None, shape[2]))
        or (len(shape) == 2 and columns is not None and shape[1] == columns)
    ]


def of_cells(
    trial: Trial, strides: tuple[tuple[int, ...], ...] = STRIDES, *, times: int = 1
) -> list[tuple[int, tuple[int, ...]]]:
    """Outputs (1, A, K) with a row for each cell, and the strides of the cells."""
    return [
        (index, one)
        for index in tables(trial)
        for one in strides
        if trial.shape(index)[1] == times * anchor_count(trial.size, one)
        and trial.shape(index)[2] >= LEAST_COLUMNS
    ]


def is_raw(trial: Trial, index: int, strides: tuple[int, ...]) -> bool:
    """Whether centres lie nearer to zero, counted in cells, than to their cells in pixels."""
    grid, stride = cell_grid(trial.size, strides)
    centres = rows_of(trial.runs[0][index].astype(np.float32))[:, :2]
    if float(np.abs(centres).max(initial=0)) == 0:
        return True
    as_shares = np.abs(centres * np.array(trial.size, np.float32) / stride - grid - 0.5).mean()
    as_pixels = np.abs(centres / stride - grid - 0.5).mean()
    return bool(np.abs(centres).mean() <= min(as_shares, as_pixels))


def _yolox(trial: Trial) -> Match | None:
    for index, strides in of_cells(trial, YOLOX_STRIDES):
        classes = trial.shape(index)[2] - 5
        if classes < 1 or not are_probabilities(trial.table(index)[:, 4:]):
            continue
        raw = is_raw(trial, index, strides)
        proof = "a row a cell, x and y counted from it" if raw else None
        return Match((index,), classes, YoloxCells(strides), proof, possible=raw)
    return None


YOLOX = Kind("YOLOX, raw: (1, A, 5+C)", _yolox, "top-left", BGR_255)
