"""YOLO's label files: ``class cx cy w h`` a line, 0…1 of the picture; class names stand in ``classes.txt``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.inference.labels import read_labels
from hvt_study.datasets.labels import NO_ID, FrameLabels

__all__ = ["IGNORED", "labels_of", "read_text", "read_yolo", "yolo_names"]

IGNORED = frozenset({"dontcare", "ignore", "ignored"})
"""Classes (any case) whose boxes count neither for nor against."""
_COLUMNS = 5
_MOST_COLUMNS = 6
"""With a confidence, as trackers and annotators add it; more is a polygon."""


def yolo_names(root: Path, classes: Sequence[str] | None) -> Sequence[str]:
    """The given names, else those of ``root/classes.txt``; `UserError` where there is neither."""
    if classes is not None:
        return classes
    if not (root / "classes.txt").is_file():
        raise UserError(f"{root} has labels, but no classes.txt: add one, one name a line, or give --classes")
    return read_labels(root / "classes.txt")


def read_yolo(path: Path, names: Sequence[str], size: tuple[int, int]) -> FrameLabels:
    """The labels of a picture of this (width, height), in its pixels; `UserError` names the line that is wrong."""
    boxes, kinds = [], []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if line.strip():
            kind, *sides = _yolo_row(path, number, line, len(names))
            boxes.append(sides)
            kinds.append(names[int(kind)])
    middle_sides = np.array(boxes, np.float64).reshape(-1, 4)
    half = middle_sides[:, 2:] / 2
    corners = np.hstack([middle_sides[:, :2] - half, middle_sides[:, :2] + half]) * [*size, *size]
    return labels_of(corners, kinds)


def labels_of(corners: npt.NDArray[np.float64], names: Sequence[str]) -> FrameLabels:
    """(N, 4) x1 y1 x2 y2 pixels and their N names; those of `IGNORED` become regions."""
    passed = np.array([name.casefold() in IGNORED for name in names], bool)
    boxes = corners.astype(np.float32)
    return FrameLabels(
        boxes_xyxy_px=boxes[~passed],
        ids=np.full(np.count_nonzero(~passed), NO_ID, np.int64),
        class_names=tuple(name for name, skip in zip(names, passed, strict=True) if not skip),
        ignored_xyxy_px=boxes[passed],
    )


def _yolo_row(path: Path, number: int, line: str, classes: int) -> list[float]:
    try:
        row = [float(word) for word in line.split()]
    except ValueError:
        row = []
    if not _COLUMNS <= len(row) <= _MOST_COLUMNS or not all(map(math.isfinite, row)):
        raise UserError(f"{path}, line {number} is {line[:60]!r}; accepted is class cx cy w h, all numbers")
    if row[0] not in range(classes):
        raise UserError(f"{path}, line {number} has class {row[0]:g}; there are {classes}, from 0")
    if not all(0 <= value <= 1 for value in row[1:_COLUMNS]):
        raise UserError(
            f"{path}, line {number} has a box outside the picture: {line[:60]!r}; 0 to 1 is accepted"
        )
    return row[:_COLUMNS]


def read_text(path: Path) -> str:
    """A text file; `UserError` where it cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path} cannot be read as text: {error}") from None
