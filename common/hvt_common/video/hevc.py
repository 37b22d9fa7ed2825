"""Decode the base stream, one access unit in, one picture out. The same decoder runs at the edge and the ground.

Also the NAL units in an Annex B byte stream (ITU-T H.264 and H.265, annex B).
"""

import re
from threading import Lock
from typing import cast

import av
import av.error
import cv2
import numpy as np
import numpy.typing as npt
from av.video.codeccontext import VideoCodecContext
from av.video.reformatter import ColorRange, Colorspace, Interpolation, VideoReformatter

from hvt_common.values import Image

UNBIASED = (
    Interpolation.AREA
    | Interpolation.ACCURATE_RND
    | Interpolation.FULL_CHR_H_INT
    | Interpolation.FULL_CHR_H_INP
)
"""How libswscale converts between BGR and YUV. Its default rounding shifts every pixel by about two levels, which
costs the base 0.9 dB at 650 kbps; this takes 2.5 ms a 720p frame more to decode and none to encode."""

MAX_SIDE_PX = 8192
"""HEVC level 6.2 ends near here; a larger picture from the network is not decoded."""
MAX_PICTURE_PX = 35_651_584
"""The luma samples of a picture of level 6.2 (ITU-T H.265, table A.8): 8192x4352."""
_BLOCK_PX = 64
"""A coded picture is filled up to whole blocks, and libavcodec's rows to as much."""
_YUV420 = ("yuv420p", "yuvj420p")
_FULL_RANGE = np.clip(np.rint((np.arange(256) - 16) * 255 / 219), 0, 255).astype(np.uint8)
"""Levels 0 to 255 for the luma of ITU-T H.273, 16 to 235."""
Plane = npt.NDArray[np.uint8]


class ToBgr:
    """Converts the pictures of one decoder, for any thread: those that come at the same moment take turns."""

    def __init__(self) -> None:
        self._converter, self._lock = VideoReformatter(), Lock()

    def __call__(self, picture: av.VideoFrame) -> Image:
        """Uint8 (H, W, 3)."""
        with self._lock:
            bgr = self._converter.reformat(
                picture,
                format="bgr24",
                src_colorspace=Colorspace.ITU709,
                src_color_range=ColorRange.MPEG,
                dst_color_range=ColorRange.JPEG,
                interpolation=UNBIASED,
                threads=1,
            )
        return cast("Image", np.asarray(bgr.to_ndarray(), np.uint8))


class YuvPicture:
    """A decoded picture, 4:2:0, half the memory of its BGR."""

    def __init__(self, picture: av.VideoFrame, to_bgr: ToBgr) -> None:
        self.frame = picture
        """That of libavcodec, for coding it again."""
        self._to_bgr = to_bgr
        self.size = (picture.width, picture.height)

    @property
    def nbytes(self) -> int:
        return sum(plane.buffer_size for plane in self.frame.planes)

    @property
    def planes(self) -> tuple[Plane, Plane, Plane] | None:
        """Y (H, W), Cb and Cr (half of it, rounded up), uint8, read-only; None if it is not 4:2:0, 8 bits."""
        if self.frame.format.name not in _YUV420:
            return None
        (width, height), whole = self.size, self.frame.planes
        half = -(-width // 2), -(-height // 2)
        luma, first, second = (
            np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)[: side[1], : side[0]]
            for plane, side in zip(whole, ((width, height), half, half), strict=True)
        )
        return luma, first, second

    def gray(self) -> Image:
        """Uint8 (H, W), 0 to 255, for a tenth of the time of `bgr`."""
        planes = self.planes
        if planes is None:
            return np.asarray(cv2.cvtColor(self.bgr(), cv2.COLOR_BGR2GRAY), np.uint8)
        if self.frame.color_range == ColorRange.JPEG:
            return planes[0].copy()
        return np.asarray(cv2.LUT(planes[0], _FULL_RANGE), np.uint8)

    def bgr(self) -> Image:
        """Uint8 (H, W, 3), the same at every call."""
        return self._to_bgr(self.frame)


Picture = Image | YuvPicture
"""BGR, or as it was decoded."""


