"""Which head a network has: as the user says, else as its file says, else as all its outputs together prove."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.inference.heads import HEAD_NAMES
from hvt_common.inference.heads.contract import Array, Decoder, Head, YoloxCells, cell_grid, rows_of
from hvt_common.inference.letterbox import Anchor, Preparation
from hvt_common.inference.store import MISSING, library_part, needed_part

if TYPE_CHECKING:  # the runtimes take a while to import, and a list of heads needs none
    from hvt_common.inference.runtimes.model import Port

_BLOCK_PX = 32


@dataclass(frozen=True, slots=True)
class Trial:
    """The answers of one network to `trial_pictures`."""

    ports: Sequence[Port]
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
        columns = self.shape(index)[-1]
        answers = [run[index] for run in self.runs if run[index].shape[-1] == columns]
        return np.concatenate(
            [one.astype(np.float32).reshape(math.prod(one.shape[:-1]), columns) for one in answers]
        )


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


STRIDES: tuple[tuple[int, ...], ...] = (
    *((8, 16, 32), (8, 16, 32, 64), (4, 8, 16, 32), (16, 32)),
    *((4, 8, 16), (8, 16)),  # for small objects alone
)
YOLOX_STRIDES: tuple[tuple[int, ...], ...] = (*STRIDES[:2], (8, 16, 32, 12, 24, 48), (8, 16, 32, 16, 32, 64))
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
    """One head by its name, with the marks by which a network's outputs are known for it.

    It *fits* where the outputs have its shape. It is *proven* where the values of the trial, the names of the outputs
    or the number of class names leave no other (`Match.proof`). With ``--head`` a fit is enough. In the
    shapes A is the number of cells of all strides, which no number of classes or objects equals by accident.
    """

    text: str
    """The family of networks, and the shape of its outputs."""
    match: Callable[[Trial], Match | None]
    anchor: Anchor
    preparation: Preparation
    suppresses: bool = True

    def fits(self, trial: Trial) -> Match | None:
        """Whether the outputs have its shape, judged by the pictures in the range of its pixels."""
        return self.match(trial.up_to(255 if self.preparation.scale[0] == 1 else 1))

    def head(self, name: str, match: Match, why: str, trial: Trial) -> Head:
        return Head(
            name,
            match.classes,
            match.outputs,
            self.anchor,
            self.preparation,
            self.suppresses,
            match.decoder,
            why,
            tuple(map(trial.shape, match.outputs)),
        )


def tables(trial: Trial, columns: int | None = None) -> list[int]:
    """Outputs (1, N, K) or (N, K), with K ``columns`` where given."""
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
_RT_DETR = ("rt-detr-rows", "rt-detr")
_RAW_AXES = 5
"""(1, 3, H, W, 5+C): YOLOv5's levels, beside all of them decoded."""


def check_head_name(name: str | None) -> None:
    """`UserError` for a name that no head has."""
    if name is not None and name not in HEAD_NAMES:
        raise UserError(f"--head '{name}' is not known: choose one of {', '.join(HEAD_NAMES)}")


def choose_head(trial: Trial, *, wanted: str | None = None) -> Head:
    """The head that the outputs belong to; ``wanted`` is as of ``--head``.

    Raises:
        UserError: half a sentence on why none is certain, and which option decides it.
    """
    check_head_name(wanted)
    said = trial.metadata.get("head", "")
    if wanted is not None or said in HEAD_NAMES:
        return _named(trial, wanted or said, "--head" if wanted else "its metadata: head")
    library = library_part("heads")
    kinds: dict[str, Kind] = {"yolox": YOLOX} if library is None else dict(library)
    why = ""
    if library is not None and _says_rt_detr(trial):
        kinds = {name: kinds[name] for name in _RT_DETR}
        why = f"its metadata say {'head ' + said if said else 'RT-DETR'}: "
    found = {name: match for name, kind in kinds.items() if (match := kind.fits(trial)) is not None}
    certain = {name: match for name, match in found.items() if match.proof and _explains(trial, match)}
    if not certain and why:
        certain = found
    if len(certain) == 1:
        ((name, match),) = certain.items()
        return kinds[name].head(name, match, why + (match.proof or "its shape fits"), trial)
    if not found:
        more = "" if library is not None else f"; of other heads, {MISSING}"
        raise UserError(f"its outputs fit no head that is known{more}")
    likely = [name for name, match in found.items() if match.possible and _explains(trial, match)]
    could = " or ".join(certain or likely or found)
    raise UserError(
        f"its outputs could be {could}, which --head NAME decides; hvt.mean, hvt.scale in its metadata say its pixels"
    )


def _named(trial: Trial, name: str, by: str) -> Head:
    kind: Kind = YOLOX if name == "yolox" else needed_part("heads", f"head {name}")[name]
    match = kind.fits(trial)
    if match is None:
        raise UserError(f"its outputs are not those of {by} {name}, which is {kind.text}")
    return kind.head(name, match, f"{by} {name}", trial)


def _says_rt_detr(trial: Trial) -> bool:
    # Whether ``head``, or in older files ``description``, says RT-DETR, as Ultralytics writes it.
    said = trial.metadata.get("head", "") + trial.metadata.get("description", "")
    return "rtdetr" in said.lower().replace("-", "")


def _explains(trial: Trial, match: Match) -> bool:
    # Whether every other output is the head's too: raw levels, or a second branch of the same shape.
    if match.by_name:
        return True
    shapes = {trial.shape(index) for index in match.outputs}
    rest = set(range(len(trial.ports))) - set(match.outputs)
    return all(len(trial.shape(index)) == _RAW_AXES or trial.shape(index) in shapes for index in rest)
