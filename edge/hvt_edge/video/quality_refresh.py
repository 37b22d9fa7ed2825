"""Which regions of the next base frame get more than their share of the bits.

What a frame shows well stays well shown for a while, because the frames after it are predicted from it. So bits are
worth more where they come in pulses: a whole frame once a period (`RefreshPlan`), or one cell of a grid in
each
frame, in rotation (`RollingRefreshPlan`), which keeps the frames small. `TrackRegions` (R0) spends them on tracks.

A plan is asked once for each coded frame, in order, with the tracks that are known by then.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt

from hvt_common.values import Boxes, Tracks
from hvt_edge.video.regions import BLOCK_PX, MOST_REGIONS, Region

__all__ = ["RefreshPlan", "RegionPlan", "RollingRefreshPlan", "TrackRegions", "combined"]


class RegionPlan(Protocol):
    """Decides frame by frame; holds no clock."""

    def regions(self, tick: int, tracks: Tracks | None, *, keyframe: bool = False) -> list[Region]:
        """What the frame of this tick gets.

        ``tracks``, in base pixels, may be those of some frames ago; None before there are any. ``keyframe`` says
        that the frame will be one, and takes its bits from no other.
        """
        ...


class RefreshPlan:
    """The whole frame at ``-depth`` once in ``period_ticks``, on the first coded frame from then on."""

    def __init__(self, size: tuple[int, int], *, period_ticks: int, depth: float) -> None:
        self._refresh = [Region((0, 0, *size), -depth)]
        self._period = max(1, period_ticks)
        self._next: int | None = None

    def regions(self, tick: int, tracks: Tracks | None, *, keyframe: bool = False) -> list[Region]:
        """See `RegionPlan`. A keyframe starts the period anew: it is a pulse of its own."""
        del tracks
        if self._next is None or keyframe:
            self._next = tick + self._period
            return []
        if tick < self._next:
            return []
        self._next += self._period * (1 + (tick - self._next) // self._period)
        return list(self._refresh)


class RollingRefreshPlan:
    """One cell of a grid at ``-depth`` in each coded frame; each has its turn, cells that hold tracks more often.

    The cell with the largest product of age (in coded frames) and weight comes next, so none waits for ever: with
    all weights equal it is a plain rotation.
    """

    _TRACK_WEIGHT = 3.0
    """A cell with tracks comes so many times as often as one without."""

    def __init__(self, size: tuple[int, int], *, columns: int, rows: int, depth: float) -> None:
        self._cells = grid_cells(size, columns=columns, rows=rows)
        self._depth = depth
        # As if each had been shown in the order of a rotation that never puts neighbours in a row.
        self._age = np.array(_spread(columns * rows), np.float64)

    def regions(self, tick: int, tracks: Tracks | None, *, keyframe: bool = False) -> list[Region]:
        """See `RegionPlan`. Keyframes take no turn."""
        del tick
        if keyframe:
            return []
        weight = np.ones(len(self._cells))
        if tracks is not None and len(tracks):
            weight[self._held(tracks.boxes_xyxy_px)] = self._TRACK_WEIGHT
        chosen = int(np.argmax((1 + self._age) * weight))
        self._age += 1
        self._age[chosen] = 0
        x1, y1, x2, y2 = self._cells[chosen].tolist()
        return [Region((x1, y1, x2, y2), -self._depth)]

    def _held(self, boxes: Boxes) -> npt.NDArray[np.bool_]:
        """Which cells hold the centre of a box."""
        x, y = (boxes[:, 0] + boxes[:, 2]) / 2, (boxes[:, 1] + boxes[:, 3]) / 2
        x1, y1, x2, y2 = (self._cells[:, [index]] for index in range(4))
        inside = (x >= x1) & (x < x2) & (y >= y1) & (y < y2)
        return np.asarray(inside.any(axis=1), np.bool_)


class TrackRegions:
    """R0: the boxes of the tracks at ``-depth``, less where they cover much of the picture.

    Up to ``free_share`` of the area the depth is as asked; beyond, it shrinks in proportion, so that the bits taken
    from the rest of the picture stay about the same.
    """

    def __init__(
        self,
        size: tuple[int, int],
        *,
        depth: float,
        padding: float = 0.1,
        free_share: float = 0.25,
    ) -> None:
        self._size = size
        self._depth = depth
        self._padding = padding
        self._free_share = free_share

    def regions(self, tick: int, tracks: Tracks | None, *, keyframe: bool = False) -> list[Region]:
        """See `RegionPlan`. Keyframes are treated as other frames: what they lack, all after them lack."""
        del tick, keyframe
        if tracks is None or not len(tracks):
            return []
        best = np.argsort(-tracks.confidences, kind="stable")[:MOST_REGIONS]
        blocks = self._blocks(tracks.boxes_xyxy_px[np.sort(best)])
        share = self._covered(blocks)
        if share <= 0:
            return []
        offset = -self._depth * min(1.0, self._free_share / share)
        return [Region((x1, y1, x2, y2), offset) for x1, y1, x2, y2 in blocks]

    def _blocks(self, boxes: Boxes) -> list[tuple[int, int, int, int]]:
        """The padded boxes on the grid of blocks, inside the picture; those outside it are left out."""
        pad = (boxes[:, 2:] - boxes[:, :2]) * self._padding
        grown = np.concatenate([boxes[:, :2] - pad, boxes[:, 2:] + pad], axis=1)
        limits = np.array([*self._size, *self._size], np.float64)
        grown = np.clip(np.nan_to_num(grown.astype(np.float64)), 0, limits)
        low = np.floor(grown[:, :2] / BLOCK_PX) * BLOCK_PX
        high = np.minimum(np.ceil(grown[:, 2:] / BLOCK_PX) * BLOCK_PX, limits[:2])
        whole = np.concatenate([low, high], axis=1).astype(int).tolist()
        return [(x1, y1, x2, y2) for x1, y1, x2, y2 in whole if x2 > x1 and y2 > y1]

    def _covered(self, blocks: Sequence[tuple[int, int, int, int]]) -> float:
        """Share of the picture's blocks that at least one box touches."""
        width, height = self._size
        mask = np.zeros((math.ceil(height / BLOCK_PX), math.ceil(width / BLOCK_PX)), np.bool_)
        for x1, y1, x2, y2 in blocks:
            mask[y1 // BLOCK_PX : -(-y2 // BLOCK_PX), x1 // BLOCK_PX : -(-x2 // BLOCK_PX)] = True
        return float(mask.mean())


class _Combined:
    def __init__(self, plans: Sequence[RegionPlan]) -> None:
        self._plans = plans

    def regions(self, tick: int, tracks: Tracks | None, *, keyframe: bool = False) -> list[Region]:
        asked = [plan.regions(tick, tracks, keyframe=keyframe) for plan in self._plans]
        return [region for regions in asked for region in regions]


def combined(*plans: RegionPlan | None) -> RegionPlan | None:
    """One plan of several; where their regions overlap the deepest counts. None where there is none."""
    present = [plan for plan in plans if plan is not None]
    if not present:
        return None
    return present[0] if len(present) == 1 else _Combined(present)


def grid_cells(size: tuple[int, int], *, columns: int, rows: int) -> npt.NDArray[np.int64]:
    """(columns x rows, 4) boxes that tile the picture, row by row, their inner edges on the grid of blocks."""

    def edges(side_px: int, count: int) -> list[int]:
        inner = [round(index * side_px / count / BLOCK_PX) * BLOCK_PX for index in range(1, count)]
        return [0, *inner, side_px]

    xs, ys = edges(size[0], columns), edges(size[1], rows)
    boxes = [
        (xs[column], ys[row], xs[column + 1], ys[row + 1]) for row in range(rows) for column in range(columns)
    ]
    return np.array(boxes, np.int64)


def _spread(count: int) -> list[int]:
    """Ages 0 … count - 1 such that cells shown one after the other lie apart."""
    step = next(
        one
        for one in range(max(1, round(count * 0.382)), count + 1)
        if math.gcd(one, count) == 1 or count == 1
    )
    ages = [0] * count
    for turn in range(count):
        ages[turn * step % count] = count - 1 - turn
    return ages
