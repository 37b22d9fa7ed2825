"""HEVC as cameras write it: clips by x265 with the settings that matter to who sends them on."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np

from hvt_common.video.hevc import nal_kind, nal_units
from media.clips import smooth_pictures

SIZE = (320, 192)
_FORMATS = {".mp4": "mp4", ".mkv": "matroska", ".hevc": "hevc", ".ts": "mpegts"}


def write_clip(
    path: Path,
    pictures: Sequence[np.ndarray] | None = None,
    *,
    fps: int = 15,
    keyint: int = 10,
    bframes: int = 0,
    more: str = "",
    pixel_format: str = "yuv420p",
    codec: str = "libx265",
    kbps: int = 0,
) -> Path:
    """Three seconds of it, a keyframe each ``keyint`` frames; the container follows from the name."""
    pictures = smooth_pictures(45, size=SIZE) if pictures is None else pictures
    high, wide = pictures[0].shape[:2]
    with av.open(str(path), "w", format=_FORMATS[path.suffix]) as container:
        stream: Any = container.add_stream(codec, rate=fps)
        stream.width, stream.height, stream.pix_fmt = wide, high, pixel_format
        if kbps:
            stream.bit_rate = 1000 * kbps
        if codec == "libx265":
            params = f"log-level=none:keyint={keyint}:min-keyint={keyint}:scenecut=0:bframes={bframes}"
            stream.options = {"preset": "ultrafast", "x265-params": f"{params}:{more}".rstrip(":")}
        for picture in pictures:
            frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
            container.mux(stream.encode(frame.reformat(format=pixel_format)))
        container.mux(stream.encode(None))
    return path


def packets_of(path: Path) -> list[bytes]:
    with av.open(str(path)) as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]


def pictures_of(path: Path) -> list[list[bytes]]:
    """The slices of each picture, by FFmpeg's own way from lengths to start codes."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        to_annex_b = av.BitStreamFilterContext("hevc_mp4toannexb", stream)
        units = [
            one for packet in container.demux(stream) if packet.size for one in to_annex_b.filter(packet)
        ]
    return [[nal for nal in nal_units(bytes(one)) if nal_kind(nal) < 32] for one in units]
