"""`avif`: AV1 still pictures through OpenCV, as files that any program opens.

The decoder gets AVIF boxes that are written here: nothing from the network but AV1 data reaches it, of one picture
whose size has been read.
"""

from __future__ import annotations

import cv2

from hvt_codecs.webp import lacks
from hvt_common.protocol.messages.bits import BitReader
from hvt_common.values import Image
from hvt_common.video.still_codecs.contract import IntraCodec, StillError, imdecoded, imencoded, on_ladder

_QUALITY = ((1, 1), (5, 4), (20, 36), (35, 46), (50, 52.5), (65, 59), (80, 68), (90, 81), (97, 94), (100, 98))
"""(quality in percent, libavif's own), at equal Y-PSNR; libavif's 100 is lossless, which is another format."""
_SPEED = 8
"""2 ms a crop; 6 takes 12 ms and saves 6 %, 9 takes 1 ms and costs 9 %."""

_TEMPORAL_DELIMITER, _SEQUENCE, _FRAME = 2, 1, 6


class AvifCodec(IntraCodec):
    """The payload is an AVIF file with one item."""

    name = "avif"
    media_type = "image/avif"

    def _encoded(self, crop_bgr: Image, quality_pct: int) -> bytes:
        flags = [cv2.IMWRITE_AVIF_QUALITY, round(on_ladder(_QUALITY, quality_pct))]
        return imencoded(".avif", crop_bgr, [*flags, cv2.IMWRITE_AVIF_SPEED, _SPEED])

    def _decoded(self, data: bytes, size: tuple[int, int]) -> Image:
        av1 = av1_data(data)
        if av1_size(av1) != size:
            raise StillError(f"AV1 picture is not of {size[0]}x{size[1]}")
        return imdecoded(avif_file(av1, size=size), size=size, what="AVIF")

    @staticmethod
    def lacking() -> str | None:
        """Why it does not work on this machine, or None."""
        return lacks(".avif")


def av1_data(file: bytes) -> bytes:
    """The content of the one ``mdat`` box of an AVIF file, without a temporal delimiter; else `StillError`."""
    found, position = [], 0
    while position < len(file):
        length, kind = int.from_bytes(file[position : position + 4], "big"), file[position + 4 : position + 8]
        if length < 8 or position + length > len(file):
            raise StillError("AVIF is malformed: a box runs over the end")
        if position == 0 and (kind != b"ftyp" or file[8:12] != b"avif"):
            break
        found += [file[position + 8 : position + length]] if kind == b"mdat" else []
        position += length
    if len(found) != 1:
        raise StillError("not an AVIF file of one still picture")
    return found[0].removeprefix(bytes([_TEMPORAL_DELIMITER << 3 | 2, 0]))


def av1_size(data: bytes) -> tuple[int, int]:
    """(width, height) of AV1 data that is a sequence header of a still picture and one frame (AV1, clause 5.5).

    The reduced still-picture header leaves the frame no room to say another size. Else `StillError`.
    """
    units: list[tuple[int, bytes]] = []
    position = 0
    while position < len(data) and len(units) < 2:
        start, length = _length(data, position + 1)
        units.append((data[position], data[start : start + length]))
        position = start + length
    if position != len(data) or [head for head, _ in units] != [_SEQUENCE << 3 | 2, _FRAME << 3 | 2]:
        raise StillError("AV1 data is not one sequence header and one frame")
    header = units[0][1]
    if len(header) < 6:
        raise StillError("AV1 sequence header is truncated")
    reader = BitReader(header[:8])
    if reader.u(5) != 0b00011:
        raise StillError("AV1 data is not a still picture of the main profile")
    reader.u(5)  # level
    bits = reader.u(4) + 1, reader.u(4) + 1
    if 18 + sum(bits) > len(header[:8]) * 8:
        raise StillError("AV1 sequence header is truncated")
    return reader.u(bits[0]) + 1, reader.u(bits[1]) + 1


def avif_file(data: bytes, *, size: tuple[int, int]) -> bytes:
    """An AVIF file around AV1 data: 8 bits, 4:2:0, BT.709 colours, sRGB curve, BT.601 matrix, full range."""
    kind = _box(b"ftyp", b"avif" + bytes(4) + b"avifmif1miafMA1B")
    extent = _box(b"ispe", bytes(4) + size[0].to_bytes(4, "big") + size[1].to_bytes(4, "big"))
    depth, setup = _box(b"pixi", bytes(4) + b"\x03\x08\x08\x08"), _box(b"av1C", b"\x81\x00\x0c\x00")
    colour = _box(b"colr", b"nclx\x00\x01\x00\x0d\x00\x06\x80")
    # Of item 1: properties 1 to 4, the third essential.
    uses = _box(b"ipma", bytes(4) + b"\x00\x00\x00\x01\x00\x01\x04\x01\x02\x83\x04")
    item = _box(b"infe", b"\x02\x00\x00\x00\x00\x01\x00\x00av01Color\x00")
    fixed = _box(b"hdlr", bytes(8) + b"pict" + bytes(13)) + _box(b"pitm", bytes(4) + b"\x00\x01")
    rest = _box(b"iinf", bytes(4) + b"\x00\x01" + item)
    rest += _box(b"iprp", _box(b"ipco", extent + depth + setup + colour) + uses)
    place_length = 30
    start = len(kind) + 12 + len(fixed) + place_length + len(rest) + 8
    place = bytes(4) + b"\x44\x00\x00\x01\x00\x01\x00\x00\x00\x01"
    place = _box(b"iloc", place + start.to_bytes(4, "big") + len(data).to_bytes(4, "big"))
    return kind + _box(b"meta", bytes(4) + fixed + place + rest) + _box(b"mdat", data)


def _box(kind: bytes, body: bytes) -> bytes:
    return (len(body) + 8).to_bytes(4, "big") + kind + body


def _length(data: bytes, position: int) -> tuple[int, int]:
    # Where the unit's body starts, and its length (leb128).
    value = 0
    for index, byte in enumerate(data[position : position + 4]):
        value |= (byte & 0x7F) << 7 * index
        if not byte & 0x80:
            return position + index + 1, value
    raise StillError("AV1 data is malformed: no length")
