"""Which track belongs to which detection: overlaps of boxes and the best assignment under a limit."""

from __future__ import annotations

from typing import NamedTuple

import lap
import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.float64]
_Indices = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]


class Overlaps(NamedTuple):
    """The pairs of two lists of boxes that share anything: of most lists few do."""

    rows: _Indices
    columns: _Indices
    iou: _Floats


def overlaps(a_xyxy_px: _Floats, b_xyxy_px: _Floats) -> Overlaps:
    """IoU of (N, 4) with (M, 4) boxes.

    Boxes are measured as ByteTrack measures them (``cython_bbox``, from the time of whole pixels): a box reaches
    from x1 to x2 *inclusive*, so that one pixel is added to each side. It matters for objects of a few pixels.
    """
    a, b = a_xyxy_px.T.copy(), b_xyxy_px.T.copy()
    a[2:] += 1
    b[2:] += 1
    near = np.less.outer(a[0], b[2])
    near &= np.greater.outer(a[2], b[0])
    near &= np.less.outer(a[1], b[3])
    near &= np.greater.outer(a[3], b[1])
    places = near.ravel().nonzero()[0]  # ten times as fast as in two dimensions
    if not len(places):
        return Overlaps(places, places, np.empty(0))
    rows, columns = np.divmod(places, near.shape[1])
    a, b = np.take(a, rows, axis=1), np.take(b, columns, axis=1)
    shared = _areas(np.concatenate((np.maximum(a[:2], b[:2]), np.minimum(a[2:], b[2:]))))
    return Overlaps(rows, columns, shared / (_areas(a) + _areas(b) - shared))


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
    return _assign(cost, *(cost < limit).nonzero(), limit=limit)


def _assign(cost: _Floats, rows: _Indices, columns: _Indices, *, limit: float) -> tuple[_Indices, _Indices]:
    by_row = np.bincount(rows, minlength=cost.shape[0])
    by_column = np.bincount(columns, minlength=cost.shape[1])
    alone = (by_row.take(rows) == 1) & (by_column.take(columns) == 1)
    lone_rows, lone_columns = rows[alone], columns[alone]
    if len(lone_rows) == len(rows):
        return rows, columns
    by_row[lone_rows] = by_column[lone_columns] = 0
    open_rows, open_columns = by_row.nonzero()[0], by_column.nonzero()[0]
    contested = np.ascontiguousarray(cost[open_rows[:, None], open_columns])
    picked_rows, picked_columns = lap.lapjvx(contested, extend_cost=True, cost_limit=limit, return_cost=False)
    under = contested[picked_rows, picked_columns] < limit
    return (
        np.concatenate((lone_rows, open_rows[picked_rows[under]])),
        np.concatenate((lone_columns, open_columns[picked_columns[under]])),
    )


def grown(boxes: _Floats, growth: float) -> _Floats:
    """Boxes larger by ``growth`` of their own width and height on every side."""
    if growth <= 0:
        return boxes
    margin = (boxes[:, 2:] - boxes[:, :2]) * growth
    return np.concatenate((boxes[:, :2] - margin, boxes[:, 2:] + margin), axis=1)


def pair(similar: Overlaps, tracks: _Mask, free: _Mask, match: _Indices, *, limit: float) -> None:
    """Match some tracks with some free detections, at a cost 1 - similarity below the limit.

    Writes the detections into ``match`` and takes them out of ``free``, in place.
    """
    rows, columns = similar.rows, similar.columns
    cost = 1 - similar.iou
    under = (tracks.take(rows) & free.take(columns) & (cost < limit)).nonzero()[0]
    if not len(under):
        return
    costs = np.ones((len(tracks), len(free)))
    costs[rows, columns] = cost
    rows, columns = _assign(costs, rows.take(under), columns.take(under), limit=limit)
    match[rows] = columns
    free[columns] = False


def _areas(corners: _Floats) -> _Floats:
    # (N,) areas of (4, N) corner rows.
    width, height = corners[2:] - corners[:2]
    return np.asarray(width * height, np.float64)
