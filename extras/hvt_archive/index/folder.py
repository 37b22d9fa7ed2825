"""The folder of recordings: its index is written behind a queue, and expired files are removed there."""

from __future__ import annotations

import logging
import os
import subprocess
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from hvt_archive.index.database import Index
from hvt_archive.index.files import SCRATCH, begins_as_of, claimed, described, is_claimed, remove_video
from hvt_archive.index.retention import Retention, due, in_name
from hvt_common.errors import UserError
from hvt_common.runtime.clock import Moment, boot_id, since_boot_ns
from hvt_common.runtime.failures import Failures
from hvt_common.runtime.process import with_lower_priority
from hvt_common.units import SECOND_NS
from hvt_ground.control import EdgeClient
from hvt_ground.extras import Service
from hvt_ground.recordings.row import RecordingRow
from hvt_ground.sinks import QueuedSink, SinkWriter

_log = logging.getLogger(__name__)

_POLL_S = 60.0
_BEHIND_S = 0.05
"""After each file that is read; a flight's rows go before the next."""
_AGAIN_NS = 3600 * SECOND_NS
_END_S = 3.0
_UNREAD = ""
"""The session of a row that has but the size of its file: the rest of it is not known."""
_SET_NS = 10 * SECOND_NS
_DOUBT_NS = 3600 * SECOND_NS
"""For this long after the clock was set no file goes for its age: the clock may be set again."""


class IndexWriter(SinkWriter[RecordingRow | None]):
    """Writes the index; a sink for one thread. Files are removed when one was closed, or an item is None.

    At the beginning it is compared with the folder: files that are gone are forgotten. Those that a killed program
    left, and those of a name of ours that it does not know, are ``unread``: thousands take minutes. A None reads one
    of them, but once a minute it looks. Before that they count as far as their first bytes say whose they are.

    Live video goes before the long jobs, to read a file or to remove its video. Once ``stop`` is set none is waited
    for, and a later writer does it.

    A wall clock may be years off, and be set at any time: ages count the time since the index learned of a file,
    which is that of the boot's own clock (`Index.pass_time`). For its age one file goes at a time.
    """

    path: Path | None = None
    """It is no recording."""

    def __init__(
        self,
        folder: Path,
        retention: Retention,
        *,
        stop: threading.Event | None = None,
        now_ns: Callable[[], int] = time.time_ns,
        since_boot: Callable[[], tuple[str, int]] = lambda: (boot_id(), since_boot_ns()),
    ) -> None:
        self._folder = folder
        self._retention = retention
        self._stop = stop or threading.Event()
        self._now_ns = now_ns
        self._since_boot = since_boot
        self._doubted_ns: int | None = None
        """When the clock was found to have been set, by ``since_boot``."""
        self._refused: dict[str, int] = {}
        """Files that could not be removed or stripped, and when that was tried last (steady time): said once."""
        self.unread: list[str] = []
        """The oldest first, by their names: they are read from the newest on."""
        self._index = Index(folder)
        try:
            now = self._pass_time()
            self._compare(now.unix_ns)
            self._remove_due(now)
        except BaseException:
            self._index.close()
            raise

    def log(self, item: RecordingRow | None) -> None:
        """Note the facts of a file; None looks for expired files, or reads one."""
        now = self._pass_time()
        if item is not None:
            self._index.put(replace(item, written_ns=now.unix_ns))
        elif self.unread and now.steady_ns - self._looked_ns < _POLL_S * SECOND_NS:
            self._read(self.unread.pop(), now.unix_ns)
            return
        if item is None or item.whole:
            self._remove_due(now)

    def close(self, hurry: threading.Event | None = None) -> None:  # noqa: ARG002 - it is always quick
        self.unread.clear()
        self._index.close()

    def _pass_time(self) -> Moment:
        # Before anything is noted or judged: by the present clock, all files have the age they have.
        now = Moment(self._now_ns(), *self._since_boot())
        moved_ns = self._index.pass_time(now, most_ns=self._retention.trusted_ns)
        if abs(moved_ns) > _SET_NS:
            self._doubted_ns = now.steady_ns
        return now

    def _compare(self, now_ns: int) -> None:
        known = {row.file: row for row in self._index.rows(classes=False)}
        there = {one.name for one in self._folder.glob("*.rrd") if one.is_file() and not one.is_symlink()}
        self._index.forget(known.keys() - there)
        for name in sorted(there, key=lambda name: (in_name(name)[1], name)):
            row, path, (edge, _) = known.get(name), self._folder / name, in_name(name)
            if row is None and not edge:
                continue
            with claimed(path) as ours:
                if not ours:
                    continue
                path.with_name(name + SCRATCH).unlink(missing_ok=True)  # of a program that was killed
                if row is not None and row.whole:
                    continue
                size_bytes = path.stat().st_size
                if not size_bytes:  # killed before the first byte
                    path.unlink()
                    continue
                if row is None and begins_as_of(edge, path):
                    # Nobody saw how old one is that is met for the first time.
                    backlog = "-backlog" in name
                    row = RecordingRow(
                        name, edge, _UNREAD, None, None, now_ns, size_bytes, 0, 0, backlog=backlog
                    )
                    self._index.put(row)
                elif row is not None:
                    self._index.change(name, size_bytes=size_bytes)
            self.unread.append(name)

    def _read(self, name: str, now_ns: int) -> None:
        path = self._folder / name
        with claimed(path) as ours:
            if not ours:
                return
            found = with_lower_priority(partial(described, path), stop=self._stop)
            if self._stop.is_set():
                return
            row = self._index.row(name)
            if found is not None and (row is not None or name.startswith(f"hvt-{found.edge}-")):
                self._index.put(replace(found, written_ns=now_ns if row is None else row.written_ns))
            elif row is not None and row.session == _UNREAD:
                self._index.forget([name])
            elif row is not None:
                self._index.change(name, size_bytes=path.stat().st_size, whole=True)

    def _remove_due(self, now: Moment) -> None:
        self._looked_ns, retention = now.steady_ns, self._retention
        if not (retention.limits or retention.video_age):
            return
        rows = {row.file: row for row in self._index.rows(classes=False) if _is_plain(row.file)}
        there = {one.name for one in os.scandir(self._folder)}
        self._index.forget(rows.keys() - there)
        found = due(
            [row for name, row in rows.items() if name in there],
            retention,
            in_use=lambda name: is_claimed(self._folder / name),  # looked up for those in question alone
            now_ns=now.unix_ns,
        )
        for name in found.remove:
            self._remove(
                name, "all are larger than --keep allows, and it is the oldest of an edge above its share"
            )
        if self._doubted_ns is not None and now.steady_ns - self._doubted_ns < _DOUBT_NS:
            return
        any(self._remove(name, "it is older than --keep allows") for name in found.outdated)
        any(
            self._stop.is_set() or self._strip(rows[name]) for name in found.strip if self._may_try(name, now)
        )

    def _may_try(self, name: str, now: Moment) -> bool:
        # A file of which nothing can be read takes seconds each time; room on the disk may come back.
        return now.steady_ns - self._refused.get(name, now.steady_ns - _AGAIN_NS) >= _AGAIN_NS

    def _remove(self, name: str, why: str) -> bool:
        if not self._done(name, "removed", (self._folder / name).unlink):
            return False
        self._index.forget([name])
        _log.warning("recording %s is removed: %s", name, why)
        return True

    def _strip(self, row: RecordingRow) -> bool:
        path = self._folder / row.file
        strip = partial(self._done, row.file, "stripped of its video", partial(remove_video, path))
        if not with_lower_priority(strip, stop=self._stop):
            return False
        self._index.change(row.file, size_bytes=path.stat().st_size, video=False)
        _log.warning("the video of recording %s is removed: it is older than --keep-video", row.file)
        return True

    def _done(self, name: str, what: str, do: Callable[[], None]) -> bool:
        try:
            with claimed(self._folder / name) as ours:
                if not ours:
                    return False
                do()
        except (OSError, UserError, subprocess.SubprocessError) as error:
            if name not in self._refused:
                _log.warning("recording %s cannot be %s: %s", name, what, error)
            self._refused[name] = self._since_boot()[1]
            return False
        return True


