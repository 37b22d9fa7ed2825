"""All labels of a sequence as one table sorted by frame, the callable that finds them again, and VisDrone's tables.

DET is ``x,y,w,h,score,category,truncation,occlusion``; VID and MOT put ``frame,id`` in front. Category 0 is a region
whose objects nobody has labelled, 1 to 10 are `VISDRONE_NAMES`, 11 is "others". A score of 0 means that the object
does not count (https://github.com/VisDrone/VisDrone2018-DET-toolkit).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hvt_common.inference.class_names import VISDRONE_NAMES
from hvt_common.values import Boxes
from hvt_study.datasets.annotation_rows import Rows, read_rows
from hvt_study.datasets.labels import (
    NO_ID,
    FrameLabels,
    LabelDoubts,
    check_inside,
    check_pixels,
    covered_share,
    inside_frame,
)

_COVERED = 0.5
"""An object with so much of it in regions of which nothing is known does not count, as in VisDrone's toolkit."""


@dataclass(frozen=True, slots=True)
class Regions:
    """Boxes by frame that are not asked for: regions in which nothing counts, and single objects."""

    frames: npt.NDArray[np.int64]
    boxes: Boxes
    land: npt.NDArray[np.bool_]
    """(M,) True for regions whose objects nobody has labelled, False for a single object that does not count."""

    @classmethod
    def of(
        cls, rows: Rows, chosen: npt.NDArray[np.bool_], land: npt.NDArray[np.bool_], *, origin: float = 0.0
    ) -> Regions:
        """These of some rows; ``origin`` is the first pixel's number."""
        return cls(rows["frame"].astype(np.int64)[chosen], rows.boxes(origin=origin)[chosen], land[chosen])


@dataclass(frozen=True, slots=True)
class LabelTable:
    """N objects and M regions of all frames, as parallel arrays sorted by frame; frame numbers as in the files."""

    frames: npt.NDArray[np.int64]
    boxes: Boxes
    ids: npt.NDArray[np.int64]
    class_ids: npt.NDArray[np.int64]
    """Index into ``class_names``."""
    class_names: tuple[str, ...]
    ignored: Regions
    paired: bool = False
    """Of `FrameLabels`."""
    one_target: bool = False
    """One object is labelled, and nothing else that is in view."""

    @classmethod
    def of(
        cls,
        rows: Rows,
        judged: npt.NDArray[np.bool_],
        class_ids: npt.NDArray[np.int64],
        class_names: tuple[str, ...],
        *,
        ignored: Regions,
        size: tuple[int, int],
        origin: float = 0.0,
    ) -> LabelTable:
        """Those rows that are ``judged``, cut at the frame of this (width, height); empty ones are left out.

        A number below 0, or of two objects of a frame, as where all have 0, says nothing of who is who. Raises
        `UserError` where many of a sequence lie outside the frame; of one picture nobody knows how many are many.
        """
        check_pixels(rows.path, [rows[side] for side in "xywh"])
        frames, boxes = rows["frame"].astype(np.int64), rows.boxes(origin=origin)
        if "frame" in rows.columns:
            check_inside(rows.path, boxes[judged], size)
        boxes = inside_frame(boxes, size)
        regions = inside_frame(ignored.boxes, size)
        places = _rows_with_area(ignored.frames, regions)
        chosen = _rows_with_area(frames, boxes)
        chosen = chosen[judged[chosen]]
        ids = rows["id"].astype(np.int64)[chosen]
        pairs, count = np.unique(np.stack((frames[chosen], ids)), axis=1, return_counts=True)
        ids[(ids < 0) | np.isin(ids, pairs[1, count > 1])] = NO_ID
        passed = Regions(ignored.frames[places], regions[places], ignored.land[places])
        return cls(frames[chosen], boxes[chosen], ids, class_ids[chosen], class_names, passed)

    @property
    def class_set(self) -> tuple[str, ...]:
        """All names that the annotations may use, whether they do or not, sorted."""
        return tuple(sorted(self.class_names))

    @property
    def span(self) -> tuple[int, int] | None:
        """The lowest and the highest frame number; None where there is none."""
        every = np.concatenate((self.frames, self.ignored.frames))
        return (int(every.min()), int(every.max())) if len(every) else None

    def at(self, frame: int) -> FrameLabels:
        """The labels of a frame; objects mostly in unlabelled regions are left out."""
        begin, end = np.searchsorted(self.frames, [frame, frame + 1])
        first, last = np.searchsorted(self.ignored.frames, [frame, frame + 1])
        boxes, regions = self.boxes[begin:end], self.ignored.boxes[first:last]
        land = self.ignored.land[first:last]
        counts = covered_share(boxes, regions[land]) < _COVERED
        rows = begin + np.flatnonzero(counts)
        return FrameLabels(
            boxes_xyxy_px=self.boxes[rows],
            ids=self.ids[rows],
            class_names=tuple(self.class_names[kind] for kind in self.class_ids[rows].tolist()),
            ignored_xyxy_px=regions[land],
            beside_xyxy_px=regions[~land],
            paired=self.paired,
        )


