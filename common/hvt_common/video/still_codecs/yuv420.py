"""BGR to planar Y'CbCr 4:2:0 and back, in whole numbers: ITU-R BT.601, full range; docs/wire-stills.md has it too.

Not libswscale: its default rounding shifts levels by about two, and crops of odd sizes lose a column of chroma. A
picture here is one uint8 array as FFmpeg lays out ``yuv420p``: (3/2 H, W), luma above, then Cb and Cr. H and W are
multiples of `BLOCK_PX`; samples beyond the crop repeat its last row and column.
"""

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.values import Image

BLOCK_PX = 16
"""A macroblock of H.264; a multiple of HEVC's smallest block."""

Planar = npt.NDArray[np.uint8]
"""(3/2 H, W) uint8, the planes Y, Cb and Cr one after the other."""

_Whole = npt.NDArray[np.int32]
"""Levels, their differences and sums; no product below leaves its range."""

# 2^16 times ITU-R BT.601 with full range (JFIF), each of B, G, R.
_LUMA = 7471, 38470, 19595
_CHROMA = (32768, -21709, -11059), (-5329, -27439, 32768)
_GREY = 128


def padded_size(size: tuple[int, int]) -> tuple[int, int]:
    """(width, height) grown to whole blocks."""
    width, height = (-(-side // BLOCK_PX) * BLOCK_PX for side in size)
    return width, height


def to_planar(image_bgr: Image) -> Planar:
    """The picture in its `padded_size`. No sample is 0, so that H.264 can carry it verbatim without escapes."""
    height, width = image_bgr.shape[:2]
    wide, high = padded_size((width, height))
    # Repeated before the chroma is halved: a last odd column then counts twice, not with black.
    whole = cv2.copyMakeBorder(image_bgr, 0, high - height, 0, wide - width, cv2.BORDER_REPLICATE)
    channels = [channel.astype(np.int32) for channel in cv2.split(whole)]
    planar = np.empty((high * 3 // 2, wide), np.uint8)
    luma, *chroma = _planes(planar)
    luma[:] = np.maximum(_weighted(channels, _LUMA) + 2**15 >> 16, 1)
    sums = [pairs[:, ::2] + pairs[:, 1::2] for pairs in (one[::2] + one[1::2] for one in channels)]
    for plane, weights in zip(chroma, _CHROMA, strict=True):
        plane[:] = np.clip((_weighted(sums, weights) + 2**17 >> 18) + _GREY, 1, 255)
    return planar


def _weighted(channels: Sequence[_Whole], weights: tuple[int, int, int]) -> _Whole:
    blue, green, red = (one * weight for one, weight in zip(channels, weights, strict=True))
    return blue + green + red


def to_bgr(planar: Planar, *, size: tuple[int, int]) -> Image:
    """The picture again, cut to ``size`` (width, height)."""
    luma, *chroma = (plane.astype(np.int32) for plane in _planes(planar))
    samples = _bgr(luma, *(plane - _GREY for plane in chroma), size=size)
    return np.asarray(np.clip(samples, 0, 255), np.uint8)


def difference_bgr(planar: Planar, other: Planar, *, size: tuple[int, int]) -> _Whole:
    """``planar - other`` as BGR, (H, W, 3) in levels, cut to ``size``; 0 where both are equal."""
    pairs = zip(_planes(planar), _planes(other), strict=True)
    return _bgr(*(np.subtract(one, two, dtype=np.int32) for one, two in pairs), size=size)


def filled_outside(planar: Planar, filling: Planar, *, size: tuple[int, int]) -> Planar:
    """``planar`` inside ``size`` (width, height), ``filling`` in the rest of the blocks."""
    result = filling.copy()
    for into, plane, part in zip(_planes(result), _planes(planar), (1, 2, 2), strict=True):
        rows, columns = -(-size[1] // part), -(-size[0] // part)
        into[:rows, :columns] = plane[:rows, :columns]
    return result


def _planes(planar: Planar) -> tuple[Planar, Planar, Planar]:
    # Views of Y (H, W), Cb and Cr (H/2, W/2).
    wide, high = planar.shape[1], planar.shape[0] * 2 // 3
    chroma = planar[high:].reshape(2, high // 2, wide // 2)
    return planar[:high], chroma[0], chroma[1]


def _bgr(luma: _Whole, cb: _Whole, cr: _Whole, *, size: tuple[int, int]) -> _Whole:
    # Rounded half up: the inverse of the above, 2^16 times, of 16 times the levels.
    wide, high = size
    y, cb, cr = (one[:high, :wide] for one in ((luma << 20) + 2**19, _enlarged(cb), _enlarged(cr)))
    bgr = (y + 116130 * cb) >> 20, (y - 22554 * cb - 46802 * cr) >> 20, (y + 91881 * cr) >> 20
    return np.asarray(cv2.merge(bgr), np.int32)


def _enlarged(plane: _Whole) -> _Whole:
    # 16 times the plane in twice its width and height: 3 parts of the nearest sample, 1 of the next, both ways.
    for _ in range(2):
        padded = np.concatenate((plane[:1], plane, plane[-1:]))
        twice = np.empty((2 * plane.shape[0], plane.shape[1]), np.int32)
        twice[::2], twice[1::2] = 3 * plane + padded[:-2], 3 * plane + padded[2:]
        plane = twice.T
    return plane
