"""Overlap of boxes, as everyone but ByteTrack measures it (`associate.overlaps` keeps that one's habit)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["iou"]


def iou(
    a_xyxy_px: npt.NDArray[np.floating[Any]], b_xyxy_px: npt.NDArray[np.floating[Any]]
) -> npt.NDArray[np.float64]:
    """Intersection over union of (N, 4) with (M, 4) boxes in one pixel space, (N, M); 0 for empty boxes."""
    a, b = np.asarray(a_xyxy_px, np.float64)[:, None, :], np.asarray(b_xyxy_px, np.float64)[None, :, :]
    shared = np.clip(np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2]), 0, None).prod(
        -1
    )
    areas_a = np.clip(a[..., 2:] - a[..., :2], 0, None).prod(-1)
    areas_b = np.clip(b[..., 2:] - b[..., :2], 0, None).prod(-1)
    union = areas_a + areas_b - shared
    return np.asarray(np.divide(shared, union, out=np.zeros_like(shared), where=union > 0), np.float64)
