"""The folder of recordings: its index is written behind a queue, and what is due is removed there."""

from __future__ import annotations

import logging
import subprocess
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Self

from hvt_common.errors import UserError
from hvt_common.runtime.failures import Failures
from hvt_ground.recordings.database import Index
from hvt_ground.recordings.files import SCRATCH, claimed, described, is_claimed, is_own_name, remove_video
from hvt_ground.recordings.retention import Retention, due
from hvt_ground.recordings.row import RecordingRow
from hvt_ground.sinks import QueuedSink

__all__ = ["IndexWriter", "RecordingsFolder"]

_log = logging.getLogger(__name__)

_POLL_S = 60.0
_END_S = 3.0


class IndexWriter:
    """Writes the index; a sink for one thread. Files are removed when one was closed, or an item is None.

    At the beginning it is brought to what is in the folder: files that are gone are forgotten, those that a killed
    program left are read, and so are those that it does not know, as far as they have a name of ours.
    """

    path: Path | None = None
    """It is no recording."""

    def __init__(
        self, folder: Path, retention: Retention, *, now_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self._folder = folder
        self._retention = retention
        self._now_ns = now_ns
        self._refused: set[str] = set()
        """Files that could not be removed or stripped: said once."""
        self._index = Index(folder)
        try:
            self._compare()
            self._remove_due()
        except BaseException:
            self._index.close()
            raise

    def log(self, item: RecordingRow | None) -> None:
        """Note what is known of a file; None looks for what is due."""
        if item is not None:
            self._index.put(item)
        if item is None or item.whole:
            self._remove_due()

    def skipped(self, count: int) -> None:
        """The next row of a file says it all; one that was closed is read at the next start."""

    def close(self, hurry: threading.Event | None = None) -> None:  # noqa: ARG002 - it is always quick
        """Close the index; a second call does nothing."""
        self._index.close()

    def _compare(self) -> None:
        known = {row.file: row for row in self._index.rows()}
        there = {one.name for one in self._folder.glob("*.rrd") if one.is_file() and not one.is_symlink()}
        self._index.forget(known.keys() - there)
        for name in sorted(there):
            row, path = known.get(name), self._folder / name
            if row is None and not is_own_name(name):
                continue
            with claimed(path) as ours:
                if not ours:
                    continue
                path.with_name(name + SCRATCH).unlink(missing_ok=True)  # of a program that was killed
                if row is not None and row.whole:
                    continue
                if not path.stat().st_size:  # killed before the first byte
                    path.unlink()
                    continue
                found = described(path)
            if found is not None and (row is not None or name.startswith(f"hvt-{found.edge}-")):
                self._index.put(found)
            elif row is not None:
                self._index.put(replace(row, size_bytes=path.stat().st_size, whole=True))

    def _remove_due(self) -> None:
        if not (self._retention.limits or self._retention.video_age):
            return
        rows = {row.file: row for row in self._index.rows() if _is_plain(row.file)}
        gone = [name for name in rows if not (self._folder / name).exists()]
        self._index.forget(gone)
        for name in gone:
            del rows[name]
        in_use = {name for name in rows if is_claimed(self._folder / name)}
        found = due(list(rows.values()), self._retention, in_use=in_use, now_ns=self._now_ns())
        for name in found.remove:
            if self._done(name, "removed", (self._folder / name).unlink):
                self._index.forget([name])
        for name in found.strip:
            path = self._folder / name
            if self._done(name, "stripped of its video", partial(remove_video, path)):
                self._index.put(replace(rows[name], video=False, size_bytes=path.stat().st_size))

    def _done(self, name: str, what: str, do: Callable[[], None]) -> bool:
        try:
            with claimed(self._folder / name) as ours:
                if not ours:
                    return False
                do()
        except (OSError, UserError, subprocess.SubprocessError) as error:
            if name not in self._refused:
                self._refused.add(name)
                _log.warning("recording %s cannot be %s: %s", name, what, error)
            return False
        return True


class RecordingsFolder:
    """The index of a folder for all sessions of a ground; a sink for any thread. Nothing happens before `open`.

    Close it after those that tell it of their files.
    """

    def __init__(self, folder: Path | None, retention: Retention, *, failures: Failures) -> None:
        self._folder = folder
        self._retention = retention
        self._failures = failures
        self._sink: QueuedSink[RecordingRow | None] | None = None
        self._stop = threading.Event()
        self._clock = threading.Thread(target=self._poll, name="hvt-recordings", daemon=True)

    def open(self) -> None:
        """Begin; the folder is there now."""
        folder = self._folder
        if folder is not None:
            self._sink = QueuedSink(
                "recordings index", lambda: IndexWriter(folder, self._retention), failures=self._failures
            )
            self._clock.start()

    def log(self, item: RecordingRow) -> None:
        """Note what is known of a file."""
        if self._sink is not None:
            self._sink.log(item)

    def close(self, hurry: threading.Event | None = None) -> None:  # noqa: ARG002 - it is always quick
        """Write what is queued, within a few seconds."""
        self._stop.set()
        if self._sink is not None:
            self._clock.join()
            self._sink.join(time.monotonic() + _END_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _poll(self) -> None:
        """Files grow old while nobody flies, too."""
        while self._sink is not None and not self._stop.wait(_POLL_S):
            self._sink.log(None)


def _is_plain(name: str) -> bool:
    """Whether a name is one of a file in the folder itself, whatever somebody wrote into the index."""
    return name == Path(name).name and name.endswith(".rrd") and "\0" not in name
