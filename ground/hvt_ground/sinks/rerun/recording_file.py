"""One file of a recording, or a viewer's view of it: rows gathered in tables, static values, compaction."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

import rerun.blueprint as rrb
from rerun.chunk import Chunk

from hvt_common.errors import UserError
from hvt_ground.sinks.rerun.blueprint import class_chunk, legend_chunk
from hvt_ground.sinks.rerun.live_view import LiveRecording
from hvt_ground.sinks.rerun.overlays import Layer
from hvt_ground.sinks.rerun.rrd_file import RrdFile
from hvt_ground.sinks.rerun.tables import TABLE_BYTES, SizeLimit, Table, TableRow

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
        chunks = [*self._contexts.values(), *(table.take() for table in self._tables.values() if table)]
        self._contexts.clear()
        self._pending_bytes = 0
        if chunks:
            self._output.compact(chunks)

    def _add(self, row: TableRow) -> Chunk:
        assert row.at is not None, "a row has its time"
        table = self._tables.setdefault((row.path, row.columns), Table(row.path, row.columns))
        if not table:
            self._size_limit.logged_bytes += TABLE_BYTES
        self._pending_bytes += row.size_bytes
        self._size_limit.logged_bytes += row.size_bytes
        return table.add(*row.at, row.value)
