"""Pictures of a few pixels, made large enough for print without a new one being thought up."""

from __future__ import annotations

import cv2
import numpy as np

__all__ = ["enlarged", "is_picture"]


def is_picture(png: bytes) -> bool:
    """Whether it can be decoded."""
    return bool(png) and cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR) is not None


def enlarged(png: bytes, *, least_px: int) -> bytes:
    """The PNG by the least whole factor that makes its longer side ``least_px``: every pixel becomes a square.

    Readers of papers and Markdown smooth what they enlarge themselves.
    """
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None, "pictures are looked at where they are read"
    factor = -(-least_px // max(image.shape[:2]))
    large = image.repeat(factor, axis=0).repeat(factor, axis=1)
    done, data = cv2.imencode(".png", large)
    assert done, "it has pixels"
    return data.tobytes()
