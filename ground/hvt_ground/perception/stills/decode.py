"""From a still as it came to a picture: undone by its codec, on the base frame where it builds on one."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.protocol.messages import MAX_STILL_CODECS, RoiHeader
from hvt_common.values import Image, View
from hvt_common.video.base_crop import MAX_REQUESTED_SIDE_PX, MAX_SIDE_PX, base_crop
from hvt_common.video.hevc import Picture
from hvt_common.video.still_codecs import BaseMissingError, StillError, still_codec, still_codec_names

_MOST_BASE_PX = 32
"""Limit of a side for one pixel of a still: a stranger's `Info` may say any scale, and each of them costs memory."""

Box = tuple[float, float, float, float]
"""x1 y1 x2 y2."""


@dataclass(frozen=True, slots=True)
class ReceivedStill:
    """A still as it came, its header checked."""

    header: RoiHeader
    data: bytes


@dataclass(frozen=True, slots=True)
class DecodedStill:
    """A decoded still and where it belongs."""

    image_bgr: Image
    crop_source_px: tuple[int, int, int, int]
    boxes_base_px: tuple[Box, ...]
    """The lead object's box, then those of the others, in the order of the header's ``also``."""
    frame_index: int


def box_of(row: npt.NDArray[np.float32]) -> Box:
    """An array of (4,) as a value."""
    x1, y1, x2, y2 = row.tolist()
    return x1, y1, x2, y2


def readable_codecs() -> tuple[str, ...]:
    """Names of the codecs whose stills can be read here, as `InfoRequest` takes them; HVT's own come first."""
    return tuple(name for name in still_codec_names() if re.fullmatch(r"[a-z0-9-]{1,24}", name))[
        :MAX_STILL_CODECS
    ]


def needs_base(header: RoiHeader) -> bool:
    """Whether the still builds on the decoded base frame of its own index; False for a codec that is not known."""
    try:
        return still_codec(header.codec).needs_base
    except UserError:
        return False


def decode_still(still: ReceivedStill, *, base: Picture | None, view: View) -> Image:
    """The crop at the size at which it was coded, BGR.

    ``base`` is the decoded base frame of the still's own index, None where it is not at hand; only codecs that
    need it use it.

    Raises:
        BaseMissingError: the still builds on a base frame that is not at hand, or not the one that the edge had.
        StillError: it cannot be decoded, whatever the base; also a codec that is not known.
    """
    header = still.header
    size = coded_size(header, view=view)
    try:
        codec = still_codec(header.codec)
    except UserError as error:
        raise StillError(str(error)) from None
    if not codec.needs_base:
        return codec.decode(still.data, size=size, parameters=header.parameters)
    x1, y1, x2, y2 = header.crop_source_px
    if max((x2 - x1) / size[0], (y2 - y1) / size[1]) * view.scale > _MOST_BASE_PX:
        raise StillError(f"size {size[0]}x{size[1]} is far smaller than what the base shows of it")
    if base is None:
        raise BaseMissingError(f"it builds on frame {header.frame_index}, which is not at hand")
    crop = base_crop(base, view=view, crop_source_px=header.crop_source_px, size=size)
    return codec.decode(still.data, size=size, parameters=header.parameters, base_bgr=crop)


def coded_size(header: RoiHeader, *, view: View) -> tuple[int, int]:
    """(width, height) as announced. A still may be shrunk, never be larger than its area in the source."""
    x1, y1, x2, y2 = header.crop_source_px
    size = header.parameters.get("w", x2 - x1), header.parameters.get("h", y2 - y1)
    inside = x2 <= view.source_size[0] and y2 <= view.source_size[1]
    width, height = size
    if not (inside and isinstance(width, int) and isinstance(height, int)):
        raise StillError(f"crop {header.crop_source_px} is not of this source")
    if not (0 < width <= x2 - x1 and 0 < height <= y2 - y1):
        raise StillError(f"size {width}x{height} is larger than what it shows")
    if abs(width * (y2 - y1) - height * (x2 - x1)) > max(x2 - x1, y2 - y1):
        # Both sides are shrunk by one factor, each rounded to a pixel. A needle of a picture would cost the base
        # crop the area of the whole frame for each of its pixels.
        raise StillError(f"size {width}x{height} is not the shape of what it shows")
    most = MAX_REQUESTED_SIDE_PX if "ask" in header.parameters else MAX_SIDE_PX
    if max(width, height) > most:
        raise StillError(f"size {width}x{height} is larger than such a still, whose sides are up to {most}")
    return width, height
