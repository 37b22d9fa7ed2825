"""CLEAR MOT and IDF1 for tests, as `motmetrics` computes them (validated on its published numbers).

CLEAR MOT: Bernardin and Stiefelhagen, 2008. IDF1: Ristani et al., 2016.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

Frames = dict[int, tuple[np.ndarray, np.ndarray]]
"""Frame index to ids (N,) and boxes x1 y1 x2 y2 (N, 4)."""

_FORBIDDEN = 1e6


@dataclass(frozen=True)
class Score:
    """The three figures that tests look at; MOTA and IDF1 as shares."""

    mota: float
    idf1: float
    switches: int


def score(truth: Frames, tracks: Frames, *, least_iou: float = 0.5) -> Score:
    """Compare tracks with the truth; boxes belong together from ``least_iou`` on."""
    matched_before: dict[int, int] = {}
    misses = false = switches = total = tracked = 0
    together: dict[tuple[int, int], int] = {}
    for frame in sorted(truth.keys() | tracks.keys()):
        true_ids, true_boxes = truth.get(frame, (np.empty(0, int), np.empty((0, 4))))
        ids, boxes = tracks.get(frame, (np.empty(0, int), np.empty((0, 4))))
        distance = 1 - _iou(true_boxes, boxes)
        distance[distance > 1 - least_iou] = np.inf
        for i, j in zip(*np.nonzero(np.isfinite(distance)), strict=True):
            key = (int(true_ids[i]), int(ids[j]))
            together[key] = together.get(key, 0) + 1
        pairs = _frame_pairs(distance, true_ids, ids, matched_before)
        for i, j in pairs:
            switches += matched_before.get(int(true_ids[i]), int(ids[j])) != int(ids[j])
            matched_before[int(true_ids[i])] = int(ids[j])
        misses += len(true_ids) - len(pairs)
        false += len(ids) - len(pairs)
        total += len(true_ids)
        tracked += len(ids)
    mota = 1 - (misses + false + switches) / total
    return Score(mota=mota, idf1=2 * _id_true_positives(together) / (total + tracked), switches=switches)


def _frame_pairs(distance, true_ids, ids, before) -> list[tuple[int, int]]:
    """Pairs of the last frames are kept while they overlap; the rest is assigned at least distance."""
    column = {int(track): j for j, track in enumerate(ids)}
    kept = []
    for i, true in enumerate(true_ids):
        j = column.get(before.get(int(true), -1))
        if j is not None and np.isfinite(distance[i, j]) and j not in [k for _, k in kept]:
            kept.append((i, j))
    free_i = [i for i in range(len(true_ids)) if i not in {a for a, _ in kept}]
    free_j = [j for j in range(len(ids)) if j not in {b for _, b in kept}]
    sub = np.minimum(distance[np.ix_(free_i, free_j)], _FORBIDDEN)
    rows, columns = linear_sum_assignment(sub)
    new = [(free_i[a], free_j[b]) for a, b in zip(rows, columns, strict=True) if sub[a, b] < _FORBIDDEN]
    return kept + new


def _id_true_positives(together: dict[tuple[int, int], int]) -> int:
    if not together:
        return 0
    truths = {value: k for k, value in enumerate(sorted({a for a, _ in together}))}
    tracks = {value: k for k, value in enumerate(sorted({b for _, b in together}))}
    counts = np.zeros((len(truths), len(tracks)))
    for (a, b), count in together.items():
        counts[truths[a], tracks[b]] = count
    rows, columns = linear_sum_assignment(counts, maximize=True)
    return int(counts[rows, columns].sum())


def _iou(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    shared = np.maximum(high - low, 0).prod(axis=2)
    areas = [(boxes[:, 2:] - boxes[:, :2]).prod(axis=1) for boxes in (a, b)]
    return shared / (areas[0][:, None] + areas[1][None] - shared)
