"""The labels of one frame of a dataset, and which parts of it count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.values import Boxes

_MOST_OUTSIDE = 0.1
"""Share of boxes around objects that have left the picture: of UAVDT 0, with its pictures at three quarters 0.17."""
_NOTICED_PX = 0.01
"""Rows that end nearer to the edge are as exact as their digits."""
IGNORED = frozenset({"difficult", "dontcare", "ignore", "ignored"})
"""Classes (any case) whose boxes count neither for nor against."""
NO_ID = -1
"""Identity of an object whose dataset knows none."""


def no_boxes() -> Boxes:
    return np.empty((0, 4), np.float32)


def no_ids() -> npt.NDArray[np.int64]:
    return np.empty(0, np.int64)


@dataclass(frozen=True, slots=True)
class FrameLabels:
    """N objects, M regions and P things to be passed over in one source frame; boxes in source pixels, inside it."""

    boxes_xyxy_px: Boxes = field(default_factory=no_boxes)
    """(N, 4) float32, x2 and y2 exclusive."""
    ids: npt.NDArray[np.int64] = field(default_factory=no_ids)
    """(N,) the same for one object in all frames; `NO_ID` where the dataset knows none."""
    class_names: tuple[str, ...] = ()
    """N words of the dataset (car, van, truck, bus, pedestrian, people, bicycle, motor, tricycle …)."""
    ignored_xyxy_px: Boxes = field(default_factory=no_boxes)
    """(M, 4) float32: regions in which nothing counts, neither for nor against."""
    beside_xyxy_px: Boxes = field(default_factory=no_boxes)
    """(P, 4) float32: single objects that are not judged. Boxes on them count neither for nor against; labels in
    front of them are labels."""
    paired: bool = False
    """A box is on such an object only as its match, one to one, as in TrackEval; else with half of its area."""

    @classmethod
    def plain(
        cls,
        boxes: npt.ArrayLike,
        names: Sequence[str],
        *,
        ignored: npt.ArrayLike = (),
        beside: npt.ArrayLike = (),
    ) -> FrameLabels:
        """Objects of which nobody knows which is which; N, M and P boxes of x1 y1 x2 y2."""
        known, regions, others = (
            np.asarray(one, np.float32).reshape(-1, 4) for one in (boxes, ignored, beside)
        )
        return cls(known, np.full(len(known), NO_ID, np.int64), tuple(names), regions, others)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def passed_xyxy_px(self) -> Boxes:
        """(M + P, 4) float32: regions and objects in which nothing is known to be background."""
        return np.concatenate([self.ignored_xyxy_px, self.beside_xyxy_px])


@dataclass(slots=True)
class LabelDoubts:
    """The faults of the labels of a set, counted; the worst, or the first, is named."""

    good: int = 0
    kinds: set[float] = field(default_factory=set)
    """Classes by number, where a set counts them, and how many it names."""
    classes: int = 0
    unread: str = ""
    """A sentence on files that nobody understood."""
    beside: str = ""
    """A sentence on pictures that are left out."""
    _clipped: int = 0
    _worst: tuple[float, str] = (0.0, "")
    _left_out: int = 0
    _first: str = ""
    _resized: int = 0
    _first_resized: str = ""

    def leave_out(self, sentence: str) -> None:
        self._first = self._first or sentence
        self._left_out += 1

    def resized(self, sentence: str) -> None:
        """A picture of another size than its labels say, whose boxes were scaled."""
        self._first_resized = self._first_resized or sentence
        self._resized += 1

    def labels(
        self,
        rows: Sequence[tuple[str, Sequence[float], str]],
        size: tuple[int, int],
        scale: tuple[float, float],
    ) -> FrameLabels:
        """From (class, x1 y1 x2 y2, place in words), times ``scale``, in a picture of this (width, height).

        Boxes are cut at the picture. Boxes without area inside, and repeated ones, are left out; boxes of
        `IGNORED` stand beside: in COCO and VOC objects in front of them count.
        """
        names, boxes, wheres = zip(*rows, strict=True) if rows else ((), (), ())
        inside, solid = self.inside(np.array(boxes, np.float64).reshape(-1, 4) * (scale * 2), size, wheres)
        once: dict[tuple[str, *tuple[float, ...]], int] = {}
        for row in solid.tolist():
            if once.setdefault((names[row], *inside[row].tolist()), row) != row:
                self.leave_out(f"{wheres[row]} stands there twice")
        self.good += len(once)
        found = inside[list(once.values())].astype(np.float32)
        kinds = [name for name, *_ in once]
        passed = np.array([name.casefold() in IGNORED for name in kinds], bool)
        judged = [name for name, skip in zip(kinds, passed, strict=True) if not skip]
        return FrameLabels.plain(found[~passed], judged, beside=found[passed])

    def inside(
        self, boxes: npt.NDArray[np.float64], size: tuple[int, int], wheres: Sequence[str]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.intp]]:
        """(N, 4) boxes cut at a picture of this (width, height), and the rows with an area inside it."""
        inside = np.clip(boxes, 0, np.array([*size, *size], np.float64))
        beyond = np.abs(boxes - inside).max(axis=1, initial=0)
        solid = (inside[:, 2:] > inside[:, :2]).all(axis=1)
        for row in np.flatnonzero(solid & (beyond > _NOTICED_PX)).tolist():
            self._clipped += 1
            self._worst = max(self._worst, (float(beyond[row]), wheres[row]))
        for row in np.flatnonzero(~solid).tolist():
            self.leave_out(
                f"{wheres[row]} has a box outside the picture of {size[0]}x{size[1]}, or without area"
            )
        return inside, np.flatnonzero(solid)

    def sentences(self) -> list[str]:
        said = [one for one in (self.beside, self.unread) if one]
        if self._clipped:
            px, where = self._worst
            said.append(
                f"{self._clipped} labels end outside their picture and were cut; the worst is {where}, by {px:.2g} px"
            )
        if self._left_out:
            said.append(f"{self._left_out} labels were left out; the first: {self._first}")
        if self._resized:
            said.append(
                f"{self._resized} pictures were resized since they were labelled; the first: {self._first_resized}"
            )
        return said

    def check(self) -> None:
        """`UserError` where rows were left out and none was good, or classes are counted from 1."""
        if self.classes in self.kinds and 0 not in self.kinds:
            raise UserError(f"{self._first}, and none is of class 0: count classes from 0")
        if self._left_out and not self.good:
            raise UserError(self._first)


def check_pixels(path: Path, numbers: npt.ArrayLike) -> None:
    """Raise `UserError` where all numbers of the boxes of a file are shares of their pictures."""
    sides = np.asarray(numbers, np.float64)
    sides = sides[np.isfinite(sides)]
    if 0 < np.abs(sides).max(initial=0) <= 1 and (sides % 1).any():
        raise UserError(f"{path} has boxes of 0 to 1, and boxes are in pixels there")


RIGHT_PICTURES = "put the pictures back that were labelled, as large and turned as they were"


def check_inside(
    path: Path, boxes: npt.NDArray[Any], size: tuple[int, int], *, remedy: str = RIGHT_PICTURES
) -> None:
    """Raise `UserError` where boxes of a file lie outside its pictures of (width, height): it is of others.

    Boxes without an area say that the object is not there.
    """
    boxes = boxes[(boxes[:, 2:] > boxes[:, :2]).all(axis=1)]
    centres = (boxes[:, :2] + boxes[:, 2:]) / 2
    outside = ((centres < 0) | (centres > size)).any(axis=1).sum()
    if outside > _MOST_OUTSIDE * len(boxes):
        raise UserError(
            f"{path} has {outside} of {len(boxes)} boxes outside its pictures of {size[0]}x{size[1]}: {remedy}"
        )


def covered_share(boxes: Boxes, regions: Boxes) -> npt.NDArray[np.float64]:
    """(N,) share of each box that the regions together cover; where regions overlap nothing counts twice.

    The regions' edges cut the plane into a grid of cells, each of which is covered wholly or not at all.
    """
    if not len(boxes) or not len(regions):
        return np.zeros(len(boxes))
    xs, ys = np.unique(regions[:, [0, 2]]), np.unique(regions[:, [1, 3]])
    left, right = regions[:, None, 0] <= xs[:-1], regions[:, None, 2] >= xs[1:]
    above, below = regions[:, None, 1] <= ys[:-1], regions[:, None, 3] >= ys[1:]
    covered = ((left & right)[:, :, None] & (above & below)[:, None, :]).any(axis=0)
    wide = _shared(boxes[:, [0, 2]], xs)
    high = _shared(boxes[:, [1, 3]], ys)
    area = np.einsum("nx,xy,ny->n", wide, covered.astype(np.float64), high)
    whole = (boxes[:, 2:] - boxes[:, :2]).astype(np.float64).prod(axis=1)
    return np.asarray(area / np.maximum(whole, 1e-9), np.float64)


def inside_frame(boxes: Boxes, size: tuple[int, int]) -> Boxes:
    """The boxes cropped at the edges of a frame of this (width, height)."""
    return np.asarray(np.clip(boxes, 0, np.array([*size, *size], np.float32)), np.float32)


def _shared(spans: npt.NDArray[np.float32], edges: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """(N, len(edges) - 1): how much of each span lies in each cell."""
    first = np.maximum(spans[:, :1], edges[:-1])
    last = np.minimum(spans[:, 1:], edges[1:])
    return np.asarray(np.clip(last - first, 0, None), np.float64)
