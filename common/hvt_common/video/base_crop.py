"""The base frame's view of a crop of the source, at the size at which the crop is coded.

Edge and ground compute it from the same decoded picture with the same arithmetic: a residual still is the difference
to it, and a still has to be closer to the source than it. Of a picture as it was decoded it is exact
(`exact_base_crop`); of one that is already BGR it is as near, by OpenCV, for gates and for people.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.values import Image, View

if TYPE_CHECKING:  # the command line needs sizes alone, and no PyAV
    from hvt_common.video.hevc import Picture, Plane

MAX_SIDE_PX = 512
"""A longer crop is coded smaller: an object that fills 512 pixels needs no more to be classified."""
MAX_REQUESTED_SIDE_PX = 2048
"""The same of a still that a ground requested: who looks closer wants the source's own pixels."""


def coded_size(
    crop_source_px: tuple[int, int, int, int], *, max_side_px: int = MAX_SIDE_PX
) -> tuple[int, int]:
    """(width, height) at which the crop is coded: its own, or shrunk so that the longer side is ``max_side_px``."""
    width, height = crop_source_px[2] - crop_source_px[0], crop_source_px[3] - crop_source_px[1]
    shrink = max(1.0, max(width, height) / max_side_px)
    return max(1, round(width / shrink)), max(1, round(height / shrink))


def base_crop(
    picture: Picture, *, view: View, crop_source_px: tuple[int, int, int, int], size: tuple[int, int]
) -> Image:
    """The base frame's view of a crop, resampled to ``size``: the picture that a still must beat.

    The base gets its best chance: exact sub-pixel alignment, cubic where it is enlarged, area means where it is
    shrunk.
    """
    if not isinstance(picture, np.ndarray):
        planes = picture.planes
        if planes is not None:
            return exact_base_crop(planes, view=view, crop_source_px=crop_source_px, size=size)
        picture = picture.bgr()
    x1, y1, x2, y2 = crop_source_px
    origin = x1 * view.scale + view.offset_px[0], y1 * view.scale + view.offset_px[1]
    step = (x2 - x1) / size[0] * view.scale, (y2 - y1) / size[1] * view.scale
    return resampled(picture, origin, step, size)


