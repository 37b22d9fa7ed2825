"""Which track belongs to which detection: overlaps of boxes and the best assignment under a limit."""

from __future__ import annotations

from typing import NamedTuple

import lap
import numpy as np
import numpy.typing as npt

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
