"""The base frame's view of a crop of the source, at the size at which the crop is coded.

Edge and ground compute it from the same decoded picture with the same arithmetic: a residual still is the difference
to it, and a still has to be closer to the source than it. Of a picture as it was decoded it is exact (`exact_crop`);
of one that is already BGR it is as near, by OpenCV, for gates and for people.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from hvt_common.values import Image, View
from hvt_common.video.exact_crop import exact_base_crop
from hvt_common.video.hevc import YuvPicture

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
    picture: Image | YuvPicture,
    *,
    view: View,
    crop_source_px: tuple[int, int, int, int],
    size: tuple[int, int],
) -> Image:
    """The base frame's view of a crop, resampled to ``size``: the picture that a still must beat.

    The base gets its best chance: exact sub-pixel alignment, cubic where it is enlarged, area means where it is
    shrunk.
    """
    if isinstance(picture, YuvPicture):
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