def resampled(
    image_bgr: Image, origin_px: tuple[float, float], step_px: tuple[float, float], size: tuple[int, int]
) -> Image:
    """``size`` pixels of an image, from the corner ``origin_px`` on, ``step_px`` image pixels for each."""
    x, y = map(int, origin_px)
    same = image_bgr[y : y + size[1], x : x + size[0]]
    if step_px == (1, 1) and origin_px == (x, y) and min(x, y) >= 0 and same.shape[1::-1] == size:
        return same.copy()  # the same bytes as below, in a thirtieth of the time
    fine = max(1, math.ceil(max(step_px) - 1e-6))
    step_x, step_y = step_px[0] / fine, step_px[1] / fine
    # Pixel i covers i…i+1, hence the half pixels: boxes map by their edges, warpAffine by pixel centres.
    matrix = np.array(
        [[step_x, 0, origin_px[0] + (step_x - 1) / 2], [0, step_y, origin_px[1] + (step_y - 1) / 2]],
        np.float64,
    )
    result = cv2.warpAffine(
        image_bgr,
        matrix,
        (size[0] * fine, size[1] * fine),
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    if fine > 1:
        result = cv2.resize(result, size, interpolation=cv2.INTER_AREA)
    return np.asarray(result, np.uint8)


_ONE = 65536
"""A pixel, in the positions of samples."""
_PHASES = 32
_WEIGHT_BITS = 17
"""The four weights of a phase add up to 2^17."""
_LEVEL_BITS = 6
"""Fractional bits of a resampled level."""
_MATRIX = np.array([[76309, 138438, 0], [76309, -13975, -34925], [76309, 0, 117489]], np.float64)
"""2^16 times rows B, G, R of BT.709, columns Y, Cb, Cr, limited range."""
_OFFSETS = np.array([16, 128, 128], np.float64) * 2**_LEVEL_BITS

_Floats = npt.NDArray[np.float64]


def exact_base_crop(
    planes: tuple[Plane, Plane, Plane],
    *,
    view: View,
    crop_source_px: tuple[int, int, int, int],
    size: tuple[int, int],
) -> Image:
    """The crop at ``size`` (width, height), BGR; ``planes`` are Y (H, W), Cb and Cr (half of it, rounded up).

    In whole numbers, the same bytes on every machine, in any language: docs/wire-stills.md states the arithmetic.
    Planes are resampled to the crop's size with a cubic kernel (a = -3/4, 32 phases, the mean of several samples
    where the picture is shrunk), then turned into BGR by ITU-T BT.709, limited range.
    """
    x1, y1, x2, y2 = crop_source_px
    across = _fixed(x1 * view.scale + view.offset_px[0]), _fixed((x2 - x1) / size[0] * view.scale)
    down = _fixed(y1 * view.scale + view.offset_px[1]), _fixed((y2 - y1) / size[1] * view.scale)
    levels = [_resampled(planes[0], down, across, size)]
    # A sample of chroma lies in the middle of its four pixels: everything is half as far and half as wide.
    half_down, half_across = (down[0] >> 1, down[1] >> 1), (across[0] >> 1, across[1] >> 1)
    levels += [_resampled(plane, half_down, half_across, size) for plane in planes[1:]]
    samples = np.stack(levels, axis=-1) - _OFFSETS
    bgr = np.floor((samples @ _MATRIX.T + 2 ** (15 + _LEVEL_BITS)) / 2 ** (16 + _LEVEL_BITS))
    return np.asarray(np.clip(bgr, 0, 255), np.uint8)


def _fixed(position_px: float) -> int:
    return int(np.floor(position_px * _ONE + 0.5))


def _resampled(
    plane: Plane, down: tuple[int, int], across: tuple[int, int], size: tuple[int, int]
) -> _Floats:
    # (H, W) whole numbers, 64 a level; all sums are below 2^53, hence exact in whatever order.
    top, rows, number_down = _weights(*down, count=size[1], length=plane.shape[0])
    left, columns, number_across = _weights(*across, count=size[0], length=plane.shape[1])
    part = plane[top : top + rows.shape[1], left : left + columns.shape[1]].astype(np.float64)
    total = rows @ part @ columns.T
    whole = number_down * number_across * 2 ** (2 * _WEIGHT_BITS - _LEVEL_BITS)
    return np.asarray(np.clip(np.floor((total + whole // 2) / whole), 0, 255 * 2**_LEVEL_BITS), np.float64)


def _weights(origin: int, step: int, *, count: int, length: int) -> tuple[int, _Floats, int]:
    # First sample, each pixel's weights from it on (a row adds up to 2^17 times the count), and the count.
    number = max(1, -(-step // _ONE))
    index = np.arange(count * number, dtype=np.int64)
    middle = origin + (2 * index + 1) * step // (2 * number) - _ONE // 2
    position = (middle + _ONE // _PHASES // 2) // (_ONE // _PHASES)
    phase = position % _PHASES
    taps = np.stack(
        (
            -3 * (phase**3 - 64 * phase**2 + 1024 * phase),
            5 * phase**3 - 288 * phase**2 + 131072,
            -5 * phase**3 + 192 * phase**2 + 3072 * phase,
            3 * phase**3 - 96 * phase**2,
        ),
        axis=1,
    )
    places = np.clip((position // _PHASES)[:, None] + np.arange(-1, 3), 0, length - 1)
    first, last = int(places.min()), int(places.max())
    weights = np.zeros((count, last - first + 1))
    np.add.at(weights, (np.repeat(index // number, 4), (places - first).ravel()), taps.ravel())
    return first, weights, number
