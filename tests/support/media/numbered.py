"""Clips that say which frame is which: four known colours, a disc, and the number of the frame in bits."""

from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

_BITS = 10


def numbered(number: int, *, size: tuple[int, int] = (320, 240)) -> np.ndarray:
    """(height, width, 3) uint8 BGR: red at the top left, green at the top right, a disc, bits at the bottom."""
    wide, high = size
    picture = np.full((high, wide, 3), 90, np.uint8)
    picture[: high // 4, : wide // 4] = (0, 0, 191)
    picture[: high // 4, -(wide // 4) :] = (0, 191, 0)
    cv2.circle(picture, (wide // 2, high // 2), min(size) // 6, (0, 220, 220), -1)
    band = high // 8
    picture[-band:] = 0
    for bit in range(_BITS):
        if number >> bit & 1:
            picture[-band:, bit * wide // _BITS : (bit + 1) * wide // _BITS] = 255
    return picture


def number_of(picture: np.ndarray) -> int:
    """What `numbered` was given."""
    high, wide = picture.shape[:2]
    row = picture[-(high // 16)].mean(axis=1)
    return sum(1 << bit for bit in range(_BITS) if row[(2 * bit + 1) * wide // (2 * _BITS)] > 127)


def disc(picture: np.ndarray) -> tuple[int, int]:
    """(width, height) of the disc in pixels."""
    blue, green, red = (picture[..., place].astype(int) for place in range(3))
    rows, columns = np.nonzero((green > 150) & (red > 150) & (blue < 110))
    return int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1


def patch(picture: np.ndarray, *, right: bool, bottom: bool = False) -> tuple[int, ...]:
    high, wide = picture.shape[:2]
    rows = slice(-high // 6, -high // 8) if bottom else slice(high // 16, high // 8)
    columns = slice(-wide // 8, -wide // 16) if right else slice(wide // 16, wide // 8)
    return tuple(round(float(one)) for one in picture[rows, columns].reshape(-1, 3).mean(axis=0))


def write_numbered(
    path: Path,
    count: int = 60,
    *,
    pictures: Iterable[np.ndarray] | None = None,
    rate: int | Fraction = 30,
    codec: str = "libx264",
    pixels: str = "yuv420p",
    times_ms: Iterable[int] | None = None,
    places: Sequence[int] | None = None,
    muxer: dict[str, str] | None = None,
    setup: Callable[[Any], None] = lambda _: None,
    **options: str,
) -> Path:
    """A clip of BGR or 16-bit grey; ``setup`` gets the stream before its frames.

    Their times are ``times_ms``, or their ``places`` at ``rate``.
    """
    times = None if times_ms is None else list(times_ms)
    with av.open(str(path), "w", options=muxer or {}) as container:
        stream: Any = container.add_stream(codec, rate=rate)
        stream.pix_fmt = pixels
        stream.options = {"x265-params": "log-level=none", **options} if codec == "libx265" else options
        if times is not None:
            stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        setup(stream)
        for place, picture in enumerate(pictures or (numbered(one) for one in range(count))):
            if not place:
                stream.height, stream.width = picture.shape[:2]
            given = "bgr24" if picture.ndim == 3 else "gray16le"
            frame = av.VideoFrame.from_ndarray(picture, format=given).reformat(format=pixels)
            if times is not None:
                frame.pts, frame.time_base = times[place], Fraction(1, 1000)
            elif places is not None:
                frame.pts, frame.time_base = places[place], 1 / Fraction(rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def copied(parts: Iterable[tuple[Path, Callable[[Any], int]]], path: Path) -> Path:
    """The films of ``parts`` in one file, not coded anew, each packet later by what its part's function gives."""
    with av.open(str(path), "w") as out:
        stream: Any = None
        for part, later in parts:
            with av.open(str(part)) as container:
                stream = stream or out.add_stream_from_template(container.streams.video[0])
                for packet in container.demux(video=0):
                    if packet.size:
                        by = later(packet)
                        packet.pts, packet.dts, packet.stream = packet.pts + by, packet.dts + by, stream
                        out.mux(packet)
    return path
