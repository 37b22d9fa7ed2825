"""The live picture in the three ways in which a browser may show it, made once an edge and only while somebody looks.

``hevc`` copies the units of the link, ``h264`` codes them again, ``jpeg`` is two pictures a second. A picture for the
wall of edges is a small JPEG.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal, cast

import av
import cv2
from av.video.codeccontext import VideoCodecContext
from av.video.frame import PictureType
from av.video.reformatter import ColorRange, Colorspace

from hvt_common.protocol.messages import Info
from hvt_common.values import Image
from hvt_common.video.hevc import BaseDecoder
from hvt_ground.events import VideoSample
from hvt_web.video.fmp4 import Codec, Fragment, Muxer, Start

Rung = Literal["hevc", "h264", "jpeg", "thumbnail"]
RUNGS: tuple[Rung, ...] = ("hevc", "h264", "jpeg")
"""Best first."""
THUMBNAIL: Rung = "thumbnail"

_MOST_GOP_BYTES = 16 * 2**20
MOST_GOP_UNITS = 1800
"""Limit of the pictures since the last keyframe, which a new viewer needs. Where there are more he waits for the next
keyframe; who looks already goes on."""
_JPEG_EVERY_NS = 500_000_000
_THUMBNAIL_EVERY_NS = 1_000_000_000
_THUMBNAIL_WIDTH_PX = 320
_KEYFRAME_EVERY_S = 2.0
"""On the h264 rung: a newcomer decodes this much before the present picture."""
_BT709 = 1
"""ITU-T H.273: of primaries, transfer and matrix alike."""
_X264 = {
    "preset": "ultrafast",
    "tune": "zerolatency",
    "crf": "23",
    "maxrate": "6M",
    "bufsize": "3M",
    "forced-idr": "1",
    "threads": "1",
}


@dataclass(frozen=True, slots=True)
class Made:
    """A message to the viewers on a rung: a start, a fragment or a JPEG."""

    rung: Rung
    item: Start | Fragment | bytes


class Pictures:
    """Fed with every sample of a session in order; for one thread."""

    def __init__(self, info: Info) -> None:
        self._info = info
        self._gop: list[VideoSample] = []
        """All since the last keyframe; empty where they are too many."""
        self._gop_bytes = 0
        self._whole = False
        """Nothing is missing since the last keyframe."""
        self.waits = False
        """Somebody looks, and nothing of the last sample can be shown before a keyframe."""
        self._decoder: BaseDecoder | None = None
        """None while nobody needs decoded pictures."""
        self._h264: _H264 | None = None
        self._copied: Muxer | None = None
        self._wanted: Mapping[Rung, int] = {}
        self._due_ns: dict[Rung, int] = {}

    def add(
        self, sample: VideoSample, *, wanted: Mapping[Rung, int], now_ns: int, hurry: bool
    ) -> Iterator[Made]:
        """The pictures of this sample on the ``wanted`` rungs; in a ``hurry`` nothing is coded again.

        Where the number of a rung is another than before its stream begins anew.
        """
        if wanted.get("hevc") != self._wanted.get("hevc"):
            self._copied = None
        if wanted.get("h264") != self._wanted.get("h264"):
            self._h264 = None
        self._wanted = wanted
        whole = self._remember(sample)
        self.waits = bool(wanted) and not whole
        if not whole:
            return
        if "hevc" in wanted:
            yield from self._copy(sample)
        if not set(wanted) - {"hevc"}:
            self._decoder = None
            return
        picture = self._decode(sample)
        if picture is None or hurry:
            return
        yield from self._coded(picture, sample, wanted=wanted, now_ns=now_ns)

    def last(self) -> Iterator[tuple[VideoSample, tuple[Made, ...]]]:
        """The newest sample as single pictures, where all since its keyframe is there; for any thread."""
        picture, gop = None, tuple(self._gop)
        decoder = BaseDecoder(size=self._info.base_size)
        for one in gop:
            picture = decoder.decode_yuv(one.data)
        if picture is not None:
            yield gop[-1], (Made("jpeg", jpeg(_bgr(picture.frame))), _thumbnail(picture.frame))

    def gap(self) -> None:
        """Samples are missing: the next that is of use is a keyframe."""
        self._gop.clear()
        self._gop_bytes = 0
        self._whole = False
        self._copied = self._decoder = None

    def close(self) -> None:
        """Keep only the state that `last` needs."""
        self._copied = self._decoder = self._h264 = None

    def _remember(self, sample: VideoSample) -> bool:
        if sample.keyframe:
            self._gop.clear()
            self._gop_bytes, self._whole = 0, True
        elif len(self._gop) >= MOST_GOP_UNITS or self._gop_bytes >= _MOST_GOP_BYTES:
            self._gop.clear()
            self._gop_bytes = 0
        if sample.keyframe or self._gop:
            self._gop.append(sample)
            self._gop_bytes += len(sample.data)
        return self._whole

    def _copy(self, sample: VideoSample) -> Iterator[Made]:
        new = [sample]
        if self._copied is None:
            self.waits = not self._gop
            if self.waits:
                return
            self._copied = Muxer("hevc", size=self._info.base_size, fps=self._info.fps)
            new = self._gop
        for one in new:
            yield from _muxed(
                "hevc", self._copied, one.data, keyframe=one.keyframe, capture_ns=one.capture_ns
            )

    def _decode(self, sample: VideoSample) -> av.VideoFrame | None:
        # The newest picture; who begins in between decodes all since the keyframe first.
        new = [sample]
        if self._decoder is None:
            self.waits = not self._gop
            if self.waits:
                return None
            self._decoder = BaseDecoder(size=self._info.base_size)
            new = self._gop
        picture = None
        for one in new:
            picture = self._decoder.decode_yuv(one.data)
        if picture is None:
            self.gap()
            return None
        return picture.frame

    def _coded(
        self, picture: av.VideoFrame, sample: VideoSample, *, wanted: Mapping[Rung, int], now_ns: int
    ) -> Iterator[Made]:
        if "h264" in wanted:
            if self._h264 is None:
                self._h264 = _H264(self._info)
            yield from self._h264.add(picture, sample.capture_ns)
        if "jpeg" in wanted and self._due("jpeg", now_ns, _JPEG_EVERY_NS):
            yield Made("jpeg", jpeg(_bgr(picture)))
        if THUMBNAIL in wanted and self._due(THUMBNAIL, now_ns, _THUMBNAIL_EVERY_NS):
            yield _thumbnail(picture)

    def _due(self, rung: Rung, now_ns: int, every_ns: int) -> bool:
        if now_ns < self._due_ns.get(rung, 0):
            return False
        self._due_ns[rung] = now_ns + every_ns
        return True


class _H264:
    def __init__(self, info: Info) -> None:
        self._encoder = _encoder(info)
        self._muxer = Muxer("h264", size=info.base_size, fps=info.fps)
        self._keyframe_ns: int | None = None
        self._count = 0

    def add(self, picture: av.VideoFrame, capture_ns: int) -> Iterator[Made]:
        """The fragments of one picture: as a rule one."""
        since_ns = None if self._keyframe_ns is None else capture_ns - self._keyframe_ns
        keyframe = since_ns is None or not 0 <= since_ns < _KEYFRAME_EVERY_S * 1e9
        if keyframe:
            self._keyframe_ns = capture_ns
        picture.pict_type = PictureType.I if keyframe else PictureType.NONE
        picture.pts, picture.time_base = self._count, self._encoder.time_base
        self._count += 1
        for packet in self._encoder.encode(picture):
            yield from _muxed(
                "h264", self._muxer, bytes(packet), keyframe=packet.is_keyframe, capture_ns=capture_ns
            )


def _muxed(rung: Codec, muxer: Muxer, data: bytes, *, keyframe: bool, capture_ns: int) -> Iterator[Made]:
    start, fragment = muxer.add(data, keyframe=keyframe, capture_ns=capture_ns)
    if start is not None:
        yield Made(rung, start)
    if fragment is not None:
        yield Made(rung, fragment)


def _encoder(info: Info) -> VideoCodecContext:
    encoder = av.CodecContext.create("libx264", "w")
    assert isinstance(encoder, VideoCodecContext)
    encoder.width, encoder.height = info.base_size
    encoder.pix_fmt = "yuv420p"
    encoder.time_base = Fraction(1, max(1, round(info.fps)))
    # The colours of the ground's decoder: a browser would guess others for a small picture.
    encoder.colorspace = encoder.color_primaries = encoder.color_trc = _BT709
    encoder.color_range = ColorRange.MPEG
    encoder.options = _X264 | {"g": "100000"}  # keyframes come by capture time
    return encoder


def _thumbnail(picture: av.VideoFrame) -> Made:
    width = min(_THUMBNAIL_WIDTH_PX, picture.width)
    height = max(2, round(picture.height * width / picture.width))
    return Made(THUMBNAIL, jpeg(_bgr(picture, width, height), quality_pct=70))


def _bgr(picture: av.VideoFrame, width: int | None = None, height: int | None = None) -> Image:
    bgr = picture.reformat(
        width=width,
        height=height,
        format="bgr24",
        src_colorspace=Colorspace.ITU709,
        src_color_range=ColorRange.MPEG,
        dst_color_range=ColorRange.JPEG,
        threads=1,
    )
    return cast("Image", bgr.to_ndarray())


def jpeg(picture_bgr: Image, *, quality_pct: int = 80) -> bytes:
    return cv2.imencode(".jpg", picture_bgr, [cv2.IMWRITE_JPEG_QUALITY, quality_pct])[1].tobytes()
