"""A Rerun recording on disk that is whole at every moment, and small.

Rerun stores chunks: a table of rows of one entity. A chunk costs about 1.3 kB before its first value and a quarter
of a kB for each further column, as much as half an access unit at 300 kbps; so rows must be gathered. A recording
that gathers rows in memory loses them when the process is killed. `RrdFile` does both: each row is
appended at once as a chunk of its own (the *append log*, at the end of the file), and when the append log's rows have
become ``compact_bytes``, the same rows are written again as few chunks, over the append log (*compaction*).

While it grows the file is a plain RRD stream without a footer: the SDK keeps a footer's table, a row for each chunk,
in memory for as long as it records. At the end the SDK writes the compacted chunks once more, with a footer.
"""

from __future__ import annotations

import logging
import os
import shutil
import struct
import threading
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import Chunk, RrdReader

from hvt_common.errors import UserError, telling
from hvt_common.files import check_there, created, has_nothing
from hvt_common.runtime.failures import Turns
from hvt_ground.sinks.rerun.blueprint import class_chunk, legend_chunk
from hvt_ground.sinks.rerun.live_view import LiveRecording
from hvt_ground.sinks.rerun.overlays import Layer
from hvt_ground.sinks.rerun.sdk import RecordingId, new_recording, releasing_recordings, send_blueprint
from hvt_ground.sinks.rerun.tables import TABLE_BYTES, SizeLimit, Table, TableRow

_log = logging.getLogger(__name__)

STREAM_HEADER_BYTES = 12  # the magic number, version, compression and serialisation
MESSAGE_HEADER = struct.Struct("<QQ")  # kind, length of the rest
END = 0
"""The kind of a recording's footer."""
_SPARE_BYTES = 2 * 2**20
_FLUSH_S = 10.0
_filters = threading.Lock()
"""Warning filters are the process's."""


class RrdFile:
    """A recording on disk; each call has written its bytes when it returns.

    It opens with ``screen`` and the static chunks. Until it is closed its file is locked (flock), which tells
    others that it is written to, in whichever process, and ends with the process. Raises `UserError` where the file
    cannot be created, or (later) written any further: earlier writes are whole then.
    """

    def __init__(
        self, path: Path, recording_id: RecordingId, screen: rrb.Blueprint, chunks: Sequence[Chunk]
    ) -> None:
        self.path = path
        self._id = recording_id
        self._screen = screen
        self._compacted_bytes = self.size_bytes = 0
        fresh = has_nothing(path)
        self._file = _created(path)
        self._recording = new_recording(recording_id)
        self._stream = rr.binary_stream(self._recording)
        self._recording.send_recording_name(recording_id.edge)
        try:
            send_blueprint(self._recording, recording_id, screen)
            self._recording.send_chunks(chunks)
            stream = self._stream.read() or b""
            self._write(stream[:STREAM_HEADER_BYTES] + _messages(stream), at=0)
        except UserError:
            self._release()
            os.close(self._file)
            if fresh:
                path.unlink(missing_ok=True)
            raise
        self._compacted_bytes = self.size_bytes

    def write(self, chunks: Sequence[Chunk]) -> None:
        """Append chunks to the log at the end of the file."""
        self._write(self._encoded(chunks), at=self.size_bytes)

    def compact(self, chunks: Sequence[Chunk]) -> None:
        """Replace the append log by ``chunks``, which say the same in fewer bytes, and begin a new one."""
        try:
            self._write(self._encoded(chunks), at=self._compacted_bytes)
        finally:  # where it failed the log stays: nothing else has its rows
            self._compacted_bytes = self.size_bytes

    def show(self, screen: rrb.Blueprint) -> None:
        """Open with another screen from now on; right after `compact`, which would write over it."""
        self._screen = screen
        send_blueprint(self._recording, self._id, screen)
        self._write(_messages(self._stream.read() or b""), at=self.size_bytes)
        self._compacted_bytes = self.size_bytes

    def close(self, hurry: threading.Event | None) -> None:
        """Add a footer, unless ``hurry`` is set, close the file and release the SDK's stream."""
        removed = os.fstat(self._file).st_nlink == 0
        self._release()
        try:
            if not removed and self.path.is_file() and not (hurry and hurry.is_set()):
                self._add_footer(hurry)
        finally:
            os.close(self._file)  # and with it the lock

    def _release(self) -> None:
        with releasing_recordings():
            self._recording.disconnect()
            self._stream.read()  # its own farewell, or the SDK warns that it was dropped
            del self._stream, self._recording

    def _add_footer(self, hurry: threading.Event | None) -> None:
        # Write all once more through the SDK, which adds a footer; whole or not at all.
        scratch = self.path.with_name(self.path.name + ".part")
        if shutil.disk_usage(self.path.parent).free < 2 * self.size_bytes + _SPARE_BYTES:
            _log.warning("recording %s has no footer: the disk has no room for one", self.path)
            return  # the SDK never returns from a full disk
        recording = new_recording(self._id)
        try:
            recording.save(scratch)
            send_blueprint(recording, self._id, self._screen)
            for chunk in open_rrd(self.path).stream():
                if hurry and hurry.is_set():
                    return
                recording.send_chunks([chunk])
                recording.flush(timeout_sec=_FLUSH_S)  # or all would be in memory
                Turns.goes_on()
            recording.disconnect()
            scratch.replace(self.path)
            self.size_bytes = self.path.stat().st_size
        except (OSError, RuntimeError, ValueError) as error:
            _log.warning("recording %s has no footer: %s", self.path, error)
        finally:
            with releasing_recordings():
                recording.disconnect()
                del recording
            scratch.unlink(missing_ok=True)

    def _encoded(self, chunks: Sequence[Chunk]) -> bytes:
        self._recording.send_chunks(chunks)
        return _messages(self._stream.read() or b"")

    def _write(self, data: bytes, *, at: int) -> None:
        end = at
        try:
            check_there(self._file, self.path)
            while data:
                written = os.pwrite(self._file, data, end)
                end += written
                data = data[written:]
            if end < os.fstat(self._file).st_size:
                os.ftruncate(self._file, end)
        except OSError as error:
            if data and end > at:  # half a message; the next write begins there, should it not go
                self.size_bytes = at
                with suppress(OSError):
                    os.ftruncate(self._file, at)
            raise UserError(
                f"recording {self.path} cannot be written any further: {error.strerror}"
            ) from error
        self.size_bytes = end


