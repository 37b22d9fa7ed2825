"""The store on disk: one SQLite file of objects (`entry`) and of the frames and stills that they are made of.

After a kill each write is there entirely or not at all. Nothing is forced to disk but the database's own order, so a
power cut costs the writes that the system still had in memory. The file shrinks with its contents.

When the store is full it deletes the least useful objects first:

* **Video, oldest first**, as long as stills take less than a quarter of the space: video of a short while ago says
  more of the present than video of an hour ago.
* **Stills by their worth**: the utility that their method gave, halved with each ten minutes. They are a hundredth
  of the video's bytes and show most of an object's detail, so the best outlive the video around them.

The capture times of earlier runs are moved to the clock of this run when it takes their objects over, because an
earlier clock may have been years off: ages and order then follow the time that has passed (`unwitnessed_ns`).
"""

from __future__ import annotations

import contextlib
import errno
import logging
import sqlite3
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any, Self

from hvt_common.protocol.messages import (
    MAX_BACKLOG_BYTES,
    BacklogKind,
    BacklogUnit,
    ObjectKey,
    WireError,
    pack_backlog_units,
    parse_backlog_units,
)
from hvt_common.runtime.clock import Moment, boot_id, since_boot_ns, unwitnessed_ns
from hvt_common.units import SECOND_NS
from hvt_common.values import AccessUnit
from hvt_edge.backlog.entry import Entry, OpenSegment, entry_of, moved_rank, worth

_log = logging.getLogger(__name__)

FILE_NAME = "backlog.sqlite"
_STILLS_SHARE = 0.25
_PAGE_BYTES = 4096
_LOG_BYTES = 2 * 64 * _PAGE_BYTES
"""Room for the write-ahead log: 64 pages are moved into the file, and the write before that may be a large one."""
_REMOVED = "removed, with all that was stored"
_TRIAL_BYTES = 64 * 1024
_SET_NS = 60 * SECOND_NS
"""Some seconds may pass from capture to store; a smaller difference does not mean that a clock was set."""
_TRUSTED_SHARE = 1 / 4
"""Share of ``--store-age`` that the clock may at most add for the time between two boots."""
# One process at a time: exclusive locking also keeps the log's index in memory, so no disk needs shared mappings.
_NEW = """
PRAGMA page_size = 4096;
PRAGMA auto_vacuum = FULL;
PRAGMA journal_mode = WAL;
"""
_OPEN = """
PRAGMA synchronous = NORMAL;
PRAGMA foreign_keys = ON;
PRAGMA temp_store = MEMORY;
PRAGMA wal_autocheckpoint = 64;
BEGIN IMMEDIATE;
CREATE TABLE IF NOT EXISTS object (
    id INTEGER PRIMARY KEY AUTOINCREMENT, session TEXT NOT NULL, kind TEXT NOT NULL, number INTEGER NOT NULL,
    capture_ns INTEGER NOT NULL, rank REAL NOT NULL, bytes INTEGER NOT NULL, span_ns INTEGER NOT NULL,
    UNIQUE (session, kind, number) ON CONFLICT REPLACE);
CREATE INDEX IF NOT EXISTS object_rank ON object (kind, rank, bytes, span_ns);
CREATE TABLE IF NOT EXISTS part (
    object INTEGER REFERENCES object ON DELETE CASCADE, frame_index INTEGER, capture_ns INTEGER, keyframe INTEGER,
    crc INTEGER, data BLOB);
CREATE INDEX IF NOT EXISTS part_object ON part (object);
CREATE TABLE IF NOT EXISTS stored (capture_ns INTEGER, boot TEXT, steady_ns INTEGER);
CREATE TEMP TABLE gone (id INTEGER PRIMARY KEY);
CREATE TEMP VIEW here AS SELECT * FROM object WHERE id NOT IN (SELECT id FROM gone);
COMMIT;
"""
# `stored` is the time of the newest object, by both clocks; `object.capture_ns` is by the clock of the run that has
# it. `gone` lists objects that have arrived and cannot be deleted yet, because a full disk has no space for the log
# either. No row of an object is used again: the entry of an evicted one is never that of another. After a kill the
# segment that was open has no size yet.
_ADOPT = """
UPDATE object SET
    bytes = (SELECT total(length(data)) FROM part WHERE object = object.id),
    span_ns = (SELECT ifnull(max(part.capture_ns) - min(part.capture_ns), 0) FROM part WHERE object = object.id)
WHERE kind = 'base' AND bytes = 0;
DELETE FROM object WHERE kind = 'base' AND bytes = 0;
"""
_TIDY = """
DELETE FROM object WHERE kind = 'info' AND session <> ?
AND session NOT IN (SELECT session FROM object WHERE kind <> 'info')
"""
_TOO_OLD = """
SELECT id, session, kind, number FROM object WHERE kind <> 'info' AND capture_ns < ? ORDER BY capture_ns
LIMIT (SELECT count(*) FROM object WHERE kind <> 'info') / 2
"""
# Never more than half at once: where the ages are wrong after all, half is still there.
_PARTS = "SELECT frame_index, capture_ns, keyframe, data, crc FROM part WHERE object = ? ORDER BY rowid"
_ENTRY = "SELECT id, session, kind, number, rank, span_ns FROM here"


