"""YOLO's label files: ``class cx cy w h`` a line, 0…1 of the picture; class names stand in ``classes.txt``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from hvt_common.errors import UserError
from hvt_study.datasets.label_files import class_file, read_class_file, read_text
from hvt_study.datasets.labels import FrameLabels, LabelDoubts

YOLO_COLUMNS = 5
"""Class and box."""
_MOST_COLUMNS = 6
"""With a confidence, as trackers and annotators add it; more is a polygon."""
_LEAST_POLYGON = 7
_VISIBLE = 2
"""Of a keypoint, the third of its numbers; no polygon's coordinate is so large."""
_MOST_SHARE = 2.0
"""A number beyond is no share of a picture: the file counts in pixels."""


def yolo_names(root: Path, classes: Sequence[str] | None, pictures: Sequence[Path] = ()) -> Sequence[str]:
    """The given names, else those of ``classes.txt``, ``obj.names`` or ``data.yaml``; `UserError` where none is."""
    if classes is not None:
        return classes
    path = class_file(root, list(pictures))
    if path is None:
        raise UserError(
            f"{root} has labels, but no classes.txt, obj.names or data.yaml, there or in labels/: add one, one name a"
            " line, or give --classes"
        )
    return read_class_file(path)


def read_yolo(
    path: Path, names: Sequence[str], size: tuple[int, int], doubts: LabelDoubts, *, keypoints: int = 0
) -> FrameLabels:
    """The labels of a picture of this (width, height), in its pixels: rows of boxes, or of polygons.

    Behind the boxes there may be so many columns of ``keypoints``, which are no polygon. What ends outside the
    picture is cut, and a row that cannot be is left out; ``doubts`` counts both.
    """
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        try:
            kind, *corners = _yolo_row(path, number, line, len(names), keypoints)
        except UserError as error:
            doubts.leave_out(str(error))
            continue
        rows.append((names[int(kind)], corners, f"{path}, line {number}"))
    return doubts.labels(rows, size, size)


def _yolo_row(path: Path, number: int, line: str, classes: int, keypoints: int) -> list[float]:
    """Class and x1 y1 x2 y2 as shares of the picture."""
    try:
        row = [float(word.replace(",", ".")) for word in line.split()]
    except ValueError:
        row = []
    if _has_keypoints(row, keypoints):
        row = row[:YOLO_COLUMNS]
    polygon = len(row) >= _LEAST_POLYGON and len(row) % 2 == 1
    if not (YOLO_COLUMNS <= len(row) <= _MOST_COLUMNS or polygon) or not all(map(math.isfinite, row)):
        raise UserError(f"{path}, line {number} is {line[:60]!r}; accepted is class cx cy w h, all numbers")
    if row[0] not in range(classes):
        raise UserError(f"{path}, line {number} has class {row[0]:g}; there are {classes}, from 0")
    if polygon:
        box = [min(row[1::2]), min(row[2::2]), max(row[1::2]), max(row[2::2])]
    else:
        cx, cy, wide, high = row[1:YOLO_COLUMNS]
        box = [cx - wide / 2, cy - high / 2, cx + wide / 2, cy + high / 2]
    if not all(abs(value) <= _MOST_SHARE for value in row[1 : None if polygon else YOLO_COLUMNS]):
        raise UserError(
            f"{path}, line {number} has a box outside the picture: {line[:60]!r}; 0 to 1 is accepted"
        )
    return [row[0], *box]


def _has_keypoints(row: Sequence[float], columns: int) -> bool:
    """Whether keypoints follow the box: so many columns, or triples of which each ends in 0, 1 or 2."""
    points = row[YOLO_COLUMNS:]
    third = points[2::3]
    triples = len(points) % 3 == 0 and _VISIBLE in third and set(third) <= {0, 1, _VISIBLE}
    return triples or (columns > 0 and len(points) == columns)
