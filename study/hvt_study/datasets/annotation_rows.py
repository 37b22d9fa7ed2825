"""Annotations and detections as lines of numbers between commas. Faults are named with the file and the line.

A wrong line of a dataset is left out; in results that are to be judged it ends the reading.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mode
from typing import Any

import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.files import MOST_TABLE_BYTES, read_text

_log = logging.getLogger(__name__)

LAST_FRAME = 10_000_000
"""Over 90 hours at 30 fps; a higher frame number is a mistake."""
LARGEST = 1e9
"""Beyond it no pixel lies."""
_LARGEST_ID = 2.0**53
"""Below it ids are exact in floats."""
_SHOWN_CHARS = 60


@dataclass(frozen=True, slots=True)
class Rows:
    """The numbers of a file, in its order."""

    path: Path
    table: npt.NDArray[np.float64]
    """(N, C), finite."""
    columns: tuple[str, ...]
    lines: npt.NDArray[np.int64]
    """(N,) line in the file, from 1."""
    text: tuple[str, ...]
    of_dataset: bool = False
    """A line that is wrong is left out."""

    def __len__(self) -> int:
        return len(self.table)

    def __getitem__(self, column: str) -> npt.NDArray[np.float64]:
        """(N,) values of a column; -1 where the file does not have it."""
        if column not in self.columns:
            return np.full(len(self), -1.0)
        return np.asarray(self.table[:, self.columns.index(column)])

    def only(self, good: npt.NDArray[np.bool_], *, accepted: str) -> Rows:
        """The rows that are good. Rows left out of a dataset are counted, and the first is named in the log.

        `UserError` names it where none is good, or these rows are of no dataset.
        """
        if good.all():
            return self
        row = int(np.flatnonzero(~good)[0])
        line = self.text[row]
        shown = line if len(line) <= _SHOWN_CHARS else line[:_SHOWN_CHARS] + "…"
        said = f"{self.path}, line {self.lines[row]} is {shown!r}; accepted is {accepted}"
        if not (self.of_dataset and good.any()):
            raise UserError(said)
        _log.warning("%d of %d lines are left out; the first: %s", (~good).sum(), len(good), said)
        good_rows = np.flatnonzero(good)
        text = tuple(self.text[row] for row in good_rows.tolist())
        return replace(self, table=self.table[good_rows], lines=self.lines[good_rows], text=text)

    def boxes(self, *, origin: float = 0.0) -> npt.NDArray[np.float32]:
        """(N, 4) float32 x1 y1 x2 y2 from ``x,y,w,h``; ``origin`` is the first pixel's number."""
        x, y = self["x"] - origin, self["y"] - origin
        return np.stack([x, y, x + self["w"], y + self["h"]], axis=1).astype(np.float32)


def read_rows(path: Path, *, columns: str, least: int, frames: bool = True, of_dataset: bool = False) -> Rows:
    """Read a file of which the columns between commas are called so; further ones and blank lines are no matter.

    Every line must have the ``least`` first ones and as many as most lines, of which ``frames`` are counted by the
    first column. A line that is not so is left out ``of_dataset``, as long as there are others; else `UserError`
    names it.
    """
    numbered = [
        (number, line.strip())
        for number, line in enumerate(label_text(path).splitlines(), start=1)
        if line.strip()
    ]
    names = tuple(columns.split(","))
    lines = tuple(line for _, line in numbered)
    count = max(least, min(len(names), usual_cells(lines)))
    wanted = f"numbers below {LARGEST:g} {','.join(names[:least])}" + (",…" if len(names) > least else "")
    table = _numbers(lines, count)
    limits = [_LARGEST_ID if name == "id" else LARGEST for name in names[:count]]
    good = np.asarray((np.abs(table) < limits).all(axis=1), np.bool_)  # false for NaN
    if of_dataset and "w" in names:
        wanted += ", w and h from 0 on,"
        good &= (table[:, names.index("w") : names.index("h") + 1] >= 0).all(axis=1)
    if frames:
        wanted += f" with a whole frame number from 0 to {LAST_FRAME}"
        with np.errstate(invalid="ignore"):
            whole = (table[:, 0] % 1 == 0) & (table[:, 0] >= 0) & (table[:, 0] <= LAST_FRAME)
        good = np.logical_and(good, whole)
    numbers = np.array([number for number, _ in numbered], np.int64)
    rows = Rows(path, table, names[:count], numbers, lines, of_dataset).only(good, accepted=wanted)
    if not of_dataset or names[:2] != ("frame", "id"):
        return rows
    once = np.zeros(len(rows), np.bool_)
    once[np.unique(rows.table[:, :2], axis=0, return_index=True)[1]] = True
    return rows.only(once | (rows["id"] <= 0), accepted="each id once in a frame")


def usual_cells(lines: Sequence[str]) -> int:
    """How many numbers most lines have, whatever the first one is; 0 where there is none."""
    return mode([line.rstrip(",").count(",") + 1 for line in lines] or [0])


def label_text(path: Path) -> str:
    """Text of a file of labels; `UserError` where it cannot be read."""
    try:
        return read_text(path, most=MOST_TABLE_BYTES)
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror})") from None


def _numbers(lines: tuple[str, ...], count: int) -> npt.NDArray[np.float64]:
    """(N, count); a line that is not so many numbers becomes NaN."""
    if not lines:
        return np.empty((0, count))
    convert: Callable[..., Any] = np.loadtxt
    try:
        return np.asarray(
            convert(lines, delimiter=",", usecols=range(count), ndmin=2, comments=None), np.float64
        )
    except ValueError:
        return np.array([_line(line, count) for line in lines], np.float64).reshape(-1, count)


def _line(line: str, count: int) -> list[float]:
    try:
        values = [float(cell) for cell in line.split(",")[:count]]
    except ValueError:
        values = []
    return values if len(values) == count else [np.nan] * count
