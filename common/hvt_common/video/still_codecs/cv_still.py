"""OpenCV's picture codecs, with their failures as this package says them."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from hvt_common.values import Image
from hvt_common.video.still_codecs.contract import StillError


def imencoded(ending: str, image_bgr: Image, flags: Sequence[int]) -> bytes:
    """The picture as a file; RuntimeError where the encoder refuses, which no crop makes it do."""
    done, data = cv2.imencode(ending, image_bgr, flags)
    if not done:
        raise RuntimeError(f"{ending} encoder refused a crop of shape {image_bgr.shape}")
    return data.tobytes()


def imdecoded(data: bytes, *, size: tuple[int, int], what: str) -> Image:
    """BGR of ``size``; an EXIF orientation is ignored.

    The caller has checked the header; `StillError` for what is wrong behind it.
    """
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    # It would write a line for each broken picture, and a flood of them would fill the log.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise StillError(f"{what} does not decode: {error.err}") from error
    if image is None or image.shape != (size[1], size[0], 3):
        raise StillError(f"{what} of {size[0]}x{size[1]} does not decode")
    return np.asarray(image, np.uint8)
