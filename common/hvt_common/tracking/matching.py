"""Which detection is which track's, and which tracks are two of one object."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from hvt_common.tracking import kalman
from hvt_common.tracking.association import Overlaps, grown, larger, overlaps, pair
from hvt_common.tracking.settings import TrackerSettings
from hvt_common.tracking.track_table import LOST, TRACKED, UNCONFIRMED, TrackerInput, TrackTable

_Floats = npt.NDArray[np.float64]
_Indices = npt.NDArray[np.int64]

# Fixed in the authors' program, as costs 1 - IoU of at most 0.5, 0.7 and 0.15.
_WEAK_COST_LIMIT: Final = 0.5
_UNCONFIRMED_COST_LIMIT: Final = 0.7
_DUPLICATE_COST_LIMIT: Final = 0.15
_MOST_APART: Final = 0.2
"""Share of the longer side of a duplicate's box: 0.15 / 0.85 and a little more."""

_AS_PREDICTED_IOU: Final = 0.5
_MOST_SURPRISES: Final = 0.1
"""Tracks elsewhere than predicted or not found, and detections that may start tracks, as a share of the tracks."""


class Match(NamedTuple):
    """The tracks of a frame's detections."""

    detections: _Indices
    """(N,) the detection of each track; -1: none."""
    free: _Indices
    """The confident ones left, which may start tracks."""
    as_predicted: bool
    """Nearly all tracks of the last list are where they were predicted, and hardly anything is new."""


def match(
    table: TrackTable, seen: TrackerInput, settings: TrackerSettings, *, growth: float, held: _Floats | None
) -> Match:
    """The rest is matched once more with boxes larger by ``growth``, also with the tracks at ``held``."""
    # A detection at exactly the threshold is neither confident nor weak in the authors' program.
    free = seen.confidences > settings.track_confidence
    found = np.full(len(table), -1)
    tracked = table.phase >= TRACKED
    same = 0
    if len(table) and len(seen):
        weights = seen.confidences if settings.fuse_scores else None
        limit = 1 - settings.match_iou
        unconfirmed = table.phase == UNCONFIRMED
        boxes = kalman.boxes_of(table.states)
        shared = overlaps(boxes, seen.boxes)
        fused = _fused(shared, weights)
        pair(fused, ~unconfirmed, free, found, limit=limit)
        weak = seen.confidences < settings.track_confidence
        pair(shared, tracked & (found < 0), weak, found, limit=_WEAK_COST_LIMIT)
        pair(fused, unconfirmed, free, found, limit=_UNCONFIRMED_COST_LIMIT)
        if growth > 0:
            around = grown(seen.boxes, growth)
            wide = overlaps(grown(boxes, growth), around)
            if held is not None:
                wide = larger(wide, overlaps(grown(held, growth), around))
            pair(_fused(wide, weights), found < 0, free, found, limit=limit)
        own = (found.take(shared.rows) == shared.columns) & tracked.take(shared.rows)
        same = int(np.count_nonzero(own & (shared.iou >= _AS_PREDICTED_IOU)))
    free &= seen.confidences >= settings.birth_confidence
    new, known = free.nonzero()[0], int(np.count_nonzero(tracked))
    return Match(found, new, known > 0 and known - same + len(new) <= _MOST_SURPRISES * known)


def duplicates(table: TrackTable, boxes: _Floats) -> _Indices:
    """The younger one of each pair of a tracked and a lost track at the same place."""
    is_lost = table.phase == LOST
    none: _Indices = np.empty(0, np.int64)
    lost, present = is_lost.nonzero()[0], (~is_lost).nonzero()[0]
    if not len(lost) or not len(present):
        return none
    # At such an IoU no corner lies further from the other's.
    now, before = boxes.take(present, axis=1), boxes.take(lost, axis=1)
    apart = np.maximum.reduce(np.abs(now[:2, :, None] - before[:2, None]))
    if not np.count_nonzero(apart < _MOST_APART * (1 + np.maximum.reduce(before[2:] - before[:2]))):
        return none
    shared = overlaps(now, before)
    alike = 1 - shared.iou < _DUPLICATE_COST_LIMIT
    a, b = present[shared.rows[alike]], lost[shared.columns[alike]]
    age = table.seen - table.born
    return np.asarray(np.where(age[a] > age[b], b, a), np.int64)


def _fused(found: Overlaps, weights: npt.NDArray[np.float32] | None) -> Overlaps:
    if weights is None:
        return found
    return Overlaps(found.rows, found.columns, found.iou * weights.take(found.columns))