class BaseDecoder:
    """Decodes HEVC access units in order.

    One thread: several lag by a picture or two, or gain nothing (3 ms at 1280x720), and each takes memory. After a
    loss libavcodec returns nothing, or garbage, without an error: the caller starts again at a keyframe
    (`reset`) and never feeds a unit whose predecessor is missing.

    Parameter sets may announce any size. A picture of more pixels than one of ``size`` (width, height) has, or
    than there are in HEVC where that is not given, is refused before memory is taken for it.
    """

    def __init__(self, *, size: tuple[int, int] | None = None) -> None:
        self._max_px = MAX_PICTURE_PX if size is None else min(MAX_PICTURE_PX, _filled_px(size))
        self._context = self._open()
        self._to_bgr = ToBgr()

    def decode(self, data: bytes) -> Image | None:
        """Return the picture, uint8 (H, W, 3) BGR in base pixels, or None where the unit cannot be decoded."""
        picture = self.decode_yuv(data)
        return None if picture is None else picture.bgr()

    def decode_yuv(self, data: bytes) -> YuvPicture | None:
        """The same as it was coded."""
        if not data:
            return (
                None  # to libavcodec an empty packet means the end of the stream: it would take nothing more
            )
        try:
            pictures = self._context.decode(av.Packet(data))
        except av.error.FFmpegError:
            return None
        if not pictures:
            return None
        picture = pictures[-1]
        if max(picture.width, picture.height) > MAX_SIDE_PX:
            return None
        return YuvPicture(picture, self._to_bgr)

    def reset(self) -> None:
        """Forget all reference pictures; the next unit has to be a keyframe."""
        self._context = self._open()

    def _open(self) -> VideoCodecContext:
        context = av.CodecContext.create("hevc", "r")
        context.thread_count = 1
        context.options = {"max_pixels": str(self._max_px)}
        return context


def _filled_px(size: tuple[int, int]) -> int:
    # Samples of a picture of this size with whatever fills it up to whole blocks.
    width, height = (-(-side // _BLOCK_PX) * _BLOCK_PX for side in size)
    return width * height


_START_CODE = re.compile(rb"\x00\x00\x01")
LONG_START = b"\0\0\0\1"
"""The start code of a parameter set, and of the first unit of a picture."""
_IRAP = frozenset(range(16, 22))
"""BLA, IDR and CRA pictures of H.265, table 7-1."""
PARAMETER_SETS = frozenset({32, 33, 34})
"""VPS, SPS and PPS, ibid."""
_FILLER = 38
_FILLER_START = b"\0\0\1" + bytes([_FILLER << 1])
"""A start code stands nowhere else, so this is a unit of filler data."""


def nal_units(stream: bytes) -> list[bytes]:
    """The units, without start codes and the zeros behind them."""
    starts = [match.start() for match in _START_CODE.finditer(stream)]
    ends = [*starts, len(stream)][1:]
    found = (stream[begin + 3 : end].rstrip(b"\0") for begin, end in zip(starts, ends, strict=True))
    return [unit for unit in found if unit]


def without_filler(access_unit: bytes) -> bytes:
    """The same picture without filler data: some encoders pad a still scene to their rate with it."""
    if _FILLER_START not in access_unit:
        return access_unit
    return b"".join(LONG_START + one for one in nal_units(access_unit) if nal_kind(one) != _FILLER)


def parameter_sets(access_unit: bytes) -> bytes:
    """VPS, SPS and PPS of an HEVC access unit, as Annex B; empty unless all three are in it."""
    found = {kind: unit for unit in nal_units(access_unit) if (kind := nal_kind(unit)) in PARAMETER_SETS}
    return (
        b"".join(LONG_START + found[kind] for kind in sorted(found))
        if len(found) == len(PARAMETER_SETS)
        else b""
    )


def is_keyframe(access_unit: bytes) -> bool:
    """Whether an HEVC access unit is an IRAP picture, at which a decoder that has its parameter sets can start."""
    return any(nal_kind(unit) in _IRAP for unit in nal_units(access_unit))


def nal_kind(unit: bytes) -> int:
    """The NAL unit type, H.265 clause 7.3.1.2."""
    return unit[0] >> 1 & 0x3F
