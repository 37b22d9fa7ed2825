"""The index in SQLite: the files of a folder of recordings, and their content.

It is written ahead (WAL), so that a crash leaves it whole. Readers and the writer do not hold each other up.
"""

from __future__ import annotations

import logging
import sqlite3
import time
from collections.abc import Iterable
from contextlib import closing
from os.path import samestat
from pathlib import Path

from hvt_common.errors import UserError
from hvt_common.runtime.clock import Moment, unwitnessed_ns
from hvt_common.units import SECOND_NS
from hvt_ground.recordings.row import RecordingRow

_log = logging.getLogger(__name__)

INDEX = "recordings.sqlite"
_BUSY_S = 5.0
_VERSION = 1
_TABLES = """
CREATE TABLE recordings (
  file TEXT PRIMARY KEY, edge TEXT NOT NULL, session TEXT NOT NULL, begin_ns INTEGER, end_ns INTEGER,
  written_ns INTEGER NOT NULL, size_bytes INTEGER NOT NULL, frames INTEGER NOT NULL, stills INTEGER NOT NULL,
  backlog INTEGER NOT NULL, video INTEGER NOT NULL, whole INTEGER NOT NULL
);
CREATE TABLE classes (
  file TEXT NOT NULL REFERENCES recordings (file) ON DELETE CASCADE, class TEXT NOT NULL, tracks INTEGER NOT NULL,
  PRIMARY KEY (file, class)
) WITHOUT ROWID;
CREATE INDEX by_class ON classes (class);
"""
_LOOKED = "CREATE TABLE IF NOT EXISTS looked (unix_ns INTEGER, boot TEXT, steady_ns INTEGER)"
"""When a ground looked last; grounds of before it was kept are not troubled by it."""
_COLUMNS = (
    *("file", "edge", "session", "begin_ns", "end_ns", "written_ns", "size_bytes", "frames", "stills"),
    *("backlog", "video", "whole"),
)


class Index:
    """The index of a folder, for one thread; made where there is none. Raises `sqlite3.Error`, for whom to try again.

    One that is no index of ours, or is damaged, is set aside under another name.
    """

    def __init__(self, folder: Path) -> None:
        self._path = path = folder / INDEX
        try:
            self._database = _opened(path)
        except sqlite3.OperationalError:  # locked, not writable, disk full: the database may be good
            raise
        except sqlite3.DatabaseError as error:
            _set_aside(path, error)
            self._database = _opened(path)
        self._file = path.stat()

    def close(self) -> None:
        """Close it; a second call does nothing."""
        self._database.close()

    def put(self, row: RecordingRow) -> None:
        values = [getattr(row, name) for name in _COLUMNS]
        with self._database as transaction:
            transaction.execute(
                f"INSERT OR REPLACE INTO recordings ({', '.join(_COLUMNS)}) "  # noqa: S608 - our own names
                f"VALUES ({', '.join('?' * len(_COLUMNS))})",
                values,
            )
            transaction.execute("DELETE FROM classes WHERE file = ?", [row.file])
            transaction.executemany(
                "INSERT INTO classes VALUES (?, ?, ?)", [(row.file, *one) for one in row.classes.items()]
            )

    def change(self, file: str, **facts: int) -> None:
        """Set some facts of a file by their names; the others stay, and its classes."""
        named = ", ".join(f"{name} = ?" for name in facts)
        with self._database as transaction:
            transaction.execute(f"UPDATE recordings SET {named} WHERE file = ?", [*facts.values(), file])  # noqa: S608

    def forget(self, files: Iterable[str]) -> None:
        with self._database as transaction:
            transaction.executemany("DELETE FROM recordings WHERE file = ?", [(one,) for one in files])

    def pass_time(self, now: Moment, *, most_ns: int) -> int:
        """Note that time has passed; the nanoseconds by which the clock moved otherwise, and all times with it.

        So the files keep their ages and their order when the clock is set. The first to look with another clock
        moves them, of all grounds that have the folder.
        """
        if not self._is_there():  # all its files would seem to be gone, and a row would be in no folder
            raise sqlite3.OperationalError(f"{self._path} was removed")
        with self._database as transaction:
            transaction.execute("BEGIN IMMEDIATE")
            before = transaction.execute("SELECT unix_ns, boot, steady_ns FROM looked").fetchone()
            moved_ns = 0 if before is None else unwitnessed_ns(Moment(*before), now, most_ns=most_ns)
            if abs(moved_ns) > SECOND_NS:
                transaction.execute("UPDATE recordings SET written_ns = written_ns + ?", [moved_ns])
            transaction.execute("DELETE FROM looked")
            transaction.execute("INSERT INTO looked VALUES (?, ?, ?)", [now.unix_ns, now.boot, now.steady_ns])
        return moved_ns

    def _is_there(self) -> bool:
        # Or its disk was unmounted: then the folder is another, and may have an index of its own.
        try:
            return samestat(self._path.stat(), self._file)
        except FileNotFoundError:
            return False

    def row(self, file: str) -> RecordingRow | None:
        """The facts of one file, but its classes; None if it is not known."""
        return next(iter(_rows(self._database, classes=False, file=file)), None)

    def rows(self, *, classes: bool = True) -> list[RecordingRow]:
        """All files, in the order of their times; without ``classes`` it is quicker where there are many."""
        return _rows(self._database, classes=classes)


