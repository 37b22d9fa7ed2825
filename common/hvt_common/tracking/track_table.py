"""The tracker's memory: the usable detections of a frame, and all living tracks as parallel arrays."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
import numpy.typing as npt

from hvt_common.tracking import kalman
from hvt_common.values import Detections

_Floats = npt.NDArray[np.float64]
_Indices = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]

_FARTHEST_PX: Final = 1e9

UNCONFIRMED, TRACKED, LOST = range(3)
"""The phases of a track: seen once; found by the last update; not found by it."""


@dataclass(frozen=True, slots=True)
class TrackerInput:
    """The usable detections of one frame, best first."""

    boxes: _Floats
    measured: _Floats
    """(M, 4) centre x, centre y, aspect ratio, height."""
    confidences: npt.NDArray[np.float32]
    class_ids: npt.NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.confidences)

    @classmethod
    def of(cls, detections: Detections, *, low_confidence: float) -> TrackerInput:
        """Leave out what is weak, not finite or without area; order what remains.

        New ids are given in this order, so it must not depend on the order of the input: equal confidences are
        ordered by box and class.
        """
        boxes = detections.boxes_xyxy_px.astype(np.float64)
        confidences, class_ids = detections.confidences, detections.class_ids
        # Comparisons with NaN are false: what is not a number fails them all.
        usable = (boxes[:, 2:] > boxes[:, :2]).all(axis=1) & (np.abs(boxes) < _FARTHEST_PX).all(axis=1)
        usable &= (confidences > low_confidence) & (confidences < math.inf)
        order = usable.nonzero()[0]
        ranked = confidences[order]
        if not (ranked[1:] < ranked[:-1]).all():
            order = order[np.lexsort((class_ids[order], *boxes[order].T, -ranked))]
        boxes = boxes[order]
        return cls(boxes, kalman.measure(boxes), confidences[order], class_ids[order])

    def take(self, index: _Indices) -> TrackerInput:
        """Some of them, in the order of ``index``."""
        return TrackerInput(
            self.boxes[index], self.measured[index], self.confidences[index], self.class_ids[index]
        )


@dataclass(slots=True)
class TrackTable:
    """All living tracks as parallel arrays, ordered by id."""

    states: kalman.States
    ids: _Indices
    born: _Indices
    seen: _Indices
    heights: _Floats
    """Of the boxes when they were last seen."""
    lost_at: _Indices
    """Frame of the update that did not find the track; means something in phase lost only."""
    phase: npt.NDArray[np.int8]
    overdue: _Mask
    """Found again after its time was up: when lost once more, it is forgotten at once."""
    started: _Mask
    confidences: npt.NDArray[np.float32]
    votes: npt.NDArray[np.float32]
    """(N, C) decayed sum of confidences for each class up to the highest seen so far."""

    def __len__(self) -> int:
        return len(self.ids)

    @classmethod
    def empty(cls) -> TrackTable:
        return cls.new(
            TrackerInput.of(Detections.none(), low_confidence=0), first_id=1, frame_index=0, classes=0
        )

    @classmethod
    def new(cls, seen: TrackerInput, *, first_id: int, frame_index: int, classes: int) -> TrackTable:
        """One unconfirmed track a detection, with votes on ``classes`` classes."""
        count = len(seen)
        votes = np.zeros((count, classes), np.float32)
        votes[np.arange(count), seen.class_ids] = seen.confidences
        return cls(
            states=kalman.initiate(seen.measured),
            ids=np.arange(first_id, first_id + count),
            born=np.full(count, frame_index),
            seen=np.full(count, frame_index),
            heights=seen.measured[:, 3].copy(),
            lost_at=np.full(count, frame_index),
            phase=np.full(count, UNCONFIRMED, np.int8),
            overdue=np.zeros(count, bool),
            started=np.zeros(count, bool),
            confidences=seen.confidences,
            votes=votes,
        )

    def copy(self) -> TrackTable:
        """The same tracks, which change no more."""
        return TrackTable(*(getattr(self, name).copy() for name in _COLUMNS))

    def retain(self, mask: _Mask) -> None:
        """Drop all tracks but the marked ones."""
        for name in _COLUMNS:
            setattr(self, name, getattr(self, name)[mask])

    def append(self, other: TrackTable) -> None:
        """Add tracks with higher ids and as many classes."""
        for name in _COLUMNS:
            setattr(self, name, np.concatenate((getattr(self, name), getattr(other, name))))

    def widen(self, classes: int) -> None:
        """Extend the table by votes on classes up to ``classes``."""
        missing = classes - self.votes.shape[1]
        if missing > 0:
            self.votes = np.pad(self.votes, ((0, 0), (0, missing)))


_COLUMNS: Final = tuple(column.name for column in fields(TrackTable))
