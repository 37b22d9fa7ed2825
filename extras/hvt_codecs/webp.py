"""`webp`: lossy WebP through OpenCV."""

from __future__ import annotations

import cv2

from hvt_common.values import Image
from hvt_common.video.still_codecs.contract import IntraCodec, StillError, imdecoded, imencoded, on_ladder

_QUALITY = ((1, 1), (5, 2), (20, 17), (35, 36), (50, 52), (65, 71), (80, 82), (90, 90), (97, 98), (100, 100))
"""(quality in percent, WebP's own), at equal Y-PSNR; WebP has nothing as coarse as JPEG below 15."""
_VP8_START = b"\x9d\x01\x2a"


class WebpCodec(IntraCodec):
    """The payload is a WebP file of one ``VP8`` chunk; transparency, animation and lossless are refused."""

    name = "webp"
    media_type = "image/webp"

    def _encoded(self, crop_bgr: Image, quality_pct: int) -> bytes:
        quality = round(on_ladder(_QUALITY, quality_pct))
        return imencoded(".webp", crop_bgr, [cv2.IMWRITE_WEBP_QUALITY, quality])

    def _decoded(self, data: bytes, size: tuple[int, int]) -> Image:
        if webp_size(data) != size:
            raise StillError(f"WebP is not of {size[0]}x{size[1]}")
        return imdecoded(data, size=size, what="WebP")

    @staticmethod
    def lacking() -> str | None:
        """Why it does not work on this machine, or None."""
        return lacks(".webp")


def lacks(ending: str) -> str | None:
    """Why this OpenCV cannot code pictures of that file ending, or None where it can."""
    if cv2.haveImageWriter(f"still{ending}"):
        return None
    return f"OpenCV {cv2.__version__} is built without {ending[1:]}; opencv-python-headless 4.11 and later have it"


def webp_size(data: bytes) -> tuple[int, int]:
    """(width, height) from the header of a simple lossy WebP file; else `StillError`.

    RFC 9649 for the file, RFC 6386 section 9.1 for the picture.
    """
    length = int.from_bytes(data[16:20], "little")
    whole = data[:4] == b"RIFF" and data[8:16] == b"WEBPVP8 " and len(data) == 20 + length + length % 2
    if not whole or len(data) < 30 or int.from_bytes(data[4:8], "little") + 8 != len(data):
        raise StillError("not a whole WebP of one lossy picture")
    if data[20] & 1 or data[23:26] != _VP8_START:
        raise StillError("WebP is malformed: no keyframe")
    # The two bits above the 14 tell a player to enlarge; they are ignored.
    return int.from_bytes(data[26:28], "little") & 0x3FFF, int.from_bytes(data[28:30], "little") & 0x3FFF
