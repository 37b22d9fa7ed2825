"""Where a still is cut: the padded box, the size it is coded at, and what the base shows of the same place."""

from __future__ import annotations

import math

import cv2
import numpy as np

from hvt_common.values import Image, View

__all__ = ["MAX_SIDE_PX", "MIN_SIDE_PX", "PADDING", "base_crop", "coded_size", "crop_box"]

PADDING = 0.15
"""Share of the box's width and height that is added on each side (the pilot's setting)."""
MIN_SIDE_PX = 8
"""No crop is narrower or lower than one JPEG block."""
MAX_SIDE_PX = 512
"""A longer crop is coded smaller: an object that fills 512 pixels needs no more to be told apart."""


def crop_box(
    box_source_px: tuple[float, float, float, float], *, padding: float, source_size: tuple[int, int]
) -> tuple[int, int, int, int]:
    """The padded box in whole source pixels, grown to `MIN_SIDE_PX` and kept inside the frame.

    Rounded outwards, so that no pixel of the box is lost. A source smaller than `MIN_SIDE_PX` gives its whole side.
    """
    x1, x2 = _span(box_source_px[0], box_source_px[2], padding=padding, limit=source_size[0])
    y1, y2 = _span(box_source_px[1], box_source_px[3], padding=padding, limit=source_size[1])
    return x1, y1, x2, y2


def _span(low: float, high: float, *, padding: float, limit: int) -> tuple[int, int]:
    margin = max(0.0, high - low) * padding
    start = min(max(0, math.floor(low - margin)), limit)
    end = max(min(limit, math.ceil(high + margin)), 0)
    short = min(MIN_SIDE_PX, limit) - (end - start)
    if short > 0:
        start = min(max(0, start - (short + 1) // 2), limit - min(MIN_SIDE_PX, limit))
        end = max(end, start + min(MIN_SIDE_PX, limit))
    return start, end


def coded_size(
    crop_source_px: tuple[int, int, int, int], *, max_side_px: int = MAX_SIDE_PX
) -> tuple[int, int]:
    """(width, height) at which the crop is coded: its own, or shrunk so that the longer side is ``max_side_px``."""
    width, height = crop_source_px[2] - crop_source_px[0], crop_source_px[3] - crop_source_px[1]
    shrink = max(1.0, max(width, height) / max_side_px)
    return max(1, round(width / shrink)), max(1, round(height / shrink))


def base_crop(
    base_bgr: Image, *, view: View, crop_source_px: tuple[int, int, int, int], size: tuple[int, int]
) -> Image:
    """What the base frame shows of a crop, resampled to ``size``: the picture that a still must beat.

    The base gets its best chance: exact sub-pixel alignment, cubic where it is enlarged, area means where it is
    shrunk.
    """
    x1, y1, x2, y2 = crop_source_px
    step_x, step_y = (x2 - x1) / size[0] * view.scale, (y2 - y1) / size[1] * view.scale
    fine = max(1, math.ceil(max(step_x, step_y) - 1e-6))
    step_x, step_y = step_x / fine, step_y / fine
    # Pixel i covers i…i+1, hence the half pixels: boxes map by their edges, warpAffine by pixel centres.
    matrix = np.array(
        [
            [step_x, 0, x1 * view.scale + view.offset_px[0] + (step_x - 1) / 2],
            [0, step_y, y1 * view.scale + view.offset_px[1] + (step_y - 1) / 2],
        ],
        np.float64,
    )
    crop = cv2.warpAffine(
        base_bgr,
        matrix,
        (size[0] * fine, size[1] * fine),
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    if fine > 1:
        crop = cv2.resize(crop, size, interpolation=cv2.INTER_AREA)
    return np.asarray(crop, np.uint8)