@dataclass(eq=False)
class Store:
    """The objects of this session and of earlier ones, in bounded space. For one thread; any may read the counts.

    The folder is made when the first object is stored; ``max_bytes`` counts the file and its log.
    ``info()`` is this session's `Info`, packed. `enter` drops objects captured before ``oldest_ns``, but never more
    than half of all; ``oldest_ns`` is by ``clock``, as capture times are, in Unix nanoseconds. ``since_boot()``
    returns the boot's id and the nanoseconds since it.
    Every method raises `OSError` where the disk refuses, and can be called again.
    """

    path: Path
    _: KW_ONLY
    max_bytes: int
    session_id: int
    info: Callable[[], bytes]
    oldest_ns: int = 0
    clock: Callable[[], int] = time.time_ns
    since_boot: Callable[[], tuple[str, int]] = lambda: (boot_id(), since_boot_ns())

    def __post_init__(self) -> None:
        self._file = self.path / FILE_NAME
        self._file_bytes = self.max_bytes - _LOG_BYTES
        self._session = f"{self.session_id:016x}"
        self._db: sqlite3.Connection | None = None
        self._open: OpenSegment | None = None
        self._still_bytes = self._span_ns = 0
        self.disk_bytes = self.stills = self.segments = 0
        """All objects in the store; the open segment does not count as a segment."""
        self.evicted_stills = self.evicted_segments = 0
        self.damaged = 0
        """Objects that were dropped because they could not be read."""

    @property
    def open_segments(self) -> int:
        """1 while frames are being appended, else 0."""
        return int(self._open is not None)

    @property
    def _open_row(self) -> int:
        return -1 if self._open is None else self._open.row

    @property
    def span_ns(self) -> int:
        return self._span_ns + (0 if self._open is None else self._open.span_ns)

    def enter(self) -> None:
        """Take over the objects that earlier runs have stored, if any.

        Raises `BlockingIOError` where another edge has the folder; that may be a predecessor that is about to end.
        """
        if self._file.exists():
            self._ready()

    def trial(self) -> None:
        """Write and delete a test row; raises where the disk still refuses."""
        with self._disk():
            db = self._writable()
            row = db.execute("INSERT INTO part (data) VALUES (zeroblob(?))", (_TRIAL_BYTES,)).lastrowid
            db.execute("DELETE FROM part WHERE rowid = ?", (row,))
            self._delete_gone(db)

    # Storing

    def add_still(self, number: int, data: bytes, *, utility: float, capture_ns: int) -> None:
        """Store a still; ``data`` comes from `pack_backlog_still`."""
        with self._disk():
            db = self._writable()
            if self.find((self.session_id, BacklogKind.STILL, number)) is not None:
                return
            self._evict_for(len(data), db)
            self._add(BacklogKind.STILL, number, capture_ns, worth(utility, capture_ns), data)
            self._count()

    def add_unit(self, unit: AccessUnit) -> None:
        """Append an access unit to the open segment, or to a new one."""
        if self._open is not None and self._open.ends_before(unit):
            self.end_segment()
        with self._disk():
            db = self._writable()
            self._evict_for(len(unit.data), db)
            if self._open is None:
                row = self._add(BacklogKind.BASE, unit.frame_index, unit.capture_ns, float(unit.capture_ns))
                self._open = OpenSegment(row, unit, unit)
            values = (unit.frame_index, unit.capture_ns, unit.keyframe, zlib.crc32(unit.data), unit.data)
            db.execute("INSERT INTO part VALUES (?, ?, ?, ?, ?, ?)", (self._open.row, *values))
            self._open.append(unit)
            self._measure()

    def end_segment(self) -> None:
        if self._open is None or self._db is None:
            return
        try:
            with self._disk():
                self._db.executescript(_ADOPT)
        finally:
            self._count(open_row=-1)
            self._open = None

    def _add(self, kind: BacklogKind, number: int, capture_ns: int, rank: float, data: bytes = b"") -> int:
        assert self._db is not None
        with self._db:
            self._db.execute("BEGIN")
            values = (self._session, kind, number, capture_ns, rank, len(data), 0)
            insert = "INSERT INTO object VALUES (NULL, ?, ?, ?, ?, ?, ?, ?)"
            row = self._db.execute(insert, values).lastrowid
            if kind is not BacklogKind.INFO:
                self._db.execute("DELETE FROM stored")
                self._db.execute("INSERT INTO stored VALUES (?, ?, ?)", (capture_ns, *self.since_boot()))
            if data:
                crc = zlib.crc32(data)
                self._db.execute("INSERT INTO part (object, crc, data) VALUES (?, ?, ?)", (row, crc, data))
        assert row is not None
        return row

    # Reading

    def best_stills(self) -> Iterator[Entry]:
        return self._ranked(BacklogKind.STILL)

    def newest_segments(self) -> Iterator[Entry]:
        return self._ranked(BacklogKind.BASE)

    def info_of(self, session_id: int) -> Entry | None:
        """The facts of a session; None where the store has none."""
        return self.find((session_id, BacklogKind.INFO, 0))

    def find(self, key: ObjectKey) -> Entry | None:
        session_id, kind, number = key
        where = f"{_ENTRY} WHERE session = ? AND kind = ? AND number = ?"
        return next(self._entries(where, f"{session_id:016x}", kind, number), None)

    def read(self, entry: Entry) -> bytes | None:
        """The object's bytes as they cross the link; a damaged object is dropped with a warning, and gives None.

        A segment gives its frames up to the first damaged one.
        """
        parts: list[tuple[Any, ...]] = []
        for *facts, data, crc in self._rows(_PARTS, entry.row):
            if type(data) is not bytes or zlib.crc32(data) != crc:
                break
            parts.append((*facts, data))
        whole: bytes = parts[0][-1] if parts else b""
        if entry.kind is BacklogKind.BASE and parts:
            whole = _packed(parts)
        if 0 < len(whole) <= MAX_BACKLOG_BYTES:
            return whole
        self._note_damaged(f"{entry} cannot be read")
        self.remove(entry)
        return None

    def remove(self, entry: Entry) -> None:
        """Delete an object that has arrived or must make room; a former session's facts go with its last object."""
        if self._db is not None:
            with self._disk():
                self._db.execute("INSERT OR IGNORE INTO gone VALUES (?)", (entry.row,))
                self._delete_gone(self._db)
                self._count()

    def _delete_gone(self, db: sqlite3.Connection) -> None:
        with contextlib.suppress(sqlite3.OperationalError):
            db.execute("DELETE FROM object WHERE id IN (SELECT id FROM gone)")
            db.execute("DELETE FROM gone")
            db.execute(_TIDY, (self._session,))

    def close(self) -> None:
        """End the open segment and release the file for other processes; the counts stay as they are."""
        try:
            self.end_segment()
            if self._db is not None:
                self._delete_gone(self._db)
        finally:
            self._disconnect()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def _ranked(self, kind: BacklogKind, order: str = "DESC") -> Iterator[Entry]:
        return self._entries(
            f"{_ENTRY} WHERE kind = ? AND id <> ? ORDER BY rank {order}", kind, self._open_row
        )

    def _entries(self, select: str, *values: Any) -> Iterator[Entry]:
        for row in self._rows(select, *values):
            try:
                entry = entry_of(row)
            except ValueError as error:  # another program has written it
                self._note_damaged(f"{self._file}: {error}")
                with self._disk():  # hidden from now on; deleted together with arrived objects
                    assert self._db is not None, "it was just read"
                    self._db.execute("INSERT OR IGNORE INTO gone VALUES (?)", (row[0],))
                self._count()
            else:
                yield entry

    def _rows(self, select: str, *values: Any) -> Iterator[Any]:
        if self._db is not None:
            with self._disk():
                yield from self._db.execute(select, values)

    # Space

    def _evict_for(self, needed_bytes: int, db: sqlite3.Connection) -> None:
        while self.disk_bytes + needed_bytes > self._file_bytes:
            video_first = self._still_bytes < _STILLS_SHARE * self._file_bytes
            kind = BacklogKind.BASE if self.segments and video_first else BacklogKind.STILL
            if (least := next(self._ranked(kind, "ASC"), None)) is None:
                return
            if not self.evicted_stills + self.evicted_segments:
                megabytes = self.max_bytes // 10**6
                _log.warning("the store is full (--store %d MB): the least useful goes", megabytes)
            # Not `remove`: if this too needs space that is not there, all objects would go in vain.
            with self._disk():
                db.execute("DELETE FROM object WHERE id = ?", (least.row,))
            self.evicted_stills += kind is BacklogKind.STILL
            self.evicted_segments += kind is BacklogKind.BASE
            self._count()

    def _count(self, *, open_row: int | None = None) -> None:
        sums = "SELECT kind, count(*), sum(bytes), sum(span_ns) FROM here WHERE id <> ? GROUP BY kind"
        open_row = self._open_row if open_row is None else open_row
        counts = {kind: numbers for kind, *numbers in self._rows(sums, open_row)}
        self.stills, self._still_bytes, _ = counts.get(BacklogKind.STILL, (0, 0, 0))
        self.segments, _, self._span_ns = counts.get(BacklogKind.BASE, (0, 0, 0))
        self._measure()

    def _measure(self) -> None:
        self.disk_bytes = sum(pages for (pages,) in self._rows("PRAGMA page_count")) * _PAGE_BYTES

    # The file

    def _ready(self) -> sqlite3.Connection:
        with self._disk():
            if self._db is None:
                self._db = self._opened()
                self._take_over(self._db)
            return self._db

    def _writable(self) -> sqlite3.Connection:
        # The open database with this session's facts in it.
        if self._db is not None and not self._file.exists():
            self._lose()
            raise FileNotFoundError(errno.ENOENT, _REMOVED, str(self._file))
        db = self._ready()
        if self.info_of(self.session_id) is None:
            self._add(BacklogKind.INFO, 0, 0, 0.0, self.info())
        return db

    def _opened(self) -> sqlite3.Connection:
        self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._file.touch(mode=0o600)  # SQLite's log gets the same
        db = sqlite3.connect(self._file, timeout=0, isolation_level=None)
        try:
            db.execute("PRAGMA locking_mode = EXCLUSIVE")
            db.executescript((_NEW if not self._file.stat().st_size else "") + _OPEN)
        except sqlite3.Error as error:
            db.close()
            if error.sqlite_errorcode == sqlite3.SQLITE_BUSY:
                why = "another edge uses it; if that goes on, give this one a --store-folder of its own"
                raise BlockingIOError(errno.EAGAIN, why, str(self.path)) from None
            raise
        return db

    def _take_over(self, db: sqlite3.Connection) -> None:
        # Take over the unexpired objects of earlier runs. A full disk refuses the update, and can still be read.
        with contextlib.suppress(sqlite3.OperationalError):
            db.executescript(_ADOPT)
            self._move_times(db)
            dropped = db.execute(_TOO_OLD, (self.oldest_ns,)).fetchall()
            db.executemany("DELETE FROM object WHERE id = ?", [row[:1] for row in dropped])
            if dropped:
                named = ", ".join(
                    f"{kind} {number} of session {session}" for _, session, kind, number in dropped[:5]
                )
                more = ", …" if len(dropped) > 5 else ""
                _log.warning(
                    "%d stills and stretches of video of an earlier run were never sent and are older than "
                    "--store-age: they are dropped (%s)",
                    len(dropped),
                    named + more,
                )
            db.execute(_TIDY, (self._session,))
        self._count()
        self._evict_for(0, db)

    def _move_times(self, db: sqlite3.Connection) -> None:
        found = db.execute("SELECT capture_ns, boot, steady_ns FROM stored").fetchone()
        if found is None:
            return
        now_ns = self.clock()
        most_ns = round(max(0, now_ns - self.oldest_ns) * _TRUSTED_SHARE)
        moved_ns = unwitnessed_ns(Moment(*found), Moment(now_ns, *self.since_boot()), most_ns=most_ns)
        if abs(moved_ns) > _SET_NS:
            with db:
                db.execute("BEGIN")
                for kind in (BacklogKind.BASE, BacklogKind.STILL):
                    move = "UPDATE object SET capture_ns = capture_ns + ?, rank = rank + ? WHERE kind = ?"
                    db.execute(move, (moved_ns, moved_rank(kind, moved_ns), kind))
                db.execute("UPDATE stored SET capture_ns = capture_ns + ?", (moved_ns,))

    def _disconnect(self) -> None:
        db, self._db, self._open = self._db, None, None
        if db is not None:
            with contextlib.suppress(sqlite3.Error):
                db.close()

    def _lose(self) -> None:
        self._disconnect()
        self._still_bytes = self._span_ns = self.disk_bytes = self.stills = self.segments = 0

    @contextlib.contextmanager
    def _disk(self) -> Iterator[None]:
        # Database errors are raised as disk errors; any but want of space ends the connection.
        try:
            yield
        except sqlite3.Error as error:
            code = error.sqlite_errorcode & 0xFF
            if code == sqlite3.SQLITE_FULL:
                why = "no space is left: free some, or name another --store-folder"
                raise OSError(errno.ENOSPC, why, str(self.path)) from None
            self._lose()
            why = str(error) if self._file.exists() else _REMOVED
            if code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB) or why.startswith(
                ("no such ", "table ")
            ):
                self._file.replace(self._file.with_suffix(".damaged"))
                self._note_damaged(f"{self._file} is damaged and is put aside as .damaged")
            raise OSError(errno.EIO, why, str(self._file)) from None

    def _note_damaged(self, what: str) -> None:
        self.damaged += 1
        if self.damaged.bit_count() == 1:  # 1, 2, 4, 8 …
            _log.warning("the store skips what it cannot read (%d so far): %s", self.damaged, what)


def _packed(parts: list[tuple[Any, ...]]) -> bytes:
    # A segment's bytes; none where no ground would read its frames, because another program has written them.
    units = [BacklogUnit(index, at_ns, bool(key), unit) for index, at_ns, key, unit in parts]
    try:
        packed = pack_backlog_units(units)
        parse_backlog_units(packed)
    except (ValueError, TypeError, OverflowError, WireError):
        return b""
    return packed
