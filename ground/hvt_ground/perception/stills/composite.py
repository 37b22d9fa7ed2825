"""The base picture with the sharp stills in their places.

Crops map to base pixels by `View`, which is affine, so a still is pasted with sub-pixel alignment: boxes map by
their edges, `cv2.warpAffine` by pixel centres. The picture may also be made larger than the base (``zoom``), for a
network whose input is: it would enlarge the base itself, and the stills have the detail that the base has not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from hvt_common.values import Image, View
from hvt_common.video.base_crop import resampled
from hvt_ground.perception.stills.decode import DecodedStill

_FEATHER_PX = 1.5
"""Width of the seam in pixels of the result. A detector takes a hard edge for a contour."""


def composite(base_bgr: Image, stills: Sequence[DecodedStill], *, view: View, zoom: float = 1.0) -> Image:
    """The base picture with each still in its place, ``zoom`` times as large as the base; a copy.

    Later stills lie over earlier ones. Cubic where it is enlarged, area means where it is shrunk.
    """
    if zoom == 1:
        picture = base_bgr.copy()
    else:
        height, width = base_bgr.shape[:2]
        size = (max(1, round(width * zoom)), max(1, round(height * zoom)))
        picture = resampled(base_bgr, (0.0, 0.0), (1 / zoom, 1 / zoom), size)
    for still in stills:
        _paste(picture, still, view, zoom)
    return picture


def _paste(picture: Image, still: DecodedStill, view: View, zoom: float) -> None:
    offset = view.offset_px * 2
    x1, y1, x2, y2 = (
        (edge * view.scale + offset[axis]) * zoom for axis, edge in enumerate(still.crop_source_px)
    )
    left, top = max(0, math.floor(x1)), max(0, math.floor(y1))
    right, bottom = min(picture.shape[1], math.ceil(x2)), min(picture.shape[0], math.ceil(y2))
    if right <= left or bottom <= top:
        return
    still_height, still_width = still.image_bgr.shape[:2]
    step_x, step_y = still_width / (x2 - x1), still_height / (y2 - y1)
    origin = ((left - x1) * step_x, (top - y1) * step_y)
    image = resampled(still.image_bgr, origin, (step_x, step_y), (right - left, bottom - top))
    across = _coverage(np.arange(left, right) + 0.5, x1, x2)
    down = _coverage(np.arange(top, bottom) + 0.5, y1, y2)
    opacity = np.outer(down, across).astype(np.float32)[..., None]
    place = picture[top:bottom, left:right]
    np.copyto(place, np.rint(place * (1 - opacity) + image * opacity).astype(np.uint8))


def _coverage(centres: npt.NDArray[np.floating[Any]], first: float, last: float) -> npt.NDArray[np.float64]:
    # How much each pixel of a line shows of the interval ``first``…``last``, rising over the feather.
    depth = np.minimum(centres - first, last - centres) + 0.5
    return np.asarray(np.clip(depth / _FEATHER_PX, 0, 1), np.float64)