def read_index(folder: Path) -> list[RecordingRow]:
    """All files that the index of a folder knows, in the order of their times; changes none.

    Raises `UserError` where there is no index, or none that can be read.
    """
    path = folder / INDEX
    if not path.is_file():
        raise UserError(f"{folder} has no index of recordings ({INDEX}): name the folder that --record names")
    where = path.resolve().as_uri()
    try:
        for more in ("mode=ro", "mode=ro&immutable=1"):  # the latter where nothing may be written beside it
            try:
                with closing(sqlite3.connect(f"{where}?{more}", uri=True, timeout=_BUSY_S)) as database:
                    # Version 0: another process has begun to make it, and its tables come in a moment.
                    return _rows(database) if _version(database, path) else []
            except sqlite3.OperationalError:
                if "immutable" in more:
                    raise
    except sqlite3.Error as error:
        raise UserError(f"{path} cannot be read ({error}): hvt-ground makes it anew when it starts") from None
    raise AssertionError


def _opened(path: Path) -> sqlite3.Connection:
    database = sqlite3.connect(path, timeout=_BUSY_S)
    try:
        version = _version(database, path)
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("PRAGMA synchronous = NORMAL")
        database.execute("PRAGMA foreign_keys = ON")
        if not version:
            database.executescript(f"BEGIN IMMEDIATE; {_TABLES} PRAGMA user_version = {_VERSION}; COMMIT;")
        database.execute(_LOOKED)
        _check(database)
    except BaseException:
        database.close()
        raise
    return database


def _version(database: sqlite3.Connection, path: Path) -> int:
    # 0 is a new one.
    version = int(database.execute("PRAGMA user_version").fetchone()[0])
    if version > _VERSION:
        raise UserError(f"{path} is of a newer version of hvt-ground: name another folder")
    return version


def _check(database: sqlite3.Connection) -> None:
    (state,) = database.execute("PRAGMA quick_check(1)").fetchone()
    if state != "ok":
        raise sqlite3.DatabaseError(state)
    _rows(database)


def _set_aside(path: Path, error: Exception) -> None:
    aside = path.with_name(f"{path.name}.damaged-{time.strftime('%Y%m%d-%H%M%S')}")
    _log.warning("the index %s is damaged (%s): it is now %s, and made anew", path, error, aside.name)
    for suffix in ("-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
    path.replace(aside)


def _rows(
    database: sqlite3.Connection, *, classes: bool = True, file: str | None = None
) -> list[RecordingRow]:
    by_file: dict[str, dict[str, int]] = {}
    if classes:
        for one, name, tracks in database.execute(
            "SELECT file, class, tracks FROM classes ORDER BY tracks DESC"
        ):
            by_file.setdefault(one, {})[name] = tracks
    order = "coalesce(begin_ns, written_ns), file"
    found = database.execute(
        f"SELECT {', '.join(_COLUMNS)} FROM recordings WHERE coalesce(file = ?, 1) ORDER BY {order}",  # noqa: S608
        [file],
    )
    return [
        RecordingRow(*(*facts, by_file.get(facts[0], {}), bool(backlog), bool(video), bool(whole)))
        for *facts, backlog, video, whole in found
    ]
