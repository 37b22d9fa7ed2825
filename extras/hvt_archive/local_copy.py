"""``--record-base``: the base stream in a Matroska file that any player opens, also after the process was killed.

A thread of its own writes, so that a slow or full card never holds up a frame. Where it fails the file ends there,
and the next keyframe after a pause begins another beside it.
"""

from __future__ import annotations

import contextlib
import io
import logging
import queue
import threading
import time
from fractions import Fraction
from pathlib import Path
from typing import IO, Self

import av
import av.error

from hvt_common.files import check_there
from hvt_common.runtime.failures import Failures, RetryPause, Turns
from hvt_common.runtime.process import joined
from hvt_common.values import AccessUnit

_log = logging.getLogger(__name__)

_PART = "local copy"
_MOST_QUEUED = 256
_CLOSE_S = 3.0
_MOST_NAMES = 10_000


class LocalCopy:
    """Keeps the items of `write`; never overwrites a file. ``wait``: blocks where the card is slower (lockstep).

    Access units that find no room in the queue are left out up to the next keyframe.
    """

    def __init__(
        self, path: Path, *, failures: Failures, wait: bool = False, pause: RetryPause | None = None
    ) -> None:
        self._path = path
        self._failures = failures
        self._wait = wait
        self._pause = pause or RetryPause()
        self._queue: queue.Queue[AccessUnit | None] = queue.Queue(_MOST_QUEUED)
        self._whole = False
        """Whether the queue holds all since a keyframe."""
        self._file: _MatroskaFile | None = None
        self._thread = threading.Thread(target=self._run, name="hvt-local-copy", daemon=True)
        self._thread.start()

    def write(self, unit: AccessUnit) -> None:
        """Hand over an access unit; returns at once."""
        self._whole |= unit.keyframe
        if not self._whole:
            return
        try:
            self._queue.put(unit, block=self._wait)
        except queue.Full:
            self._whole = False
            self._failures.failed(_PART, f"{self._path} takes no more than {_MOST_QUEUED} frames late")

    def close(self) -> None:
        """Write the queue and the index, and end the thread; a card that hangs is left behind."""
        with contextlib.suppress(queue.Full):
            self._queue.put(None, timeout=_CLOSE_S)
        if not joined(self._thread, left=self._queue.qsize, within_s=_CLOSE_S):
            self._failures.failed(_PART, f"{self._path} did not take the last frames within {_CLOSE_S:g} s")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def _run(self) -> None:
        turns = Turns(_PART, self._failures)
        while (unit := self._queue.get()) is not None:
            try:
                with turns:
                    self._append(unit)
            except Exception as error:  # noqa: BLE001 - it ends the copy, never the flight
                self._fail(error)
        try:
            if self._file is not None:
                self._file.close()
        except (av.error.FFmpegError, OSError) as error:
            self._fail(error)

    def _append(self, unit: AccessUnit) -> None:
        if begins := self._file is None:
            if not unit.keyframe or not self._pause.due(time.monotonic_ns()):
                return
            self._file = _MatroskaFile(*_opened(self._path))
        self._file.write(unit)
        if begins and self._file.path != self._path:  # not before: a full disk takes nothing, at each try
            _log.warning("--record-base %s is there already: this is %s", self._path, self._file.path)
        self._failures.works(_PART)

    def _fail(self, error: Exception) -> None:
        self._pause.failed(time.monotonic_ns())
        path = self._path if self._file is None else self._file.path
        self._failures.failed(
            _PART, f"{path} cannot be written ({getattr(error, 'strerror', None) or error})"
        )
        if self._file is not None:
            self._file.give_up()
            self._file = None


def _opened(path: Path) -> tuple[Path, IO[bytes]]:
    # The file by this name, or the first of name-2, name-3 … that is not there; a pipe or device as it is.
    if path.exists() and not path.is_file():
        return path, path.open("wb", buffering=0)
    for number in range(1, _MOST_NAMES):
        free = path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")
        with contextlib.suppress(FileExistsError):
            return free, free.open("xb", buffering=0)
    raise FileExistsError(f"there are {_MOST_NAMES} of it")


class _MatroskaFile:
    # One file: a remux, no second encode. Access units go in as they were sent, a keyframe first.

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        self.path = path
        self._file = file
        # Short clusters, each flushed when the next begins: a kill costs the last fifth of a second at 10 fps, and
        # the file stays whole.
        options = {"cluster_time_limit": "100", "flush_packets": "1"}
        self._container = av.open(file, "w", format="matroska", options=options)
        self._time_base = Fraction(1, 1000)
        self._stream: av.VideoStream | None = None
        self._start_ns = 0
        self._last_pts = -1
        self._count = 0

    def write(self, unit: AccessUnit) -> None:
        """Append an access unit; OSError or FFmpegError where that fails, or somebody has removed the file."""
        if self._stream is None:
            self._stream = self._open_stream(unit.data)
            self._start_ns = unit.capture_ns
        # Matroska counts milliseconds; two frames of a fast camera must not share one.
        pts = max(self._last_pts + 1, round((unit.capture_ns - self._start_ns) / 1e6))
        self._last_pts = pts
        packet = av.Packet(unit.data)
        packet.stream = self._stream
        packet.pts = packet.dts = pts
        packet.time_base = self._time_base
        packet.is_keyframe = unit.keyframe
        self._container.mux(packet)
        check_there(self._file.fileno(), self.path)
        self._count += 1

    def close(self) -> None:
        try:
            self._container.close()
        finally:
            self._file.close()

    def give_up(self) -> None:
        """Close it as it is; one that holds no frame is removed, unless it is a pipe or a device."""
        with contextlib.suppress(av.error.FFmpegError, OSError, ValueError):
            self.close()
        if not self._count and self.path.is_file():
            with contextlib.suppress(OSError):
                self.path.unlink()

    def _open_stream(self, keyframe: bytes) -> av.VideoStream:
        # The keyframe itself is the template: its parameter sets become the header of the container. (A stream
        # made by name would open an encoder of its own.)
        with av.open(io.BytesIO(keyframe), format="hevc") as template:
            stream = self._container.add_stream_from_template(template.streams.video[0])
        stream.time_base = self._time_base
        return stream