class RecordingsFolder(Service):
    """The index of a folder for all sessions of a ground. Nothing happens before `begin`."""

    def __init__(self, folder: Path, retention: Retention, *, failures: Failures) -> None:
        self._folder = folder
        self._retention = retention
        self._failures = failures
        self._sink: QueuedSink[RecordingRow | None] | None = None
        self._writer: IndexWriter | None = None
        self._stop = threading.Event()
        self._clock = threading.Thread(target=self._poll, name="hvt-recordings", daemon=True)

    def begin(self, client: EdgeClient | None = None) -> None:  # noqa: ARG002 - no edge is asked
        self._sink = QueuedSink("recordings index", self._opened, failures=self._failures, unhurried=True)

    def _opened(self) -> IndexWriter:
        self._writer = IndexWriter(self._folder, self._retention, stop=self._stop)
        if self._clock.ident is None:
            self._clock.start()
        return self._writer

    def recorded(self, row: RecordingRow) -> None:
        if self._sink is not None:
            self._sink.log(row)

    def __exit__(self, *_: object) -> None:
        """Write the queue."""
        self._stop.set()
        if self._sink is not None:
            if self._clock.ident is not None:
                self._clock.join()
            self._sink.join(_END_S)

    def _poll(self) -> None:
        # Files grow old while nobody flies, too.
        while not self._stop.wait(self._pause_s()):
            if self._sink is not None and self._sink.idle and self._sink.is_open():
                self._sink.log(None)

    def _pause_s(self) -> float:
        return _BEHIND_S if self._writer is not None and self._writer.unread else _POLL_S


def _is_plain(name: str) -> bool:
    # Whether a name is one of a file in the folder itself, whatever somebody wrote into the index.
    return name == Path(name).name and name.endswith(".rrd") and "\0" not in name
