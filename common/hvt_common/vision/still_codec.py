"""Still codecs behind one small contract: a crop to bytes at the edge, the bytes back to a crop at the ground.

A codec is a frozen value without state. Its ``decode`` is fed by the network, so it looks at the dimensions in the
header before it decodes a single block, and answers anything it does not like with `StillError`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Protocol

import cv2
import numpy as np

from hvt_common.errors import UserError
from hvt_common.values import Image

__all__ = ["STILL_CODECS", "JpegCodec", "StillCodec", "StillError", "jpeg_size", "still_codec"]

_SOI, _EOI, _SOS = 0xD8, 0xD9, 0xDA
# Baseline and extended sequential Huffman. Progressive (C2) is refused: every scan runs over the whole picture, so
# a few kilobytes can buy minutes of decoding; on crops of this size it is also 18 % larger.
_SEQUENTIAL = (0xC0, 0xC1)
_FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_STANDALONE = frozenset({0x01, *range(0xD0, 0xD8)})


class StillError(Exception):
    """A still that cannot be decoded: truncated, of another format than announced, or larger than allowed."""


class StillCodec(Protocol):
    """What the edge and the ground ask of a codec."""

    @property
    def name(self) -> str:
        """The word on the wire, ``[a-z0-9-]``."""
        ...

    @property
    def media_type(self) -> str:
        """``image/jpeg`` and the like; also the Zenoh encoding of the payload."""
        ...

    def encode(self, crop_bgr: Image, *, quality_pct: int) -> bytes:
        """Code a crop; ``quality_pct`` runs from 1 (smallest) to 100 (best), as the codec understands it."""
        ...

    def decode(self, data: bytes, *, max_pixels: int) -> Image:
        """The crop again, BGR. Raises `StillError` for anything hostile, before it costs more than ``max_pixels``."""
        ...


@dataclass(frozen=True, slots=True)
class JpegCodec:
    """Baseline JPEG, 4:2:0, with Huffman tables made for the picture: the paper's setting.

    OpenCV with ``OPTIMIZE`` writes what Pillow writes with ``optimize=True`` at the same quality, to the byte count.
    """

    name: str = field(default="jpeg", init=False)
    media_type: str = field(default="image/jpeg", init=False)

    def encode(self, crop_bgr: Image, *, quality_pct: int) -> bytes:
        """Code a crop of at least one pixel."""
        flags = [cv2.IMWRITE_JPEG_QUALITY, quality_pct, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
        flags += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
        done, data = cv2.imencode(".jpg", crop_bgr, flags)
        if not done:
            raise RuntimeError(f"JPEG encoder refused a crop of shape {crop_bgr.shape}")
        return data.tobytes()

    def decode(self, data: bytes, *, max_pixels: int) -> Image:
        """The crop again; an EXIF orientation is ignored, so that the size is the one in the header."""
        width, height = jpeg_size(data)
        if width * height > max_pixels:
            raise StillError(f"JPEG of {width}x{height} has more than {max_pixels} pixels")
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error as error:
            raise StillError(f"JPEG does not decode: {error.err}") from error
        if image is None or image.shape != (height, width, 3):
            raise StillError(f"JPEG of {width}x{height} does not decode")
        return np.asarray(image, np.uint8)


def jpeg_size(data: bytes) -> tuple[int, int]:
    """(width, height) from the frame header of a whole sequential JPEG (ITU-T T.81, annex B); else `StillError`."""
    if len(data) < 4 or data[0] != 0xFF or data[1] != _SOI:
        raise StillError("not a JPEG: no start of image")
    if data[-2:] != bytes((0xFF, _EOI)):
        raise StillError("JPEG is truncated: no end of image")
    position, size = 2, None
    while position + 4 <= len(data):
        if data[position] != 0xFF:
            raise StillError(f"JPEG is malformed: no marker at byte {position}")
        marker = data[position + 1]
        if marker == 0xFF or marker in _STANDALONE:
            position += 1 if marker == 0xFF else 2
            continue
        if marker == _SOS and size is not None:
            return size
        length = int.from_bytes(data[position + 2 : position + 4], "big")
        if marker in (_SOS, _EOI) or length < 2 or position + 2 + length > len(data):
            break
        if marker in _FRAME_HEADERS:
            if size is not None:
                raise StillError("JPEG is malformed: two frame headers")
            size = _frame_size(marker, data[position + 4 : position + 2 + length])
        position += 2 + length
    raise StillError("JPEG is malformed: no scan after a frame header")


def _frame_size(marker: int, header: bytes) -> tuple[int, int]:
    if marker not in _SEQUENTIAL:
        raise StillError(f"JPEG of kind SOF{marker - 0xC0} is not accepted, only baseline and sequential")
    if len(header) < 6 or header[0] != 8 or header[5] not in (1, 3):
        raise StillError("JPEG is not 8 bits deep with 1 or 3 components")
    height, width = int.from_bytes(header[1:3], "big"), int.from_bytes(header[3:5], "big")
    if not width or not height:
        raise StillError(f"JPEG of {width}x{height} has no pixels")
    return width, height


STILL_CODECS: Mapping[str, StillCodec] = MappingProxyType({codec.name: codec for codec in (JpegCodec(),)})
"""Every codec by its name on the wire."""


def still_codec(name: str) -> StillCodec:
    """The codec of that name; `UserError` names those there are."""
    codec = STILL_CODECS.get(name)
    if codec is None:
        raise UserError(f"still codec {name!r} is not known: choose one of {', '.join(STILL_CODECS)}")
    return codec