def open_rrd(path: Path) -> RrdReader:
    """A reader of a file, which may be none of ours; of one with or without a footer."""
    with _filters, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there is no footer
        return RrdReader(path)


def _messages(stream: bytes) -> bytes:
    end = at = STREAM_HEADER_BYTES
    while at < len(stream):
        kind, length = MESSAGE_HEADER.unpack_from(stream, at)
        if kind == END:
            break
        at += MESSAGE_HEADER.size + length
        end = at
    return stream[STREAM_HEADER_BYTES:end]


def _created(path: Path) -> int:
    if path.is_dir():
        raise UserError(
            f"recording {path} is a folder: give the name of a file in it, such as {path / 'flight.rrd'}"
        )
    if not path.parent.is_dir():
        raise UserError(f"recording {path} cannot be created: its folder {path.parent} does not exist")
    with telling(f"recording {path} cannot be created: "):
        return created(path)


_CLASS_BYTES = 40
"""Cost of a class each time that names and colours are written: they go with the next compaction."""


class RecordingFile:
    """Takes rows whose time is known. Written rows are in the file; ``size_limit`` is told their cost."""

    def __init__(self, output: RrdFile | LiveRecording, *, size_limit: SizeLimit, compact_bytes: int) -> None:
        self.path: Path | None = output.path if isinstance(output, RrdFile) else None
        self.closed = False
        self.frames = 0
        """Access units, stored ones too."""
        self.samples = self.first_sample = self.last_sample = 0
        """Live access units, and the frames of the first and the last."""
        self._output = output
        self._size_limit = size_limit
        self._compact_bytes = compact_bytes
        self._pending_bytes = 0
        self._tables: dict[tuple[str, str], Table] = {}
        self._contexts: dict[str, Chunk] = {}
        """Static values since the last compaction, by entity."""
        self._classes_written: dict[Layer, int] = {}
        self._legend: tuple[str, ...] = ()

    @property
    def size_bytes(self) -> int:
        """The size of the file so far; 0 without one."""
        return self._output.size_bytes

    def count(self, frame_index: int, *, stored: bool) -> None:
        self.frames += 1
        if stored:
            return
        if not self.samples:
            self.first_sample = frame_index
        self.last_sample = frame_index
        self.samples += 1

    def write(self, rows: Sequence[TableRow | Chunk]) -> None:
        chunks = [one if isinstance(one, Chunk) else self._add(one) for one in rows]
        try:
            if chunks:
                self._output.write(chunks)
        except UserError:
            if self.path is None:
                raise
            self._compact()  # the disk may have room for the same in fewer bytes, these rows included
        if self._pending_bytes >= self._compact_bytes:
            self._compact()

    def show(self, screen: rrb.Blueprint) -> None:
        """Open with another screen from now on."""
        self._compact()
        self._output.show(screen)

    def new_classes(
        self, layer: Layer, path: str, class_ids: Mapping[tuple[str, int], int], *, size: tuple[int, int]
    ) -> list[Chunk]:
        """Names and colours to write, where some are new to the layer in this file."""
        if self._classes_written.get(layer, 0) == len(class_ids):
            return []
        self._classes_written[layer] = len(class_ids)
        self._pending_bytes += _CLASS_BYTES * len(class_ids)
        self._contexts[layer] = class_chunk(path, class_ids)
        shown = tuple(dict.fromkeys(name for name, _ in class_ids))
        if shown == self._legend:
            return [self._contexts[layer]]
        self._legend = shown
        self._contexts["legend"] = legend_chunk(shown, size=size)
        return [self._contexts[layer], self._contexts["legend"]]

    def close(self, hurry: threading.Event | None = None, *, session: Chunk | None = None) -> None:
        """Write the session panel anew, compact the rest and close; a second call does nothing.

        Once ``hurry`` is set no footer is added, which may take seconds.
        """
        if self.closed:
            return
        self.closed = True
        try:
            if session is not None:
                self._output.write([session])
                self._contexts["session"] = session
            self._compact()
        finally:
            self._output.close(hurry)

    def _compact(self) -> None:
        chunks = [
            *self._contexts.values(),
            *(chunk for table in self._tables.values() for chunk in table.take()),
        ]
        self._contexts.clear()
        self._pending_bytes = 0
        if chunks:
            self._output.compact(chunks)

    def _add(self, row: TableRow) -> Chunk:
        assert row.at is not None, "a row has its time"
        table = self._tables.setdefault((row.path, row.columns), Table(row.path, row.columns))
        before = table.chunk_count
        chunk = table.add(*row.at, row.value, size_bytes=row.size_bytes)
        self._pending_bytes += row.size_bytes
        self._size_limit.logged_bytes += row.size_bytes + TABLE_BYTES * (table.chunk_count - before)
        return chunk
