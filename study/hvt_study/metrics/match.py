"""Which box belongs to which label at one tick."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from hvt_common.values import iou

__all__ = ["LEAST_IOU", "matched_rows"]

LEAST_IOU = 0.5

Floats = npt.NDArray[np.floating[Any]]


def matched_rows(
    labels_xyxy_px: Floats, shown_xyxy_px: Floats, *, least_iou: float = LEAST_IOU
) -> npt.NDArray[np.int64]:
    """Match (N, 4) labels and (M, 4) boxes one to one, whatever their classes.

    As many pairs as possible of an IoU of ``least_iou`` or more, and of those matchings the one with most overlap in
    all (Kuhn 1955, by `scipy.optimize.linear_sum_assignment`). Returns (K, 2): row of the label, row of the box, by
    row of the label.
    """
    if not len(labels_xyxy_px) or not len(shown_xyxy_px):
        return np.empty((0, 2), np.int64)
    overlap = iou(labels_xyxy_px, shown_xyxy_px)
    enough = overlap >= least_iou
    # A pair that counts is worth more than any sum of overlaps.
    value = np.where(enough, overlap + min(overlap.shape), 0.0)
    rows, columns = linear_sum_assignment(value, maximize=True)
    pairs = np.stack((rows, columns), axis=1).astype(np.int64)
    return pairs[enough[rows, columns]]
