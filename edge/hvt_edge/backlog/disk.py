"""The store on disk: ``FOLDER/<session id>/`` with ``info``, stills one a file, and segments of the base stream.

Stills are written under another name first, segments only grow (`segment`). Nothing is forced to the platter: a kill
costs nothing of what was written, a power cut what the system had still in memory.

What has to go where the store is full, least useful first:

* **Video, oldest first**, as long as it takes more than three quarters of the room. Whoever comes back to the link
  wants to know what happened, and the way to now is closer from a short while ago than from an hour ago.
* **Stills by their worth**: the utility that their method gave, halved with each ten minutes. They are a hundredth
  of the video's bytes and most of what it shows of an object, so a quarter of the room holds those of a long time.

So video takes all of the room while there are few stills, and the best stills outlive the video around them.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import re
from bisect import insort
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import av.error

from hvt_common.errors import UserError
from hvt_common.protocol.messages import BacklogKind, WireError
from hvt_common.values import AccessUnit
from hvt_edge.backlog.entry import (
    Entry,
    Key,
    base_entry,
    base_name,
    found,
    info_entry,
    object_of,
    still_entry,
    still_name,
    unlink,
    write_whole,
)
from hvt_edge.backlog.segment import SEGMENT_NS, DamagedError, OpenSegment, blocks

__all__ = ["SEGMENT_NS", "Folder", "check_folder", "default_folder"]

_log = logging.getLogger(__name__)

_VIDEO_SHARE = 0.75
_OURS = (".still", ".mkv", ".index", ".part")
_SESSION = re.compile(r"[0-9a-f]{16}")


def default_folder(edge_id: str) -> Path:
    """Where programs keep what outlives them: ``$XDG_STATE_HOME`` or ``~/.local/state``, then ``hvt/<edge>``."""
    state = os.environ.get("XDG_STATE_HOME", "")
    if Path(state).is_absolute():
        return Path(state) / "hvt" / edge_id
    try:
        return Path.home() / ".local" / "state" / "hvt" / edge_id
    except RuntimeError:
        raise UserError(
            "what is seen while the link is away has no place, because there is no home folder: give --store-folder, "
            "or --store 0 to keep nothing"
        ) from None


def check_folder(path: Path) -> None:
    """Raise `UserError` now where a store could not be made in mid-flight; makes nothing."""
    try:
        there = next(one for one in (path.absolute(), *path.absolute().parents) if one.exists())
        usable = there.is_dir() and os.access(there, os.W_OK | os.X_OK)
    except OSError:  # a part of the path may not be looked into
        usable, there = False, path
    if not usable:
        raise UserError(
            f"--store-folder {path} cannot be used, because {there} is no folder that can be written: name another, "
            "or give --store 0 to keep nothing"
        )


class Folder:
    """The objects of this session and of those before it, in bounded room. For one thread; counts may be read by any.

    ``path`` is made when something is stored for the first time; ``max_bytes`` counts whole blocks. ``info()`` is
    this session's `Info`, packed. What was captured before ``oldest_ns`` is dropped when the folder is opened.
    """

    def __init__(
        self,
        path: Path,
        *,
        max_bytes: int,
        session_id: int,
        info: Callable[[], bytes],
        oldest_ns: int = 0,
    ) -> None:
        self.path = path
        self._max_bytes = max_bytes
        self._session_id = session_id
        self._info = info
        self._lock: BinaryIO | None = None
        self._ranked: dict[BacklogKind, list[tuple[float, int, int]]] = {kind: [] for kind in BacklogKind}
        """(`Entry.rank`, session, number) by kind: stills from the least worth, segments from the oldest."""
        self._entries: dict[Key, Entry] = {}
        self._disk_bytes = dict.fromkeys(BacklogKind, 0)
        self._objects: Counter[int] = Counter()
        """Stills and segments by session."""
        self._span_ns = 0
        self._open: OpenSegment | None = None
        self._oldest_ns = oldest_ns
        self.locked_out = False
        """Another process has the folder; `enter` tries again."""
        self.evicted_stills = 0
        self.evicted_segments = 0
        self.damaged = 0
        """Entries that were dropped because they could not be read."""
        if path.is_dir():
            self.enter()

    @property
    def disk_bytes(self) -> int:
        """All that is here, the open segment included."""
        return sum(self._disk_bytes.values()) + (0 if self._open is None else self._open.disk_bytes)

    @property
    def stills(self) -> int:
        """How many are stored."""
        return len(self._ranked[BacklogKind.STILL])

    @property
    def segments(self) -> int:
        """How many are stored, without the open one."""
        return len(self._ranked[BacklogKind.BASE])

    @property
    def open_segments(self) -> int:
        """1 while frames are being appended, else 0."""
        return int(self._open is not None)

    @property
    def span_ns(self) -> int:
        """Length of the video that is stored."""
        return self._span_ns + (0 if self._open is None else self._open.span_ns)

    def enter(self) -> None:
        """Take over what earlier runs have stored; where another edge has the folder, it is `locked_out`.

        It may be a predecessor of this one that is about to end, so whoever stores or sends tries again.
        Raises OSError.
        """
        said = self.locked_out
        try:
            self._lock_up()
        except BlockingIOError as error:
            self.locked_out = True
            if not said:
                _log.warning("%s is in use: %s", self.path, error.strerror)
            return
        self.locked_out = False
        self._take_over(self._oldest_ns)

    # Keeping

    def add_still(self, number: int, data: bytes, *, utility: float, capture_ns: int) -> None:
        """Store a still; ``data`` is `pack_backlog_still`'s. Raises OSError where the disk takes it not."""
        if (self._session_id, BacklogKind.STILL, number) in self._entries:
            return
        folder = self._session_folder()
        path = folder / still_name(number, capture_ns, utility)
        self._evict_for(blocks(len(data)))
        write_whole(path, data)
        self._enter(still_entry(path, self._session_id, number, capture_ns, utility))

    def add_unit(self, unit: AccessUnit, *, parameter_sets: bytes) -> None:
        """Append an access unit to the open segment, or to a new one. Raises OSError where the disk takes it not.

        ``parameter_sets`` is the newest keyframe: a run that does not begin with one still has to be described.
        """
        segment = self._open
        if segment is not None and segment.ends_before(unit):
            self.end_segment()
            segment = None
        try:
            if segment is None:
                folder = self._session_folder()
                path = folder / base_name(unit.frame_index, unit.capture_ns)
                self._open = segment = OpenSegment(path, unit, parameter_sets)
            self._evict_for(blocks(len(unit.data)))
            segment.write(unit)
        except av.error.FFmpegError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from None

    def end_segment(self) -> None:
        """What was appended is an object now."""
        segment, self._open = self._open, None
        if segment is None:
            return
        try:
            segment.close()
        except (av.error.FFmpegError, OSError) as error:
            _log.debug("%s has no end: %s", segment.path, error)
        first = segment.first
        try:
            entry = base_entry(segment.path, self._session_id, first.frame_index, first.capture_ns)
        except OSError as error:  # the disk was taken out, or somebody has tidied up
            self._note_damaged(segment.path, error)
            return
        self._enter(entry)

    # Giving back

    def best_stills(self) -> Iterator[Entry]:
        """Most useful first."""
        return self._best(BacklogKind.STILL)

    def newest_segments(self) -> Iterator[Entry]:
        """Newest first."""
        return self._best(BacklogKind.BASE)

    def _best(self, kind: BacklogKind) -> Iterator[Entry]:
        for _, session_id, number in reversed(self._ranked[kind]):
            yield self._entries[session_id, kind, number]

    def info_of(self, session_id: int) -> Entry | None:
        """The facts of a session; None where they are not here."""
        return self._entries.get((session_id, BacklogKind.INFO, 0))

    def find(self, key: Key) -> Entry | None:
        """The entry of this name, if it is still here."""
        return self._entries.get(key)

    def read(self, entry: Entry) -> bytes | None:
        """The object's bytes as they cross the link; one that is damaged is dropped, with a warning, and None."""
        try:
            return object_of(entry)
        except (OSError, WireError, DamagedError, ValueError) as error:
            self._note_damaged(entry.path, error)
            self.remove(entry)
            return None

    def _note_damaged(self, path: Path, error: Exception) -> None:
        self.damaged += 1
        if self.damaged.bit_count() == 1:  # 1, 2, 4, 8 …
            _log.warning(
                "the store skips what it cannot read (%d so far): %s (%s)", self.damaged, path, error
            )

    def remove(self, entry: Entry) -> None:
        """It has arrived, or has to make room; with the last of a former session its folder goes too."""
        if self._entries.pop(entry.key, None) is None:
            return
        self._disk_bytes[entry.kind] -= entry.disk_bytes
        self._span_ns -= entry.span_ns
        self._objects[entry.session_id] -= entry.kind is not BacklogKind.INFO
        if entry.kind is not BacklogKind.INFO:
            self._ranked[entry.kind].remove((entry.rank, entry.session_id, entry.number))
        unlink(entry.path)
        self._tidy(entry.session_id)

    def close(self) -> None:
        """End the open segment and let another process have the folder."""
        self.end_segment()
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # Room

    def _evict_for(self, needed_bytes: int) -> None:
        while self.disk_bytes + needed_bytes > self._max_bytes and (least := self._least()) is not None:
            if least.kind is BacklogKind.STILL:
                self.evicted_stills += 1
            else:
                self.evicted_segments += 1
            if (self.evicted_stills + self.evicted_segments) == 1:
                _log.warning(
                    "the store is full (--store %d MB): the least useful goes", self._max_bytes // 10**6
                )
            self.remove(least)

    def _least(self) -> Entry | None:
        opened = 0 if self._open is None else self._open.disk_bytes
        video_bytes = self._disk_bytes[BacklogKind.BASE] + opened
        video_first = not self.stills or video_bytes > _VIDEO_SHARE * self._max_bytes
        kind = BacklogKind.BASE if self.segments and video_first else BacklogKind.STILL
        if not self._ranked[kind]:
            return None
        _, session_id, number = self._ranked[kind][0]
        return self._entries[session_id, kind, number]

    def _enter(self, entry: Entry) -> None:
        self._entries[entry.key] = entry
        self._disk_bytes[entry.kind] += entry.disk_bytes
        self._span_ns += entry.span_ns
        self._objects[entry.session_id] += entry.kind is not BacklogKind.INFO
        if entry.kind is not BacklogKind.INFO:
            insort(self._ranked[entry.kind], (entry.rank, entry.session_id, entry.number))

    # Folders

    def _session_folder(self) -> Path:
        folder = self.path / f"{self._session_id:016x}"
        if self._lock is None:
            self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
            if self.locked_out:
                self.enter()
            if self._lock is None:
                self._lock_up()
        if (self._session_id, BacklogKind.INFO, 0) not in self._entries:
            folder.mkdir(mode=0o700, exist_ok=True)
            write_whole(folder / "info", self._info())
            self._enter(info_entry(folder / "info", self._session_id))
        return folder

    def _lock_up(self) -> None:
        lock = (self.path / "lock").open("ab")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            lock.close()
            raise BlockingIOError(
                error.errno,
                "another edge keeps its things there; if it goes on, give this one a --store-folder of its own",
            ) from None
        except OSError as error:  # some network disks have no locks
            _log.debug("%s cannot be locked: %s", self.path, error)
        self._lock = lock

    def _take_over(self, oldest_ns: int) -> None:
        """Find what earlier runs have stored; a half-written file is dropped, and what is too old."""
        too_old = 0
        for folder in sorted(self.path.iterdir()):
            if _SESSION.fullmatch(folder.name) is None or not folder.is_dir():
                continue
            for path in sorted(folder.iterdir()):
                entry = found(path, int(folder.name, 16))
                if entry is not None and (entry.kind is BacklogKind.INFO or entry.capture_ns >= oldest_ns):
                    self._enter(entry)
                    continue
                too_old += entry is not None
                if path.suffix in _OURS and not (
                    path.suffix == ".index" and path.with_suffix(".mkv").exists()
                ):
                    unlink(path)
            self._tidy(int(folder.name, 16))
        if too_old:
            _log.warning(
                "%d stills and stretches of video of an earlier run were never sent and are older than --store-age: "
                "they are dropped",
                too_old,
            )
        self._evict_for(0)

    def _tidy(self, session_id: int) -> None:
        """Remove the folder of a former session that has nothing left to send."""
        if session_id == self._session_id or self._objects[session_id] > 0:
            return
        del self._objects[session_id]
        info = self._entries.pop((session_id, BacklogKind.INFO, 0), None)
        if info is not None:
            self._disk_bytes[BacklogKind.INFO] -= info.disk_bytes
        folder = self.path / f"{session_id:016x}"
        unlink(folder / "info")
        with contextlib.suppress(OSError):
            folder.rmdir()
