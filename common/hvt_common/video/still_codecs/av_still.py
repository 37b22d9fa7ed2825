"""One picture or two through libavcodec: a codec opened for a still and dropped after it.

Opening costs 0.3 ms and leaves no state behind, so that a crop's bytes hang on nothing but the crop.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction

import av
import av.error
import numpy as np
from av.codec.context import Flags
from av.video.codeccontext import VideoCodecContext

from hvt_common.video.still_codecs.contract import StillError
from hvt_common.video.still_codecs.yuv420 import Planar


def encoded(pictures: Sequence[Planar], *, encoder: str, options: Mapping[str, str]) -> list[bytes]:
    """Each picture's access unit (Annex B), from an encoder without delay."""
    context = av.CodecContext.create(encoder, "w")
    assert isinstance(context, VideoCodecContext)
    context.width, context.height = pictures[0].shape[1], pictures[0].shape[0] * 2 // 3
    context.pix_fmt = "yuv420p"
    context.time_base, context.framerate = Fraction(1, 25), Fraction(25)
    context.thread_count = 1
    context.options = dict(options)
    units = []
    for index, picture in enumerate(pictures):
        frame = av.VideoFrame.from_ndarray(picture, format="yuv420p")
        frame.pts = index
        units += [bytes(packet) for packet in context.encode(frame)]
    assert len(units) == len(pictures), "zero latency: one in, one out"
    return units


def decoded(units: Sequence[bytes], *, decoder: str, size: tuple[int, int]) -> Planar:
    """The last unit's picture, of ``size``; `StillError` where the bytes do not say one."""
    context = av.CodecContext.create(decoder, "r")
    assert isinstance(context, VideoCodecContext)
    context.thread_count = 1
    context.flags |= Flags.low_delay
    context.options = {"err_detect": "explode", "ec": "0"}  # errors are errors: nothing is concealed
    pictures = []
    try:
        for unit in units:
            pictures += context.decode(av.Packet(unit))
        pictures += context.decode(None)
    except (av.error.FFmpegError, ValueError) as error:
        raise StillError(f"{decoder} still does not decode: {error}") from None
    if len(pictures) != len(units) or pictures[-1].is_corrupt or pictures[-1].format.name != "yuv420p":
        raise StillError(f"{decoder} still does not decode: {len(pictures)} of {len(units)} pictures")
    if (pictures[-1].width, pictures[-1].height) != size:
        raise StillError(f"{decoder} still is not of {size[0]}x{size[1]}")
    return np.asarray(pictures[-1].to_ndarray(), np.uint8)
