"""The quality at which a crop is coded, found by trying: what fits so many bytes, or what reaches so many dB.

By bisection over the quality, at most seven encodings each. Codecs promise no exact order, only that more quality is
no worse and nearly always more bytes; what is returned was tried, so it fits, or reaches, in any case.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from hvt_common.values import Image
from hvt_common.video.still_codecs.contract import CodedCrop, StillCodec

_BT601_BGR = np.array([[0.114, 0.587, 0.299]], np.float32)


def best_fitting(
    codec: StillCodec,
    crop_bgr: Image,
    *,
    limit_bytes: int,
    low_pct: int,
    high_pct: int,
    base_bgr: Image | None = None,
) -> tuple[CodedCrop, int] | None:
    """The best quality from ``low_pct`` to ``high_pct`` (both included) whose data is at most ``limit_bytes``.

    With that quality in percent; None where nothing fits. ``base_bgr``: see `StillCodec.encode`.
    """
    best = None
    middle = high_pct  # most often it fits at once
    while low_pct <= high_pct:
        coded = codec.encode(crop_bgr, quality_pct=middle, base_bgr=base_bgr)
        if len(coded.data) <= limit_bytes:
            best, low_pct = (coded, middle), middle + 1
        else:
            high_pct = middle - 1
        middle = (low_pct + high_pct + 1) // 2
    return best


def smallest_reaching(
    codec: StillCodec,
    crop_bgr: Image,
    *,
    target_db: float,
    low_pct: int,
    high_pct: int,
    base_bgr: Image | None = None,
) -> tuple[CodedCrop, int, Image, float] | None:
    """The least quality from ``low_pct`` to ``high_pct`` (both included) whose Y-PSNR is at least ``target_db``.

    With that quality in percent, the picture as the ground will see it (BGR, the crop's size), and its Y-PSNR in dB;
    None where the best does not reach it.
    """
    size = (crop_bgr.shape[1], crop_bgr.shape[0])
    best = None
    while low_pct <= high_pct:
        middle = (low_pct + high_pct) // 2
        coded = codec.encode(crop_bgr, quality_pct=middle, base_bgr=base_bgr)
        image = codec.decode(coded.data, size=size, parameters=coded.parameters, base_bgr=base_bgr)
        reached_db = psnr_y_db(image, crop_bgr)
        if reached_db >= target_db:
            best, high_pct = (coded, middle, image, reached_db), middle - 1
        else:
            low_pct = middle + 1
    return best


def psnr_y_db(image_bgr: Image, source_bgr: Image) -> float:
    """PSNR of the luma of the difference (BT.601, full range), in dB; infinite where there is none."""
    # Not the difference of two lumas: rounded to bytes these would be off by up to 5 %.
    luma = cv2.transform(cv2.subtract(image_bgr, source_bgr, dtype=cv2.CV_32F), _BT601_BGR)
    error = cv2.norm(luma, cv2.NORM_L2SQR) / luma.size
    return 10 * math.log10(255**2 / error) if error else math.inf
