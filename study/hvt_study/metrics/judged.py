"""For each frame the labels, the boxes of the ground, and those of both that are judged.

All boxes are x1 y1 x2 y2 in source pixels. A frame is a frame of the source at 15 a second, coded or not. Nothing in
ignored regions is judged, all in one vocabulary, and only classes that the labels know.

Ignored regions go by the rule of VisDrone's own toolkit (``dropObjectsInIgr.m`` of the VisDrone2018-DET and MOT
toolkits): a label or a box with half of its area or more in the ignored regions, taken together, is dropped before
anything is matched. A single object that is not asked for takes out the boxes on it, but neither labels in front of
it nor the boxes that are on those.

Sizes are COCO's, 32 and 96 pixels squared (Lin et al. 2014, https://cocodataset.org/#detection-eval), in *source*
pixels: they mean the same object for every method. The pilot's "small" is a share of the frame: see `proxies`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from hvt_common.inference.class_names import MOVING
from hvt_common.values import Boxes, iou
from hvt_study.datasets.labels import NO_ID, FrameLabels, covered_share, no_boxes, no_ids

Rows: TypeAlias = npt.NDArray[np.bool_] | npt.NDArray[np.intp]
"""Which rows of parallel arrays: a mask, or indices."""


def no_numbers() -> npt.NDArray[np.float32]:
    return np.empty(0, np.float32)


@dataclass(frozen=True, slots=True)
class FrameView:
    """The boxes of the ground at one frame, N of them; an empty one shows nothing."""

    boxes_xyxy_px: Boxes = field(default_factory=no_boxes)
    """(N, 4) float32, source pixels, inside the frame."""
    ids: npt.NDArray[np.int64] = field(default_factory=no_ids)
    """(N,) of the ground's tracks; `NO_ID` for plain detections."""
    class_names: tuple[str, ...] = ()
    """N names as shown, after refinement."""
    confidences: npt.NDArray[np.float32] = field(default_factory=no_numbers)
    """(N,) of the class that is shown, 0…1."""
    names_before: tuple[str, ...] = ()
    """N names without refinement, from the base stream."""

    def __post_init__(self) -> None:
        counts = {len(self.boxes_xyxy_px), len(self.ids), len(self.class_names), len(self.confidences)}
        assert counts == {len(self.names_before)}, "parallel arrays have one length"

    @classmethod
    def plain(
        cls, boxes: npt.ArrayLike, names: Sequence[str], confidences: npt.NDArray[np.float32] | None = None
    ) -> FrameView:
        """Boxes of no track, which nothing has refined; without ``confidences`` all are sure."""
        sure = np.ones(len(names), np.float32) if confidences is None else confidences
        array, ids = np.asarray(boxes, np.float32).reshape(-1, 4), np.full(len(names), NO_ID, np.int64)
        return cls(array, ids, tuple(names), sure, tuple(names))

    def __len__(self) -> int:
        return len(self.ids)

    def rows(self, chosen: Rows) -> FrameView:
        return FrameView(
            self.boxes_xyxy_px[chosen],
            self.ids[chosen],
            rows_of(self.class_names, chosen),
            self.confidences[chosen],
            rows_of(self.names_before, chosen),
        )


def rows_of(names: Sequence[str], chosen: Rows) -> tuple[str, ...]:
    indices = np.flatnonzero(chosen) if chosen.dtype == np.bool_ else chosen
    return tuple(names[index] for index in indices.tolist())


LabelledFrame: TypeAlias = tuple[FrameLabels, FrameView]

LabelledFrames: TypeAlias = Sequence[LabelledFrame]
"""Frames of one sequence, in order; it may be empty."""


LEAST_IOU = 0.5

Floats = npt.NDArray[np.floating[Any]]
Size: TypeAlias = Literal["small", "medium", "large"]

SIZES: Final[tuple[Size, ...]] = ("small", "medium", "large")
LIMITS_PX2: Final = (32.0**2, 96.0**2)
LARGEST_PX2: Final = 1e10
_IGNORED_SHARE = 0.5


@dataclass(frozen=True, slots=True)
class Judged:
    """The N labels of one frame that count, and the boxes shown beside them."""

    boxes_xyxy_px: npt.NDArray[np.float64]
    """(N, 4), source pixels."""
    ids: npt.NDArray[np.int64]
    """(N,), `NO_ID` where the labels know no tracks."""
    class_names: tuple[str, ...]
    view: FrameView

    @property
    def areas_px2(self) -> npt.NDArray[np.float64]:
        boxes = self.boxes_xyxy_px
        return np.asarray(np.clip(boxes[:, 2:] - boxes[:, :2], 0, None).prod(axis=1))


