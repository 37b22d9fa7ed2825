"""A Rerun recording on disk that is whole at every moment, and small.

Rerun stores chunks: a table of rows of one entity. A chunk costs about 1.3 kB before its first value and a quarter
of a kB for each further column, as much as half an access unit at 300 kbps; so rows must be gathered. A recording
that gathers in memory loses what it gathered when the process is killed. `RrdFile` does both: each row is
appended at once as a chunk of its own (the *append log*, at the end of the file), and when the append log's rows have
become ``compact_bytes``, the same rows are written again as one chunk a table, over the append log (*compaction*).

What is on disk is a plain RRD stream without a footer: the SDK keeps a footer's manifest in memory for as long as
it records (a footer costs 1.6 kB a chunk, too). `add_footer` adds one at the end.
"""

from __future__ import annotations

import logging
import os
import struct
import subprocess
from collections.abc import Sequence
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import Chunk

from hvt_common.errors import UserError
from hvt_ground.sinks.rerun.sdk import (
    new_recording,
    release_recordings,
    send_blueprint,
    viewer_environment,
    viewer_program,
)

__all__ = ["FOOTER_GROWTH", "RrdFile", "add_footer"]

_log = logging.getLogger(__name__)

_STREAM_HEADER_BYTES = 12  # "RRF2", version, compression and serialisation
_MESSAGE_HEADER = struct.Struct("<QQ")  # kind, length of what follows
_END = 0
_LARGEST_BYTES = 64 * 2**20
"""About ten minutes at 800 kbps. The tool holds the file in memory, and Ctrl-C is answered within three seconds; a
larger recording opens without a footer just as well."""
_PATIENCE_S = 2.0
FOOTER_GROWTH = 1.12
"""How large a file with a footer may be over the one without: some 70 kB, whatever the length of the flight, are too
much for one of a few seconds."""


class RrdFile:
    """A recording on disk; each call has written its bytes when it returns.

    Raises `UserError` where the file cannot be created, or (later) written any further.
    """

    live = False

    def __init__(
        self, path: Path, *, recording_id: str, name: str, footer_growth: float = FOOTER_GROWTH
    ) -> None:
        self._path = path
        self._footer_growth = footer_growth
        self._file = _created(path)
        self._recording = new_recording(recording_id)
        self._stream = rr.binary_stream(self._recording)
        self._recording.send_recording_name(name)
        self._compacted_bytes = 0
        self._size_bytes = 0

    @property
    def size_bytes(self) -> int:
        """The size of the file so far."""
        return self._size_bytes if self._file >= 0 else self._path.stat().st_size

    def open(self, screen: rrb.Blueprint, chunks: Sequence[Chunk]) -> None:
        """Begin with the screen, made active when the recording is opened, and what holds for all of it."""
        send_blueprint(self._recording, screen)
        self._recording.send_chunks(chunks)
        stream = self._stream.read() or b""
        self._write(stream[:_STREAM_HEADER_BYTES] + _messages(stream), at=0)
        self._compacted_bytes = self._size_bytes

    def write(self, chunks: Sequence[Chunk]) -> None:
        """Append chunks to the log at the end of the file."""
        self._write(self._encoded(chunks), at=self._size_bytes)

    def compact(self, chunks: Sequence[Chunk]) -> None:
        """Replace the append log by ``chunks``, which say the same in fewer bytes, and begin a new one."""
        self._write(self._encoded(chunks), at=self._compacted_bytes)
        self._compacted_bytes = self._size_bytes

    def close(self, *, quickly: bool) -> None:
        """Close the file, with a footer unless ``quickly``, and release the SDK's stream."""
        os.close(self._file)
        self._file = -1
        if not quickly:
            add_footer(self._path, growth=self._footer_growth)
        self._recording.disconnect()
        self._stream.read()  # its own farewell, or the SDK warns that it was dropped
        del self._stream, self._recording
        release_recordings()

    def _encoded(self, chunks: Sequence[Chunk]) -> bytes:
        """The chunks as messages, LZ4-compressed by the SDK."""
        self._recording.send_chunks(chunks)
        return _messages(self._stream.read() or b"")

    def _write(self, data: bytes, *, at: int) -> None:
        try:
            end = at
            while data:
                written = os.pwrite(self._file, data, end)
                end += written
                data = data[written:]
            if end < self._size_bytes:
                os.ftruncate(self._file, end)
        except OSError as error:
            raise UserError(
                f"recording {self._path} cannot be written any further: {error.strerror}"
            ) from error
        self._size_bytes = end


def _messages(stream: bytes) -> bytes:
    """What the SDK encoded, without the stream's header and footer."""
    end = at = _STREAM_HEADER_BYTES
    while at < len(stream):
        kind, length = _MESSAGE_HEADER.unpack_from(stream, at)
        if kind == _END:
            break
        at += _MESSAGE_HEADER.size + length
        end = at
    return stream[_STREAM_HEADER_BYTES:end]


def _created(path: Path) -> int:
    """A file descriptor of a new, empty file."""
    if path.is_dir():
        raise UserError(
            f"recording {path} is a folder: give the name of a file in it, such as {path / 'flight.rrd'}"
        )
    if not path.parent.is_dir():
        raise UserError(f"recording {path} cannot be created: its folder {path.parent} does not exist")
    try:
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise UserError(f"recording {path} cannot be created: {error.strerror}") from error


def add_footer(path: Path, *, growth: float = FOOTER_GROWTH) -> bool:
    """Rewrite the file with a footer, whole or not at all; False where that was not done.

    It is not done where the file would become larger than ``growth`` times what it is.

    The SDK's own program does it (60 ms for 1.3 MB); it also gathers the video's chunks by keyframe.
    """
    if path.stat().st_size > _LARGEST_BYTES:
        return False
    scratch = path.with_name(path.name + ".part")
    command = [str(viewer_program()), "rrd", "optimize", str(path), "-o", str(scratch)]
    try:
        subprocess.run(  # noqa: S603 - the SDK's own program, no shell
            command, env=viewer_environment(), capture_output=True, check=True, timeout=_PATIENCE_S
        )
        if scratch.stat().st_size > growth * path.stat().st_size:
            scratch.unlink()
            return False
        scratch.replace(path)
    except (OSError, subprocess.SubprocessError) as error:
        _log.info("%s stays without a footer: %s", path, error)
        scratch.unlink(missing_ok=True)
        return False
    return True
