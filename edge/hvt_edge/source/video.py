"""A video file as a source, through PyAV: any codec, any rate, constant or not, upright whatever its metadata say."""

from __future__ import annotations

import logging
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit, urlunsplit

import av
import av.error
import cv2
import numpy as np

from hvt_common.errors import UserError
from hvt_common.units import exact_rate
from hvt_common.values import Fit, Frame, Image
from hvt_edge.source.contract import BaseSize, Source
from hvt_edge.source.resample import Resizer, base_frame_count, capture_time_ns, hold

__all__ = ["VideoSource", "open_video", "upright_bgr", "without_password"]

_log = logging.getLogger(__name__)

_TEXT_CODECS = frozenset({"ansi", "bintext", "xbin", "idf"})
"""FFmpeg plays text files as a terminal's screen; nobody means that."""

_OPEN_S, _READ_S = 10.0, 10.0


class VideoSource(Source):
    """A clip by presentation time; the first frame that decodes is its zero. What can be decoded is played."""

    live = False

    def __init__(
        self,
        spec: str,
        *,
        size: BaseSize,
        fps: float,
        fit: Fit,
        max_frames: int | None = None,
        source_fps: float | None = None,
    ) -> None:
        self._spec, self.fps = spec, fps
        self._override = None if source_fps is None else exact_rate(source_fps)
        container, stream = open_video(spec)
        with container:
            self._rate = self._override or _rate(stream) or exact_rate(fps)
            duration_s = self._duration_s(container, stream)
            with closing(_decoded(container, stream, spec=spec)) as decoded:
                first = next(decoded, None)
            if first is None:
                raise UserError(
                    f"source {without_password(spec)!r} holds a video stream of which no frame can be decoded"
                )
            picture = upright_bgr(first)
        self._resizer = Resizer((picture.shape[1], picture.shape[0]), size, fit=fit)
        self.view = self._resizer.view
        counts = [] if duration_s is None else [max(1, base_frame_count(duration_s, fps=exact_rate(fps)))]
        counts += [] if max_frames is None else [max_frames]
        self._limit = max_frames
        self.frame_count = min(counts, default=None) if duration_s is not None else None
        self._running: Generator[Frame, None, None] | None = None

    @property
    def source_fps(self) -> float:
        """The clip's own frame rate, as it says or as it was overridden."""
        return float(self._rate)

    def frames(self, *, start_ns: int) -> Iterator[Frame]:
        """The clip from its beginning."""
        self.close()
        self._running = self._play(start_ns)
        return self._running

    def close(self) -> None:
        """Stop decoding."""
        if self._running is not None:
            self._running.close()
            self._running = None

    def _play(self, start_ns: int) -> Generator[Frame, None, None]:
        base_rate = exact_rate(self.fps)
        container, stream = open_video(self._spec)
        with container, closing(_decoded(container, stream, spec=self._spec)) as decoded:
            slack_s = Fraction(0) if self._override else Fraction(stream.time_base or 0)
            stamped = self._stamped(decoded)
            held: tuple[av.VideoFrame, Frame] | None = None
            for index, frame in hold(stamped, fps=base_rate, tail_s=1 / self._rate, slack_s=slack_s):
                if index == self._limit:
                    return
                capture_ns = capture_time_ns(index, fps=base_rate, start_ns=start_ns)
                if held is None or held[0] is not frame:  # only what is shown is converted
                    held = (
                        frame,
                        self._resizer.frame(upright_bgr(frame), index=index, capture_ns=capture_ns),
                    )
                yield replace(held[1], index=index, capture_ns=capture_ns)

    def _stamped(self, decoded: Iterator[av.VideoFrame]) -> Iterator[tuple[Fraction, av.VideoFrame]]:
        """Frames with their times; one without a time stamp follows its predecessor by the clip's mean period."""
        time_s = Fraction(0)
        for count, frame in enumerate(decoded):
            if self._override:
                time_s = count / self._override
            elif frame.pts is not None and frame.time_base is not None:
                time_s = frame.pts * frame.time_base
            elif count:
                time_s += 1 / self._rate
            yield time_s, frame

    def _duration_s(self, container: Any, stream: Any) -> Fraction | None:
        if self._override:
            return stream.frames / self._override if stream.frames else None
        if stream.duration and stream.time_base:
            return Fraction(stream.duration * stream.time_base)
        return Fraction(container.duration, 1_000_000) if container.duration else None


def upright_bgr(frame: av.VideoFrame) -> Image:
    """A decoded frame of any pixel format as (height, width, 3) uint8 BGR, with square pixels, turned upright."""
    picture = np.asarray(frame.to_ndarray(format="bgr24"), np.uint8)
    aspect = getattr(frame, "sample_aspect_ratio", None)
    if aspect and not 0.99 < aspect < 1.01:
        wide = max(2, round(picture.shape[1] * float(aspect)))
        picture = np.asarray(
            cv2.resize(picture, (wide, picture.shape[0]), interpolation=cv2.INTER_LINEAR), np.uint8
        )
    quarters = round(getattr(frame, "rotation", 0) / 90) % 4
    return np.ascontiguousarray(np.rot90(picture, quarters)) if quarters else picture


def without_password(url: str) -> str:
    """The URL as it may be printed."""
    parts = urlsplit(url)
    if parts.username is None and parts.password is None:
        return url
    host = parts.netloc.rpartition("@")[2]
    return urlunsplit(parts._replace(netloc=f"…@{host}"))


def open_video(spec: str) -> tuple[Any, Any]:
    """Open a file or a URL and its first video stream. Raises `UserError` if there is none."""
    name = without_password(spec)
    if "://" not in spec and Path(spec).stat().st_size == 0:
        raise UserError(f"source {spec!r} is an empty file; accepted is a video file")
    try:
        container = av.open(spec, timeout=(_OPEN_S, _READ_S))
    except (av.error.FFmpegError, OSError, ValueError) as error:
        raise UserError(
            f"source {name!r} is not a video that can be read ({_cause(error)}); accepted is any video file that "
            "FFmpeg decodes"
        ) from error
    stream = next(iter(container.streams.video), None)
    codec: Any = None if stream is None else stream.codec_context  # None where FFmpeg has no decoder
    if stream is None or codec is None or codec.name in _TEXT_CODECS:
        container.close()
        raise UserError(f"source {name!r} holds no video; accepted is any video file that FFmpeg decodes")
    stream.thread_type = "AUTO"
    return container, stream


def _decoded(container: Any, stream: Any, *, spec: str) -> Generator[av.VideoFrame, None, None]:
    """Every frame that decodes, in presentation order; damage is skipped and reported once, at the end."""
    damaged, count, ended = 0, 0, ""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            break
        except av.error.FFmpegError as error:
            ended = f"; it breaks off before its end ({_cause(error)})"
            packet = None
        try:
            frames = packet.decode() if packet is not None else stream.codec_context.decode(None)
        except av.error.FFmpegError:
            damaged += 1
            frames = []
        count += len(frames)
        yield from frames
        if packet is None:
            break
    if not ended and count < 0.98 * stream.frames - 2:
        ended = f"; {count} of its {stream.frames} frames are there"
    if damaged or ended:
        _log.warning("%s: %d damaged packets were skipped%s", without_password(spec), damaged, ended)


def _rate(stream: Any) -> Fraction | None:
    rate = stream.average_rate or stream.guessed_rate or stream.base_rate
    return Fraction(rate) if rate else None


def _cause(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error)
