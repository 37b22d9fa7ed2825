"""Keep the base stream in a Matroska file that any player opens, also after the process was killed."""

from __future__ import annotations

import io
import logging
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Self

import av
import av.error

from hvt_common.errors import UserError
from hvt_common.values import AccessUnit

__all__ = ["BaseRecorder"]

_log = logging.getLogger(__name__)


class BaseRecorder:
    """A remux, no second encode: access units go in as they were sent."""

    def __init__(self, path: Path) -> None:
        self._time_base = Fraction(1, 1000)
        self._start_ns: int | None = None
        self._last_pts = -1
        # Short clusters, each flushed when the next begins: a kill costs the last fifth of a second at 10 fps, and
        # the file stays whole.
        options = {"cluster_time_limit": "100", "flush_packets": "1"}
        self._path = path
        self._container = av.open(str(path), "w", format="matroska", options=options)
        self._stream: av.VideoStream | None = None

    def write(self, unit: AccessUnit) -> None:
        """Append an access unit, a keyframe first. Raises `UserError` where the file cannot be written."""
        if self._stream is None:
            self._stream = self._open_stream(unit.data)
            self._start_ns = unit.capture_ns
        assert self._start_ns is not None
        # Matroska counts milliseconds; two frames of a fast camera must not share one.
        pts = max(self._last_pts + 1, round((unit.capture_ns - self._start_ns) / 1e6))
        self._last_pts = pts
        packet = av.Packet(unit.data)
        packet.stream = self._stream
        packet.pts = packet.dts = pts
        packet.time_base = self._time_base
        packet.is_keyframe = unit.keyframe
        try:
            self._container.mux(packet)
        except (av.error.FFmpegError, OSError) as error:
            raise UserError(
                f"--record-base {self._path} cannot be written ({error.strerror}): name a file that can"
            ) from None

    def close(self) -> None:
        """Write the index and close the file."""
        try:
            self._container.close()
        except (av.error.FFmpegError, OSError) as error:
            _log.warning("%s has no index: %s", self._path, error.strerror)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _open_stream(self, keyframe: bytes) -> av.VideoStream:
        # The keyframe itself is the template: its parameter sets become the header of the container. (A stream
        # made by name would open an encoder of its own.)
        with av.open(io.BytesIO(keyframe), format="hevc") as template:
            stream = self._container.add_stream_from_template(template.streams.video[0])
        stream.time_base = self._time_base
        return stream
