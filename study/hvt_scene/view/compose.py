"""Laying layers over the frame, which has four channels while it is built: OpenCV warps those fastest."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from hvt_scene.view.camera import Matrix
from hvt_scene.view.project import Floats, bounds

Bgra = npt.NDArray[np.uint8]
"""(h, w, 4) uint8, premultiplied by alpha; in a frame the fourth channel means nothing."""

_SHIFT = 4


def darken(frame: Bgra, shadows_px: Floats, *, strength: float) -> None:
    """Take ``strength`` (0…1) of the light inside the hulls of (N, M, 2) points, once even where they overlap."""
    high, wide = frame.shape[:2]
    mask = np.full((high, wide), 255, np.uint8)
    left_over = 255 * (1 - strength)
    fixed = np.round((shadows_px - 0.5) * (1 << _SHIFT)).astype(np.int32)
    for points in fixed:
        cv2.fillConvexPoly(mask, cv2.convexHull(points), left_over, cv2.LINE_AA, _SHIFT)
    for x0, y0, x1, y1 in bounds(shadows_px, size=(wide, high), margin_px=1).tolist():
        if x1 > x0 and y1 > y0:
            light = mask[y0:y1, x0:x1]
            region = frame[y0:y1, x0:x1]
            region[:] = cv2.multiply(region, cv2.cvtColor(light, cv2.COLOR_GRAY2BGRA), scale=1 / 255)
            light[:] = 255  # a neighbour's overlapping region must not darken it again


def blend(frame: Bgra, box: list[int], picture: Bgra, *, matrix: Matrix, gain: float) -> None:
    """Warp a picture into the box x0 y0 x1 y1 of the frame, over what is there; ``gain`` lights its colours."""
    x0, y0, x1, y1 = box
    if x1 <= x0 or y1 <= y0:
        return
    shifted = matrix.copy()
    shifted[:, 2] -= (x0, y0)
    layer = cv2.warpAffine(picture, shifted, (x1 - x0, y1 - y0), flags=cv2.INTER_LINEAR)
    through = cv2.cvtColor(cv2.bitwise_not(cv2.extractChannel(layer, 3)), cv2.COLOR_GRAY2BGRA)
    if abs(gain - 1) > 0.02:
        layer = cv2.convertScaleAbs(layer, alpha=gain)
    region = frame[y0:y1, x0:x1]
    region[:] = cv2.add(cv2.multiply(region, through, scale=1 / 255), layer)
