"""Which track belongs to which detection: overlaps of boxes and the best assignment under a limit."""

from __future__ import annotations

from typing import Final, NamedTuple

import lap
import numpy as np
import numpy.typing as npt

from hvt_common.tracking import kalman
from hvt_common.tracking.settings import TrackerSettings
from hvt_common.tracking.track_table import LOST, TRACKED, UNCONFIRMED, TrackerInput, TrackTable

_Floats = npt.NDArray[np.float64]
_Indices = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]

# A box as x1, y1, -x2, -y2: two boxes share the larger one of each number. The sides come out negative.
_SIGNS = np.array([[1.0], [1], [-1], [-1]])
_PIXEL = np.array([[0.0], [0], [1], [1]])


class Overlaps(NamedTuple):
    """The pairs of two lists of boxes that share anything: of most lists few do."""

    rows: _Indices
    columns: _Indices
    iou: _Floats


def overlaps(a: _Floats, b: _Floats) -> Overlaps:
    """IoU of (4, N) with (4, M) boxes x1, y1, x2, y2, by rising row.

    Boxes are measured as ByteTrack measures them (``cython_bbox``, from the time of whole pixels): a box reaches
    from x1 to x2 *inclusive*, so that one pixel is added to each side. It matters for objects of a few pixels.
    """
    rows, columns = _near(a, b)
    a, b = a * _SIGNS - _PIXEL, b * _SIGNS - _PIXEL
    wide, high = _sides(np.maximum(a.take(rows, axis=1), b.take(columns, axis=1)))
    some = (np.maximum(wide, high) < 0).nonzero()[0]
    rows, columns, shared = rows.take(some), columns.take(some), (wide * high).take(some)
    areas_a, areas_b = np.multiply(*_sides(a)).take(rows), np.multiply(*_sides(b)).take(columns)
    return Overlaps(rows, columns, shared / (areas_a + areas_b - shared))


def _sides(signed: _Floats) -> _Floats:
    return signed[:2] + signed[2:]


def _near(a: _Floats, b: _Floats) -> tuple[_Indices, _Indices]:
    # The pairs that may share something, by rising row: those that do along x, and some more.
    order = b[0].argsort()
    starts = b[0].take(order)
    widest = np.maximum.reduce(b[2] - b[0], initial=0.0)
    first, end = starts.searchsorted(a[0] - widest - 1), starts.searchsorted(a[2] + 1)
    count = end - first
    rows = np.arange(len(count)).repeat(count)
    places = np.arange(len(rows)) + (end - count.cumsum()).repeat(count)
    return rows, order.take(places)


def larger(a: Overlaps, b: Overlaps) -> Overlaps:
    """The larger IoU of each pair that either has."""
    iou = np.zeros([1 + max((*one, *other), default=0) for one, other in zip(a[:2], b[:2], strict=True)])
    for rows, columns, shared in (a, b):
        iou[rows, columns] = np.maximum(iou[rows, columns], shared)
    rows, columns = iou.nonzero()
    return Overlaps(rows, columns, iou[rows, columns])


def assign(cost: _Floats, *, limit: float) -> tuple[_Indices, _Indices]:
    """Rows and columns of the (N, M) costs that belong together at least total cost, none at ``limit`` or above.

    The optimum is ByteTrack's: `lap` extends the matrix so that every row and every column left alone costs
    ``limit / 2``. (To assign first and drop above the limit afterwards is something else: one hopeless row may push
    its neighbours aside.)

    A pair whose row and column have no other candidate under the limit is part of every optimum, and a row
    without candidates of none: both are resolved without the solver, which gets only the rest.
    """
    rows, columns = (cost < limit).nonzero()
    return _assign(rows, columns, cost[rows, columns], limit=limit)


def _assign(rows: _Indices, columns: _Indices, cost: _Floats, *, limit: float) -> tuple[_Indices, _Indices]:
    # From the pairs under the limit.
    by_row, by_column = np.bincount(rows), np.bincount(columns)
    crowd = by_row.take(rows) * by_column.take(columns)
    others = (crowd > 1).nonzero()[0]
    if not len(others):
        return rows, columns
    alone = (crowd == 1).nonzero()[0]
    lone_rows, lone_columns = rows.take(alone), columns.take(alone)
    by_row[lone_rows] = by_column[lone_columns] = 0
    open_rows, open_columns = by_row.nonzero()[0], by_column.nonzero()[0]
    contested = np.full((len(open_rows), len(open_columns)), limit + 1)
    places = open_rows.searchsorted(rows.take(others)), open_columns.searchsorted(columns.take(others))
    contested[places] = cost.take(others)
    picked, _ = lap.lapjv(contested, extend_cost=True, cost_limit=limit, return_cost=False)
    some = (picked >= 0).nonzero()[0]
    return (
        np.concatenate((lone_rows, open_rows.take(some))),
        np.concatenate((lone_columns, open_columns.take(picked.take(some)))),
    )


def grown(boxes: _Floats, growth: float) -> _Floats:
    """(4, N) boxes larger by ``growth`` of their own width and height on every side."""
    if not growth:
        return boxes
    margin = (boxes[2:] - boxes[:2]) * growth
    return np.concatenate((boxes[:2] - margin, boxes[2:] + margin))


def pair(similar: Overlaps, tracks: _Mask, free: _Mask, match: _Indices, *, limit: float) -> None:
    """Match some tracks with some free detections, at a cost 1 - similarity below the limit.

    Writes the detections into ``match`` and takes them out of ``free``, in place.
    """
    if not (np.count_nonzero(tracks) and np.count_nonzero(free)):
        return
    rows, columns = similar.rows, similar.columns
    cost = 1 - similar.iou
    under = (tracks.take(rows) & free.take(columns) & (cost < limit)).nonzero()[0]
    if not len(under):
        return
    paired, given = _assign(rows.take(under), columns.take(under), cost.take(under), limit=limit)
    match[paired], free[given] = given, False


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
