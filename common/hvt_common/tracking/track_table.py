"""The tracker's memory: the usable detections of a frame, and all living tracks as parallel arrays."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from hvt_common.tracking import kalman
from hvt_common.values import Detections

_Floats = npt.NDArray[np.float64]
_Indices = npt.NDArray[np.int64]
_Scores = npt.NDArray[np.float32]

_FARTHEST_PX: Final = 1e9

UNCONFIRMED, LOST, OVER_TIME, TRACKED, OVERDUE, ENDED = range(6)
"""The phases of a track: seen once; not found by the last update; not found for long, the next update is its last
chance; found by the last update; found at its last chance: lost once more, it is forgotten at once. The third and
the last phase end with the next update."""

IF_FOUND = np.array([TRACKED, TRACKED, OVERDUE, TRACKED, OVERDUE])
IF_MISSED = np.array([ENDED, LOST, ENDED, LOST, ENDED])
"""The next phase."""


@dataclass(frozen=True, slots=True)
class TrackerInput:
    """The usable detections of one frame, best first."""

    boxes: _Floats
    """(4, M) x1, y1, x2, y2."""
    measured: _Floats
    """(4, M) centre x, centre y, aspect ratio, height."""
    confidences: npt.NDArray[np.float32]
    class_ids: npt.NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.confidences)

    @classmethod
    def of(cls, detections: Detections, *, low_confidence: float) -> TrackerInput:
        """Leave out detections that are weak, not finite or without area; order the others.

        New ids are given in this order, so it must not depend on the order of the input: equal confidences are
        ordered by box and class. A `ValueError` means that one of the class ids is negative.
        """
        boxes = detections.boxes_xyxy_px.T.astype(np.float64, order="C")
        confidences, class_ids = detections.confidences, detections.class_ids
        # Comparisons with NaN are false: a box with one fails them all.
        low, high = boxes[:2], boxes[2:]
        whole = (low < high) & (low > -_FARTHEST_PX) & (high < _FARTHEST_PX)
        usable = whole[0] & whole[1] & (confidences > low_confidence) & (confidences < math.inf)
        order = usable.nonzero()[0]
        ranked = confidences.take(order)
        in_order = not np.count_nonzero(ranked[1:] >= ranked[:-1])
        if not in_order:
            order = order[np.lexsort((class_ids[order], *boxes[:, order], -ranked))]
        if not in_order or len(order) < len(usable):
            boxes, confidences = boxes.take(order, axis=1), confidences.take(order)
            class_ids = class_ids.take(order)
        if np.count_nonzero(class_ids < 0):
            raise ValueError(f"class_ids holds {class_ids.min()}, must not be negative")
        return cls(boxes, kalman.measure(boxes), confidences, class_ids)

    def take(self, rows: _Indices) -> TrackerInput:
        """Some of them, in the order of ``rows``."""
        return TrackerInput(
            self.boxes.take(rows, axis=1),
            self.measured.take(rows, axis=1),
            self.confidences.take(rows),
            self.class_ids.take(rows),
        )


class TrackTable:
    """All living tracks, ordered by id: one column each."""

    def __init__(self, states: kalman.States, heights: _Floats, numbers: _Indices, scores: _Scores) -> None:
        self.states = states
        self.heights = heights
        """(N,) of the boxes when they were last seen."""
        self.numbers = numbers
        """(5, N), which these are the rows of."""
        self.ids, self.born, self.seen, self.since, self.phase = numbers
        """``since``: the update that put the track into its phase. It and the two before are frames."""
        self.scores = scores
        """(1 + C, N) the confidence of the last detection; the decayed sum of confidences for each class so far."""

    def __len__(self) -> int:
        return len(self.heights)

    @classmethod
    def empty(cls) -> TrackTable:
        numbers, scores = np.zeros((5, 0), np.int64), np.zeros((2, 0), np.float32)
        return cls(kalman.initiate(np.zeros((4, 0))), np.zeros(0), numbers, scores)

    def copy(self) -> TrackTable:
        return TrackTable(self.states.copy(), self.heights.copy(), self.numbers.copy(), self.scores.copy())

    def take(self, rows: _Indices) -> TrackTable:
        """Some of the tracks, by rising ``rows``."""
        return TrackTable(
            self.states.take(rows, axis=2),
            self.heights.take(rows),
            self.numbers.take(rows, axis=1),
            self.scores.take(rows, axis=1),
        )

    def with_new(self, seen: TrackerInput, *, first_id: int, frame_index: int, phase: int) -> TrackTable:
        """One track more a detection, at rest."""
        count, classes = len(seen), len(self.scores)
        numbers = np.full((5, count), frame_index)
        numbers[0] = np.arange(first_id, first_id + count)
        numbers[4] = phase
        scores = np.zeros((classes, count), np.float32)
        scores[0] = scores[1 + seen.class_ids, np.arange(count)] = seen.confidences
        return TrackTable(
            np.concatenate((self.states, kalman.initiate(seen.measured)), axis=2),
            np.concatenate((self.heights, seen.measured[3])),
            np.concatenate((self.numbers, numbers), axis=1),
            np.concatenate((self.scores, scores), axis=1),
        )

    def widened(self, classes: int) -> TrackTable:
        """With votes on at least this many ``classes``."""
        missing = 1 + classes - len(self.scores)
        if missing <= 0:
            return self
        return TrackTable(
            self.states, self.heights, self.numbers, np.pad(self.scores, ((0, missing), (0, 0)))
        )
