"""Which track belongs to which detection: overlaps of boxes and the best assignment under a limit."""

from __future__ import annotations

import lap
import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.float64]
_Indices = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]


def overlaps(a_xyxy_px: _Floats, b_xyxy_px: _Floats) -> _Floats:
    """IoU of (N, 4) with (M, 4) boxes, (N, M) float64.

    Boxes are measured as ByteTrack measures them (``cython_bbox``, from the time of whole pixels): a box reaches
    from x1 to x2 *inclusive*, so that one pixel is added to each side. It matters for objects of a few pixels.
    """
    a, b = a_xyxy_px.T.copy(), b_xyxy_px.T.copy()
    a[2:] += 1
    b[2:] += 1
    shared = _common_length(a[0], a[2], b[0], b[2])
    shared *= _common_length(a[1], a[3], b[1], b[3])
    union = np.add.outer(_areas(a), _areas(b))
    union -= shared
    shared /= union
    return shared


def assign(cost: _Floats, *, limit: float) -> tuple[_Indices, _Indices]:
    """Rows and columns of the (N, M) costs that belong together at least total cost, none at ``limit`` or above.

    The optimum is ByteTrack's: `lap` extends the matrix so that every row and every column left alone costs
    ``limit / 2``. (To assign first and drop above the limit afterwards is something else: one hopeless row may push
    its neighbours aside.)

    A pair whose row and column have no other candidate under the limit is part of every optimum, and a row
    without candidates of none: both are resolved without the solver, which gets only the rest.
    """
    rows, columns = (cost < limit).nonzero()
    by_row = np.bincount(rows, minlength=cost.shape[0])
    by_column = np.bincount(columns, minlength=cost.shape[1])
    alone = (by_row[rows] == 1) & (by_column[columns] == 1)
    if alone.all():
        return rows, columns
    by_row[rows[alone]] = 0
    by_column[columns[alone]] = 0
    open_rows, open_columns = by_row.nonzero()[0], by_column.nonzero()[0]
    contested = np.ascontiguousarray(cost[open_rows[:, None], open_columns])
    picked_rows, picked_columns = lap.lapjvx(contested, extend_cost=True, cost_limit=limit, return_cost=False)
    under = contested[picked_rows, picked_columns] < limit
    return (
        np.concatenate((rows[alone], open_rows[picked_rows[under]])),
        np.concatenate((columns[alone], open_columns[picked_columns[under]])),
    )


def grown(boxes: _Floats, growth: float) -> _Floats:
    """Boxes larger by ``growth`` of their own width and height on every side."""
    if growth <= 0:
        return boxes
    margin = (boxes[:, 2:] - boxes[:, :2]) * growth
    return np.concatenate((boxes[:, :2] - margin, boxes[:, 2:] + margin), axis=1)


def pair(similarity: _Floats, tracks: _Mask, free: _Mask, match: _Indices, *, limit: float) -> None:
    """Match some tracks with some free detections, at a cost 1 - similarity below the limit.

    Writes the detections into ``match`` and takes them out of ``free``, in place.
    """
    rows, columns = tracks.nonzero()[0], free.nonzero()[0]
    if not len(rows) or not len(columns):
        return
    i, j = assign(1 - similarity[rows[:, None], columns], limit=limit)
    match[rows[i]] = columns[j]
    free[columns[j]] = False


def _common_length(a_from: _Floats, a_to: _Floats, b_from: _Floats, b_to: _Floats) -> _Floats:
    # (N, M) length that the intervals of a and b share on one axis.
    common = np.minimum.outer(a_to, b_to)
    common -= np.maximum.outer(a_from, b_from)
    return np.maximum(common, 0, out=common)


def _areas(corners: _Floats) -> _Floats:
    # (N,) areas of (4, N) corner rows.
    return np.asarray((corners[2] - corners[0]) * (corners[3] - corners[1]), np.float64)
