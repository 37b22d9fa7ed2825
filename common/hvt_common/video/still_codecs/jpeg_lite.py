"""`jpeg-lite`: JPEG without what the ground can write itself.

Headers, quantisation tables and the standard Huffman tables are some 620 bytes of every JPEG. They follow from the
quality and the size, so only the quality (one byte) and the scan cross the link. The scan's byte stuffing (a 0 behind
each 255) goes, too. The pixels are those of the same JPEG with standard tables, to the bit.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import cv2
import numpy as np

from hvt_common.values import Image
from hvt_common.video.still_codecs.contract import NO_PARAMETERS, CodedCrop, Parameters, StillError
from hvt_common.video.still_codecs.cv_still import imdecoded, imencoded

__all__ = ["JpegLiteCodec", "whole_jpeg"]

_SOF, _SOS, _EOI = b"\xff\xc0", b"\xff\xda", b"\xff\xd9"
_SIZE_AT = 5
"""Of height and width behind the start of the frame header (ITU-T T.81, B.2.2)."""


@dataclass(frozen=True, slots=True)
class JpegLiteCodec:
    """The payload is one byte with the quality, then the scan without its stuffing."""

    name: str = field(default="jpeg-lite", init=False)
    media_type: str = field(default="application/vnd.hvt.jpeg-lite", init=False)
    needs_base: bool = field(default=False, init=False)

    def encode(self, crop_bgr: Image, *, quality_pct: int, base_bgr: Image | None = None) -> CodedCrop:  # noqa: ARG002
        """Code a crop of at least one pixel."""
        jpeg = imencoded(".jpg", crop_bgr, _flags(quality_pct))
        head = _head((crop_bgr.shape[1], crop_bgr.shape[0]), quality_pct)
        assert jpeg.startswith(head), "the headers follow from quality and size"
        scan = jpeg[len(head) : -len(_EOI)].replace(b"\xff\x00", b"\xff")
        return CodedCrop(bytes([quality_pct]) + scan)

    def decode(
        self,
        data: bytes,
        *,
        size: tuple[int, int],
        parameters: Parameters = NO_PARAMETERS,  # noqa: ARG002
        base_bgr: Image | None = None,  # noqa: ARG002
    ) -> Image:
        """The crop again; the scan cannot say another size or hold another marker."""
        return imdecoded(whole_jpeg(data, size=size), size=size, what="JPEG")


def whole_jpeg(data: bytes, *, size: tuple[int, int]) -> bytes:
    """The payload as a JPEG file of ``size`` (width, height)."""
    if len(data) < 2 or not 1 <= data[0] <= 100:
        raise StillError(f"no JPEG scan in {len(data)} bytes")
    if not all(1 <= side <= 0xFFFF for side in size):
        raise StillError(f"JPEG cannot be of {size[0]}x{size[1]}")
    return _head(size, data[0]) + data[1:].replace(b"\xff", b"\xff\x00") + _EOI


def _head(size: tuple[int, int], quality_pct: int) -> bytes:
    head = _blank_head(quality_pct)
    at = head.index(_SOF) + _SIZE_AT
    return head[:at] + size[1].to_bytes(2, "big") + size[0].to_bytes(2, "big") + head[at + 4 :]


@cache
def _blank_head(quality_pct: int) -> bytes:
    """Everything up to the scan, from a picture of one block: the tables of T.81 annex K, scaled as libjpeg does."""
    jpeg = imencoded(".jpg", np.zeros((8, 8, 3), np.uint8), _flags(quality_pct))
    start = jpeg.index(_SOS)
    return jpeg[: start + 2 + int.from_bytes(jpeg[start + 2 : start + 4], "big")]


def _flags(quality_pct: int) -> list[int]:
    flags = [cv2.IMWRITE_JPEG_QUALITY, quality_pct, cv2.IMWRITE_JPEG_OPTIMIZE, 0]
    return [*flags, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
