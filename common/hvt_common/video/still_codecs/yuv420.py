"""BGR to planar Y'CbCr 4:2:0 and back, in float: BT.601, full range.

Not libswscale: its default rounding shifts levels by about two, and crops of odd sizes lose a column of chroma. A
picture here is one uint8 array as FFmpeg lays out ``yuv420p``: (3/2 H, W), luma above, then Cb and Cr. H and W are
multiples of `BLOCK_PX`; what is beyond the crop repeats its last row and column.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.values import Image

__all__ = ["BLOCK_PX", "Planar", "difference_bgr", "filled_outside", "padded_size", "to_bgr", "to_planar"]

BLOCK_PX = 16
"""A macroblock of H.264; a multiple of HEVC's smallest block."""

Planar = npt.NDArray[np.uint8]
"""(3/2 H, W) uint8, the planes Y, Cb and Cr one after the other."""

_Floats = npt.NDArray[np.float32]

# ITU-R BT.601 with full range (JFIF), rows Y, Cb, Cr, columns B, G, R.
_FORWARD = np.array(
    [[0.114, 0.587, 0.299], [0.5, -0.331264, -0.168736], [-0.081312, -0.418688, 0.5]], np.float32
)
# Rows B, G, R, columns Y, Cb, Cr.
_BACK = np.array([[1, 1.772, 0], [1, -0.344136, -0.714136], [1, 0, 1.402]], np.float32)
_GREY = 128


def padded_size(size: tuple[int, int], *, least_px: int = BLOCK_PX) -> tuple[int, int]:
    """(width, height) grown to whole blocks, and to ``least_px`` (a multiple of them) on each side."""
    width, height = (max(least_px, -(-side // BLOCK_PX) * BLOCK_PX) for side in size)
    return width, height


def to_planar(image_bgr: Image, *, least_px: int = BLOCK_PX) -> Planar:
    """The picture in its `padded_size`. No sample is 0, so that H.264 can carry it verbatim without escapes."""
    height, width = image_bgr.shape[:2]
    wide, high = padded_size((width, height), least_px=least_px)
    # Repeated before the chroma is halved: a last odd column then counts twice, not with black.
    whole = cv2.copyMakeBorder(image_bgr, 0, high - height, 0, wide - width, cv2.BORDER_REPLICATE)
    samples = cv2.transform(whole.astype(np.float32), _FORWARD)
    chroma = cv2.resize(samples[..., 1:], (wide // 2, high // 2), interpolation=cv2.INTER_AREA)
    planar = np.concatenate((samples[..., 0].ravel(), *(chroma.reshape(-1, 2) + _GREY).T))
    return np.asarray(np.clip(np.rint(planar), 1, 255), np.uint8).reshape(high * 3 // 2, wide)


def to_bgr(planar: Planar, *, size: tuple[int, int]) -> Image:
    """The picture again, cut to ``size`` (width, height)."""
    luma, *chroma = _planes(planar)
    samples = _bgr(luma.astype(np.float32), [plane.astype(np.float32) - _GREY for plane in chroma])
    return np.asarray(np.clip(np.rint(samples[: size[1], : size[0]]), 0, 255), np.uint8)


def difference_bgr(planar: Planar, other: Planar, *, size: tuple[int, int]) -> _Floats:
    """``planar - other`` as BGR, float32 (H, W, 3), cut to ``size``; exactly 0 where both are equal."""
    pairs = zip(_planes(planar), _planes(other), strict=True)
    luma, *chroma = (one.astype(np.float32) - two for one, two in pairs)
    return _bgr(luma, chroma)[: size[1], : size[0]]


def filled_outside(planar: Planar, filling: Planar, *, size: tuple[int, int]) -> Planar:
    """``planar`` inside ``size`` (width, height), ``filling`` in the rest of the blocks."""
    result = filling.copy()
    for into, plane, part in zip(_planes(result), _planes(planar), (1, 2, 2), strict=True):
        rows, columns = -(-size[1] // part), -(-size[0] // part)
        into[:rows, :columns] = plane[:rows, :columns]
    return result


def _planes(planar: Planar) -> tuple[Planar, Planar, Planar]:
    """Views of Y (H, W), Cb and Cr (H/2, W/2)."""
    wide, high = planar.shape[1], planar.shape[0] * 2 // 3
    chroma = planar[high:].reshape(2, high // 2, wide // 2)
    return planar[:high], chroma[0], chroma[1]


def _bgr(luma: _Floats, chroma: list[_Floats]) -> _Floats:
    wide, high = luma.shape[1], luma.shape[0]
    fine = [cv2.resize(plane, (wide, high), interpolation=cv2.INTER_LINEAR) for plane in chroma]
    return np.asarray(cv2.transform(cv2.merge([luma, *fine]), _BACK), np.float32)
