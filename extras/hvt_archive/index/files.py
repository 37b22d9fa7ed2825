"""Files of recordings on disk: whether one is open, its contents, and the removal of its video."""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from rerun.chunk import Chunk

from hvt_archive.reading.readable import drop_footer, id_of, readable
from hvt_ground.recordings.row import FileAccount, RecordingRow
from hvt_ground.sinks.rerun.rrd_file import open_rrd
from hvt_ground.sinks.rerun.sdk import viewer_environment, viewer_program
from hvt_ground.sinks.rerun.stills import still_of_event

SCRATCH = ".part"
"""Ends the name of a copy that is being made of a recording."""
_SPARE_BYTES = 2 * 2**20
_HEAD_BYTES = 1024
_PATIENCE_S = 600.0
_VIDEO = "/base/video"
_LAYERS = ("/base/tracks", "/base/reported", "/base/refined")


@contextmanager
def claimed(path: Path) -> Iterator[bool]:
    """Whether a file is nobody's for as long: none writes it (`RrdFile` locks it), none else has claimed it.

    Not where nobody can tell, as on a file system without locks.
    """
    with ExitStack() as stack:
        ours = False
        with suppress(OSError):
            file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
            stack.callback(os.close, file)
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            ours = True
        yield ours


def is_claimed(path: Path) -> bool:
    """Whether some process writes the file, or has claimed it."""
    with claimed(path) as ours:
        return not ours


def begins_as_of(edge: str, path: Path) -> bool:
    """Whether the first bytes of a file are those of a recording of the edge: the SDK reads none of it."""
    whose = re.escape(edge.encode())
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    return bool(re.match(rb"RRF2.+?\x12.{1,2}%s-[0-9a-f]+\x1a.{2,4}hvt-%s" % (whose, whose), head, re.DOTALL))


def described(path: Path) -> RecordingRow | None:
    """Read a file's description of itself; None if it is no recording of ours."""
    content = _Content()
    try:
        with tempfile.TemporaryDirectory() as folder:
            found = readable(path, Path(folder) / path.name)
            if found is None:
                return None
            reader = open_rrd(found)
            whose = id_of(reader)
            for chunk in reader.stream():
                content.add(chunk)
            state = path.stat()
    except (OSError, RuntimeError, ValueError, LookupError, TypeError, AttributeError, OverflowError):
        return None
    if not re.fullmatch(r"[0-9a-f]+", whose.session):
        return None
    account = content.account()
    return RecordingRow(
        file=path.name,
        edge=whose.edge,
        session=whose.session,
        begin_ns=account.begin_ns,
        end_ns=account.end_ns,
        written_ns=state.st_mtime_ns,
        size_bytes=state.st_size,
        frames=content.frames,
        stills=account.stills,
        classes=account.classes,
        backlog="-backlog" in path.name,
        video=content.video,
        whole=True,
    )


class _Content:
    def __init__(self) -> None:
        self.frames = 0
        self.video = False
        self._account = FileAccount()
        self._names: dict[int, str] = {}
        self._tracks: dict[tuple[int, int], None] = {}
        """Track and class number of all boxes; the names may come later."""

    def add(self, chunk: Chunk) -> None:
        path = chunk.entity_path
        if path == _VIDEO:
            self.video = True
            self.frames += len(self._span(chunk))
        elif path in _LAYERS:
            self._span(chunk)
            for context in _values(chunk, "AnnotationContext:context"):
                for one in context[0]:
                    self._names[one["class_id"]] = one["class_description"]["info"]["label"]
            # An early HVT had one of them.
            now = list(_values(chunk, "class_now")) or _values(chunk, ":class_ids")
            for ids, classes in zip(_values(chunk, "track_id"), now, strict=False):
                self._tracks |= dict.fromkeys(zip(ids, classes, strict=False))
        elif path == "/events":
            for text in _values(chunk, "TextLog:text"):
                if (number := still_of_event(text[0])) is not None:
                    self._account.still(number)

    def account(self) -> FileAccount:
        for track, number in self._tracks:
            self._account.track(track, self._names.get(number, "?"))
        return self._account

    def _span(self, chunk: Chunk) -> list[int]:
        batch = chunk.to_record_batch()
        if "capture_time" not in batch.schema.names:
            return []
        times: list[int] = sorted(batch.column("capture_time").cast("int64").to_pylist())
        for at_ns in times[:1] + times[-1:]:
            self._account.span(at_ns)
        return times


def remove_video(path: Path) -> None:
    """Write a recording without its video in its place, whole or not at all; its age stays.

    Raises `OSError` or `subprocess.SubprocessError` where that cannot be done.
    """
    scratch, state = path.with_name(path.name + SCRATCH), path.stat()
    if shutil.disk_usage(path.parent).free < state.st_size + _SPARE_BYTES:
        raise OSError(None, "the disk has no room for a copy without video", str(path))
    try:
        with tempfile.TemporaryDirectory() as folder:
            source = readable(path, Path(folder) / path.name)
            # By Rerun's own program: it keeps screen and footer, and its memory is not the ground's.
            command = [
                viewer_program(),
                "rrd",
                "filter",
                "--drop-entity",
                _VIDEO,
                source or path,
                "-o",
                scratch,
            ]
            subprocess.run(  # noqa: S603
                [str(word) for word in command],
                check=True,
                capture_output=True,
                timeout=_PATIENCE_S,
                env=viewer_environment(),
            )
        if scratch.stat().st_size >= state.st_size:
            drop_footer(scratch)
        os.utime(scratch, ns=(state.st_atime_ns, state.st_mtime_ns))
        scratch.replace(path)
    finally:
        with suppress(OSError):
            scratch.unlink(missing_ok=True)


def _values(chunk: Chunk, component: str) -> Iterator[Any]:
    batch = chunk.to_record_batch()
    for field, column in zip(batch.schema, batch.columns, strict=True):
        if (field.metadata or {}).get(b"rerun:component", b"").decode().endswith(component):
            yield from (value for value in column.to_pylist() if value is not None)
