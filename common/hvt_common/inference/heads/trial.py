"""A network's answers to a few pictures, and its file's metadata: all evidence for its head."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hvt_common.inference.heads.contract import Array
from hvt_common.inference.heads.decode import MOST_RELATIVE

if TYPE_CHECKING:  # the runtimes take a while to import, and a list of heads needs none
    from hvt_common.inference.runtimes.model import Port

_BLOCK_PX = 32
_PADDING = -1
_SCORE, _ANGLE = 0.05, 0.2
"""On a grey picture the mean over all cells of a class is below the one, that of an angle above the other."""


@dataclass(frozen=True, slots=True)
class Trial:
    """The answers of one network to `trial_pictures`."""

    ports: Sequence[Port]
    """Its outputs."""
    runs: Sequence[Sequence[npt.NDArray[Any]]]
    """For each picture, the outputs in the order of ``ports``."""
    tops: Sequence[int]
    """For each picture, its greatest value: 1 or 255; 0 if that says nothing."""
    size: tuple[int, int]
    """(width, height) of the network's input in the trial."""
    metadata: Mapping[str, str]
    names: int | None
    """How many class names are known, from the metadata or a file of labels."""

    def up_to(self, top: int) -> Trial:
        """Without the pictures in the other range: there a network may say anything."""
        these = [index for index, one in enumerate(self.tops) if one in (0, top)]
        return replace(self, runs=[self.runs[i] for i in these], tops=[self.tops[i] for i in these])

    def shape(self, index: int) -> tuple[int, ...]:
        """The shape of an output for the first picture."""
        return tuple(self.runs[0][index].shape)

    def table(self, index: int) -> Array:
        """(N, K) rows of an output of all pictures: its last axis, whatever stands before it."""
        return np.concatenate(
            [run[index].astype(np.float32).reshape(-1, run[index].shape[-1]) for run in self.runs]
        )

    def numbers(self, index: int) -> Array:
        """(N,) all numbers of an output of all pictures."""
        return np.concatenate([run[index].astype(np.float32).ravel() for run in self.runs])

    def named(self, *words: str) -> tuple[int, ...]:
        """The one output whose name is, or has, each word, in their order; () where one has none, or several."""
        names = [port.name.lower().partition(":")[0] for port in self.ports]
        found = [
            [index for index, name in enumerate(names) if name == word]
            or [index for index, name in enumerate(names) if word in name]
            for word in words
        ]
        return tuple(one[0] for one in found) if all(len(one) == 1 for one in found) else ()

    def whole(self, index: int) -> bool:
        """Whether an output has whole numbers by its type."""
        dtype = self.ports[index].dtype
        return dtype is not None and bool(np.issubdtype(dtype, np.integer))

    def has_angles(self, index: int, first: int, *, transposed: bool = False) -> bool:
        """Whether the last column is no class as those from ``first`` on: on grey it alone has numbers."""
        grey = self.runs[0][index].astype(np.float32).reshape(self.runs[0][index].shape[-2:])
        means = (grey.T if transposed else grey)[:, first:].mean(axis=0)
        return bool(len(means) > 1 and means[-1] > _ANGLE > _SCORE > means[:-1].max())

    def relative(self, boxes: Array) -> bool:
        """Whether there are boxes, and all are shares of the input."""
        size = float(np.abs(boxes).max(initial=0))
        return 0 < size <= MOST_RELATIVE


def trial_pictures(size: tuple[int, int], dtype: np.dtype[Any]) -> list[tuple[npt.NDArray[Any], int]]:
    """(1, 3, height, width) inputs: grey, and coloured blocks in both ranges that networks take, 0…1 and 0…255.

    Each comes with its top, as of `Trial`. Grey alone says too little: a network that lists objects lists none there.
    """
    width, height = size
    grid = np.random.default_rng(0).integers(0, 2, (3, -(-height // _BLOCK_PX), -(-width // _BLOCK_PX)))
    blocks = grid.repeat(_BLOCK_PX, axis=1).repeat(_BLOCK_PX, axis=2)[None, :, :height, :width]
    if dtype == np.uint8:
        return [(np.full(blocks.shape, 114, dtype), 0), ((blocks * 255).astype(dtype), 0)]
    grey = np.full(blocks.shape, 0.5, dtype)
    return [(grey, 0), (blocks.astype(dtype), 1), ((blocks * 255).astype(dtype), 255)]


def anchor_count(input_size: tuple[int, int], strides: Sequence[int]) -> int:
    """Number of cells of all strides on an input of (width, height) pixels."""
    return sum((input_size[0] // stride) * (input_size[1] // stride) for stride in strides)


def are_probabilities(scores: Array) -> bool:
    """Whether all lie in 0…1, give or take the rounding of half precision."""
    return bool(np.isfinite(scores).all() and ((scores >= -0.01) & (scores <= 1.01)).all())


def are_scores(numbers: Array) -> bool:
    """Whether they are probabilities, or -1 as behind the end of a list."""
    return are_probabilities(numbers[numbers != _PADDING])


def are_whole(numbers: Array) -> bool:
    """Whether all are whole numbers from -1 on, as classes are, and the padding behind them."""
    return bool(
        np.isfinite(numbers).all()
        and (numbers >= -1.001).all()
        and (abs(numbers - numbers.round()) < 1e-3).all()
    )
