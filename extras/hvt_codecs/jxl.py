"""`jxl`: JPEG XL, where the extra ``hvt[jxl]`` (pillow-jxl-plugin) is installed."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec

import numpy as np

from hvt_common.values import Image
from hvt_common.video.still_codecs.contract import IntraCodec, StillError, on_ladder

_QUALITY = ((1, 1), (5, 2), (20, 27), (35, 50), (50, 63), (65, 71), (80, 81), (90, 88.5), (97, 96), (100, 99))
"""(quality in percent, libjxl's own), at equal Y-PSNR; its 100 is lossless."""
_PLUGIN = "pillow_jxl"
_EFFORT = 3
"""From 5 upwards a crop may become several frames, for no fewer bytes."""
_SIDE_BITS = (9, 13, 18, 30)
_RATIOS = ((1, 1), (6, 5), (4, 3), (3, 2), (16, 9), (5, 4), (2, 1))
_MAX_UPSAMPLING = 1
"""A power of two; below quality 10 libjxl codes at half the size."""


class JxlCodec(IntraCodec):
    """The payload is a bare JPEG XL codestream of one frame."""

    name = "jxl"
    media_type = "image/jxl"

    def _encoded(self, crop_bgr: Image, quality_pct: int) -> bytes:
        encoder = import_module(_PLUGIN).Encoder(
            mode="RGB",
            lossless=False,
            quality=on_ladder(_QUALITY, quality_pct),
            decoding_speed=0,
            effort=_EFFORT,
            use_container=False,
            use_original_profile=False,
            num_threads=0,
        )
        rgb = np.ascontiguousarray(crop_bgr[..., ::-1])
        return bytes(encoder(rgb.tobytes(), rgb.shape[1], rgb.shape[0], jpeg_encode=False))

    def _decoded(self, data: bytes, size: tuple[int, int]) -> Image:
        if jxl_size(data) != size:
            raise StillError(f"JPEG XL is not of {size[0]}x{size[1]}")
        try:
            _, info, pixels, *_ = import_module(_PLUGIN).Decoder(num_threads=0)(data)
        except (RuntimeError, ValueError, OSError) as error:
            raise StillError(f"JPEG XL does not decode: {error}") from None
        if info.mode != "RGB" or len(pixels) != size[0] * size[1] * 3:
            raise StillError(f"JPEG XL of {size[0]}x{size[1]} does not decode")
        return np.ascontiguousarray(np.frombuffer(pixels, np.uint8).reshape(size[1], size[0], 3)[..., ::-1])

    @staticmethod
    def lacking() -> str | None:
        """Why it does not work on this machine, or None."""
        return None if find_spec(_PLUGIN) else "it comes with the extra hvt[jxl], which is not installed"


def jxl_size(data: bytes) -> tuple[int, int]:
    """(width, height) of a bare codestream (ISO/IEC 18181-1, annexes D and F); else `StillError`.

    Only the form of our edge is taken: default metadata (so no further channels, preview or animation) and one
    regular frame of the picture's size in one pass. Anything else may cost far more than a picture of that size.
    """
    if data[:2] != b"\xff\x0a" or len(data) < 16:
        raise StillError("not a JPEG XL codestream")
    bits = _Bits(data[2:32])
    small = bits.u(1)
    height = _side(bits, small=small)
    ratio = bits.u(3)
    width = _side(bits, small=small) if not ratio else height * _RATIOS[ratio - 1][0] // _RATIOS[ratio - 1][1]
    plain_metadata = bits.u(2) == 0b11
    bits.to_byte()
    # Frame: not all default; regular, coded by blocks, without patches, splines or noise.
    plain_frame = bits.u(1) == 0 and bits.u(2) == 0 and bits.u(1) == 0 and bits.u(2) == 0
    plain_frame = plain_frame and bits.u(2) <= _MAX_UPSAMPLING
    bits.u(6)  # weights of two channels
    plain_frame = plain_frame and bits.u(2) == 0 and bits.u(1) == 0 and bits.u(2) == 0 and bits.u(1) == 1
    if not plain_metadata or not plain_frame:
        raise StillError("JPEG XL is not one plain frame")
    return width, height


class _Bits:
    # Reads fields, least significant bit first.

    def __init__(self, data: bytes) -> None:
        self._left = int.from_bytes(data, "little")
        self._taken = 0

    def u(self, bits: int) -> int:
        value = self._left & ((1 << bits) - 1)
        self._left >>= bits
        self._taken += bits
        return value

    def to_byte(self) -> None:
        self.u(-self._taken % 8)


def _side(bits: _Bits, *, small: int) -> int:
    return 8 * (1 + bits.u(5)) if small else 1 + bits.u(_SIDE_BITS[bits.u(2)])
