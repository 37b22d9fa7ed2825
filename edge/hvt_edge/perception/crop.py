"""The crop of a still: the padded box in the source frame, and what the base stream lost in it.

The edge decodes its own stream, so it knows exactly what the ground sees. The gate sends no still where nothing was
lost, and M6 asks first for what lost most.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from hvt_common.values import Image

PADDING = 0.15
"""Share of the box's width and height that is added on each side (the pilot's setting)."""
MIN_SIDE_PX = 8
"""No crop is narrower or lower than one JPEG block."""
MOST_PSNR_DB = 99.0
"""Said of identical crops, where the formula has no finite value."""
_BT601 = np.array([[0.114, 0.587, 0.299]], np.float32)
_DETAIL_SIDE_PX = 224
"""Classifiers see no more pixels than that; finer detail than theirs is nobody's loss."""
_NOISE_ENERGY = 20.0
"""Energy of the Laplacian (0 1 0, 1 -4 1, 0 1 0) of noise of one grey level, 4 · 1 + 16: less is no detail."""


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


@dataclass(frozen=True, slots=True)
class BaseLoss:
    """The loss of a crop in the base against the source."""

    psnr_y_db: float
    """Luma PSNR of the base crop against the source crop; at most `MOST_PSNR_DB`."""
    detail_lost: float
    """0…1: the share of the source's detail that the base does not show; see `measure_loss`."""


def measure_loss(source_crop: Image, base_crop: Image) -> BaseLoss:
    """Compare two uint8 BGR crops of one size, at least 1x1: the source's and the base's.

    With ``S`` and ``B`` the Laplacians of both lumas (BT.601), ``detail_lost = sum(S (S - B)) / (sum(S S) + noise)``:
    0 where the base has all edges of the source, 1 where it has none of them, 0.5 where it has them at half their
    contrast. What the base adds (ringing, blocks) is no loss of detail; it is in the PSNR. A crop without detail
    loses none: noise of one grey level stands in the denominator. A longer side is brought to 224 pixels first
    (area means). 0.03 ms for 64x64 pixels, 0.5 ms for 256x256.
    """
    assert source_crop.shape == base_crop.shape, "both crops have one size"
    # Luma of the difference, not difference of the lumas: rounded to bytes these would be off by up to 5 %.
    luma = cv2.transform(source_crop.astype(np.float32), _BT601)
    lost = cv2.transform(cv2.subtract(source_crop, base_crop, dtype=cv2.CV_32F), _BT601)
    error = float(np.mean(np.square(lost), dtype=np.float64))
    psnr_y_db = MOST_PSNR_DB if error == 0 else min(MOST_PSNR_DB, 10 * math.log10(255**2 / error))
    had, missing = _detail(luma), _detail(lost)
    share = cv2.mean(had * missing)[0] / (cv2.mean(had * had)[0] + _NOISE_ENERGY)
    return BaseLoss(psnr_y_db=psnr_y_db, detail_lost=min(1.0, max(0.0, share)))


def _detail(luma: cv2.typing.MatLike) -> cv2.typing.MatLike:
    # The Laplacian, at the size at which it counts.
    shrink = max(luma.shape[:2]) / _DETAIL_SIDE_PX
    if shrink > 1:
        size = (max(1, round(luma.shape[1] / shrink)), max(1, round(luma.shape[0] / shrink)))
        luma = cv2.resize(luma, size, interpolation=cv2.INTER_AREA)
    return cv2.Laplacian(luma, cv2.CV_32F)