def judged(
    labelled: LabelledFrames, *, word: Callable[[str], str] = str, classes: Collection[str] | None = None
) -> list[Judged]:
    """Take labels and boxes that are not judged out of every frame of a sequence.

    ``word`` brings the names of labels and boxes into one vocabulary, such as
    `hvt_common.inference.class_names.kind_of`. Labels and boxes of other ``classes`` (names in it) are left out; None
    keeps all. A box stays where its name before *or* after refinement is one of them, so that no still can take a
    false box out of the account. An object that merely moves (`MOVING`) may be of any class and stays.
    """
    return [_judged(labels, view, word, classes) for labels, view in labelled]


def _judged(
    labels: FrameLabels, view: FrameView, word: Callable[[str], str], classes: Collection[str] | None
) -> Judged:
    names = tuple(map(word, labels.class_names))
    before = tuple(map(word, view.names_before))
    after = tuple(map(word, view.class_names))
    wanted = _outside(labels.boxes_xyxy_px, labels.ignored_xyxy_px) & _known(names, classes)
    known = _known(before, classes) | _known(after, classes)
    there = labels.boxes_xyxy_px[wanted]
    shown = known & _judgeable(view.boxes_xyxy_px, labels, there=there)
    in_words = FrameView(view.boxes_xyxy_px, view.ids, after, view.confidences, before)
    return Judged(
        boxes_xyxy_px=np.asarray(there, np.float64),
        ids=np.asarray(labels.ids, np.int64)[wanted],
        class_names=rows_of(names, wanted),
        view=in_words.rows(shown),
    )


def _judgeable(boxes: Boxes, labels: FrameLabels, *, there: Boxes) -> npt.NDArray[np.bool_]:
    """(N,) boxes that are right or wrong."""
    outside = _outside(boxes, labels.ignored_xyxy_px)
    if not len(labels.beside_xyxy_px):
        return outside
    if labels.paired:
        pairs = matched_rows(np.concatenate((there, labels.beside_xyxy_px)), boxes)
        outside[pairs[pairs[:, 0] >= len(there), 1]] = False
        return outside
    free = _outside(boxes, np.concatenate((labels.ignored_xyxy_px, labels.beside_xyxy_px)))
    on = iou(boxes, there).max(axis=1, initial=0) >= LEAST_IOU
    return np.asarray(outside & (free | on))


def _outside(boxes: Boxes, regions: Boxes) -> npt.NDArray[np.bool_]:
    return np.asarray(covered_share(boxes, regions) < _IGNORED_SHARE)


def _known(names: Sequence[str], classes: Collection[str] | None) -> npt.NDArray[np.bool_]:
    return np.array([classes is None or name == MOVING or name in classes for name in names], np.bool_)


def matched_rows(labels_xyxy_px: Floats, shown_xyxy_px: Floats) -> npt.NDArray[np.int64]:
    """Match (N, 4) labels and (M, 4) boxes one to one, whatever their classes.

    As many pairs as possible of an IoU of `LEAST_IOU` or more, and of those matchings the one with most overlap in
    all (Kuhn 1955, by `scipy.optimize.linear_sum_assignment`). Returns (K, 2): row of the label, row of the box, by
    row of the label.
    """
    if not len(labels_xyxy_px) or not len(shown_xyxy_px):
        return np.empty((0, 2), np.int64)
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415 - commands without figures run without it

    overlap = iou(labels_xyxy_px, shown_xyxy_px)
    enough = overlap >= LEAST_IOU
    # A pair that counts is worth more than any sum of overlaps.
    value = np.where(enough, overlap + min(overlap.shape), 0.0)
    rows, columns = linear_sum_assignment(value, maximize=True)
    pairs = np.stack((rows, columns), axis=1).astype(np.int64)
    return pairs[enough[rows, columns]]


def of_size(
    size: Size, areas_px2: npt.NDArray[np.float64], *, limits_px2: tuple[float, float] = LIMITS_PX2
) -> npt.NDArray[np.bool_]:
    """Which of (N,) areas are of this size; a limit belongs to the larger one."""
    return np.asarray(np.digitize(areas_px2, limits_px2) == SIZES.index(size))