@dataclass(frozen=True, slots=True)
class TableLabels:
    """Labels by source frame, read from files when first asked for; the last few tables stay in memory."""

    read: Callable[..., LabelTable]
    """A function of a module."""
    arguments: tuple[Hashable, ...]
    """Its arguments; `Path`s among them are files."""
    first_frame: int
    """Number in the files of source frame 0."""

    def __call__(self, index: int) -> FrameLabels:
        return self.table().at(self.first_frame + index)

    def table(self) -> LabelTable:
        """All of them; `UserError` where a file is wrong."""
        paths = (path for path in self.arguments if isinstance(path, Path))
        return _read_once(self.read, self.arguments, tuple(file_stamp(path) for path in paths))


@lru_cache(maxsize=4)
def _read_once(
    read: Callable[..., LabelTable],
    arguments: tuple[Any, ...],
    stamps: tuple[Any, ...],  # noqa: ARG001 - part of the key
) -> LabelTable:
    return read(*arguments)


def file_stamp(path: Path) -> tuple[int, int]:
    """Changes with the file; zeros where there is none."""
    try:
        status = path.stat()
    except OSError:
        return 0, 0
    return status.st_mtime_ns, status.st_size


def _rows_with_area(frames: npt.NDArray[np.int64], boxes: Boxes) -> npt.NDArray[np.intp]:
    """Rows whose boxes have an area, by frame and then as in the file."""
    order = np.argsort(frames, kind="stable")
    sides = boxes[order, 2:] - boxes[order, :2]
    return order[(sides > 0).all(axis=1)]


_OBJECT = "x,y,w,h,score,category,truncation,occlusion"
_REGION, _OTHERS = 0, 11


def image_labels(path: Path, size: tuple[int, int], doubts: LabelDoubts) -> FrameLabels:
    """Labels of one image of this (width, height); wrong rows are left out. `UserError` where all are."""
    rows, judged = _judged(read_rows(path, columns=_OBJECT, least=6, frames=False, of_dataset=True))
    wheres = [f"{path}, line {number}" for number in rows.lines[judged].tolist()]
    doubts.good += len(doubts.inside(rows.boxes()[judged].astype(np.float64), size, wheres)[1])
    return _table(rows, judged, size).at(-1)  # the value of a column that the file does not have


def video_table(path: Path, size: tuple[int, int]) -> LabelTable:
    """Labels of pictures of this (width, height); wrong rows are left out. `UserError` where all are."""
    return _table(*_judged(read_rows(path, columns=f"frame,id,{_OBJECT}", least=10, of_dataset=True)), size)


def _judged(rows: Rows) -> tuple[Rows, npt.NDArray[np.bool_]]:
    """Rows of a known category, and which are wanted: no regions, no "others", and none of score 0."""
    column = rows.columns.index("category") + 1
    rows = rows.only(
        np.isin(rows["category"], np.arange(_OTHERS + 1)),
        accepted=f"a category from 0 to {_OTHERS} in column {column}",
    )
    category = rows["category"].astype(np.int64)
    return rows, (category >= 1) & (category <= len(VISDRONE_NAMES)) & (rows["score"] != 0)


def _table(rows: Rows, judged: npt.NDArray[np.bool_], size: tuple[int, int]) -> LabelTable:
    category = rows["category"].astype(np.int64)
    ignored = Regions.of(rows, ~judged, category == _REGION)
    return LabelTable.of(rows, judged, category - 1, VISDRONE_NAMES, ignored=ignored, size=size)
