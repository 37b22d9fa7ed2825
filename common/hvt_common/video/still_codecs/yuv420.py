"""BGR to planar Y'CbCr 4:2:0 and back, in whole numbers: ITU-R BT.601, full range; docs/wire-stills.md has it too.

Not libswscale: its default rounding shifts levels by about two, and crops of odd sizes lose a column of chroma. A
picture here is one uint8 array as FFmpeg lays out ``yuv420p``: (3/2 H, W), luma above, then Cb and Cr. H and W are
multiples of `BLOCK_PX`; what is beyond the crop repeats its last row and column.

Floats of 64 bits hold these whole numbers exactly, and multiply them faster than numpy's integers.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.values import Image

BLOCK_PX = 16
"""A macroblock of H.264; a multiple of HEVC's smallest block."""

Planar = npt.NDArray[np.uint8]
"""(3/2 H, W) uint8, the planes Y, Cb and Cr one after the other."""

_Floats = npt.NDArray[np.float64]

# 2^16 times ITU-R BT.601 with full range (JFIF), rows Y, Cb, Cr, columns B, G, R.
_FORWARD = np.array([[7471, 38470, 19595], [32768, -21709, -11059], [-5329, -27439, 32768]], np.float64)
# 2^16 times its inverse, rows B, G, R, columns Y, Cb, Cr.
_BACK = np.array([[65536, 116130, 0], [65536, -22554, -46802], [65536, 0, 91881]], np.float64)
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
    samples = cv2.transform(whole.astype(np.float64), _FORWARD)
    luma = np.floor((samples[..., 0] + 2**15) / 2**16)
    sums = samples[..., 1:].reshape(high // 2, 2, wide // 2, 2, 2).sum(axis=(1, 3))
    chroma = np.floor((sums + 2**17) / 2**18) + _GREY
    planar = np.concatenate((luma.ravel(), *chroma.reshape(-1, 2).T))
    return np.asarray(np.clip(planar, 1, 255), np.uint8).reshape(high * 3 // 2, wide)


def to_bgr(planar: Planar, *, size: tuple[int, int]) -> Image:
    """The picture again, cut to ``size`` (width, height)."""
    luma, *chroma = _planes(planar)
    samples = _bgr(luma.astype(np.float64), [plane.astype(np.float64) - _GREY for plane in chroma])
    return np.asarray(np.clip(samples[: size[1], : size[0]], 0, 255), np.uint8)


def difference_bgr(planar: Planar, other: Planar, *, size: tuple[int, int]) -> _Floats:
    """``planar - other`` as BGR, whole levels as float64 (H, W, 3), cut to ``size``; 0 where both are equal."""
    pairs = zip(_planes(planar), _planes(other), strict=True)
    luma, *chroma = (one.astype(np.float64) - two for one, two in pairs)
    return _bgr(luma, chroma)[: size[1], : size[0]]


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


def _bgr(luma: _Floats, chroma: list[_Floats]) -> _Floats:
    # Whole levels, rounded half up.
    samples = np.stack([16 * luma, *map(_enlarged, chroma)], axis=-1)
    return np.asarray(np.floor((cv2.transform(samples, _BACK) + 2**19) / 2**20), np.float64)


def _enlarged(plane: _Floats) -> _Floats:
    # 16 times the plane in twice its width and height: 3 parts of the nearest sample, 1 of the next, both ways.
    for axis in (0, 1):
        plane = np.moveaxis(plane, axis, 0)
        padded = np.concatenate((plane[:1], plane, plane[-1:]))
        twice = np.stack((3 * plane + padded[:-2], 3 * plane + padded[2:]), axis=1)
        plane = np.moveaxis(twice.reshape(-1, *plane.shape[1:]), 0, axis)
    return np.ascontiguousarray(plane)
