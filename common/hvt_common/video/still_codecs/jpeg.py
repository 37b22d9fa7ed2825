"""Baseline JPEG: the paper's still."""

import re

import cv2

from hvt_common.values import Image
from hvt_common.video.still_codecs.contract import IntraCodec, StillError, imdecoded, imencoded

_SOI, _EOI, _SOS = 0xD8, 0xD9, 0xDA
# Baseline and extended sequential Huffman. Progressive (C2) is refused: every scan runs over the whole picture, so
# a few kilobytes can buy minutes of decoding; on crops of this size it is also 18 % larger.
_SEQUENTIAL = (0xC0, 0xC1)
_FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_STANDALONE = frozenset({0x01, *range(0xD0, 0xD8)})
_MARKER_IN_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
"""Whatever ends a scan: stuffing, restarts and fill bytes do not."""


class JpegCodec(IntraCodec):
    """Baseline JPEG, 4:2:0, with Huffman tables made for the picture: the paper's setting.

    OpenCV with ``OPTIMIZE`` writes as many bytes as Pillow with ``optimize=True`` at the same quality.
    """

    name = "jpeg"
    media_type = "image/jpeg"

    def _encoded(self, crop_bgr: Image, quality_pct: int) -> bytes:
        flags = [cv2.IMWRITE_JPEG_QUALITY, quality_pct, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
        flags += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
        return imencoded(".jpg", crop_bgr, flags)

    def _decoded(self, data: bytes, size: tuple[int, int]) -> Image:
        width, height = jpeg_size(data)
        if (width, height) != size:
            raise StillError(f"JPEG of {width}x{height} in place of {size[0]}x{size[1]}")
        return imdecoded(data, size=size, what="JPEG")


def jpeg_size(data: bytes) -> tuple[int, int]:
    """(width, height) from the frame header of a whole sequential JPEG (ITU-T T.81, annex B); else `StillError`.

    All components have to be in one scan, and it is the only one: each further scan of ten bytes would run over the
    whole picture again (four megabytes of them took seven seconds).
    """
    if len(data) < 4 or data[0] != 0xFF or data[1] != _SOI:
        raise StillError("not a JPEG: no start of image")
    if data[-2:] != bytes((0xFF, _EOI)):
        raise StillError("JPEG is truncated: no end of image")
    position, size, components = 2, None, 0
    while position + 4 <= len(data):
        if data[position] != 0xFF:
            raise StillError(f"JPEG is malformed: no marker at byte {position}")
        marker = data[position + 1]
        if marker == 0xFF or marker in _STANDALONE:
            position += 1 if marker == 0xFF else 2
            continue
        length = int.from_bytes(data[position + 2 : position + 4], "big")
        if marker == _SOS and size is not None:
            _check_scan(data, position + 2, length, components)
            return size
        if marker in (_SOS, _EOI) or length < 2 or position + 2 + length > len(data):
            break
        if marker in _FRAME_HEADERS:
            if size is not None:
                raise StillError("JPEG is malformed: two frame headers")
            size, components = _frame_size(marker, data[position + 4 : position + 2 + length])
        position += 2 + length
    raise StillError("JPEG is malformed: no scan after a frame header")


def _check_scan(data: bytes, start: int, length: int, components: int) -> None:
    # The scan whose header is at ``start`` must be of all components, and nothing but the end may follow.
    if length != 6 + 2 * components or data[start + 2] != components:
        raise StillError(f"JPEG is not one scan of {components} components")
    end = _MARKER_IN_SCAN.search(data, start + length)
    if end is None or end.start() != len(data) - 2:
        raise StillError("JPEG has something behind its scan")


def _frame_size(marker: int, header: bytes) -> tuple[tuple[int, int], int]:
    # (width, height), and the number of components.
    if marker not in _SEQUENTIAL:
        raise StillError(f"JPEG of kind SOF{marker - 0xC0} is not accepted, only baseline and sequential")
    if len(header) < 6 or header[0] != 8 or header[5] not in (1, 3):
        raise StillError("JPEG is not 8 bits deep with 1 or 3 components")
    height, width = int.from_bytes(header[1:3], "big"), int.from_bytes(header[3:5], "big")
    if not width or not height:
        raise StillError(f"JPEG of {width}x{height} has no pixels")
    return (width, height), header[5]
