"""One object of the store, and its file: what the name says, how it is written whole, read and checked.

Everything that is to be known of an object without reading it stands in its file's name, so that another start of
the edge finds it: ``still-<number>-<capture ns>-<utility>.still`` and ``base-<first frame>-<capture ns>.mkv``, with
``.index`` beside it.
"""

from __future__ import annotations

import contextlib
import math
import re
from dataclasses import dataclass
from pathlib import Path

from hvt_common.protocol.messages import (
    MAX_BACKLOG_BYTES,
    BacklogKind,
    Info,
    RoiHeader,
    pack_backlog_units,
    parse_backlog_still,
)
from hvt_common.units import SECOND_NS
from hvt_edge.backlog.segment import DamagedError, blocks, index_of, last_ns, read_segment

__all__ = [
    "FIRST_STORED",
    "Entry",
    "Key",
    "base_entry",
    "base_name",
    "found",
    "info_entry",
    "object_of",
    "still_entry",
    "still_name",
    "unlink",
    "write_whole",
]

FIRST_STORED = 2**31
"""Stills that are stored for later have numbers of their own: those that are sent have no holes then."""
_HALF_LIFE_NS = 600 * SECOND_NS
_LEAST_STRENGTH = -60.0
_STILL = re.compile(r"still-(\d{1,10})-(\d{1,19})-(\S{1,32})\.still")
_BASE = re.compile(r"base-(\d{1,10})-(\d{1,19})\.mkv")

Key = tuple[int, BacklogKind, int]
"""Session, kind and number: what an object is called on the link."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One object that is stored."""

    session_id: int
    kind: BacklogKind
    number: int
    capture_ns: int
    path: Path
    disk_bytes: int
    """In whole blocks."""
    span_ns: int = 0
    """Of video: from its first frame to its last."""
    worth: float = 0.0
    """Of a still: the binary logarithm of its utility, plus its time in half-lives. So the order never changes."""

    @property
    def rank(self) -> float:
        """What has to go first where the store is full has the least: worth of a still, age of a segment."""
        return self.worth if self.kind is BacklogKind.STILL else self.capture_ns

    @property
    def key(self) -> Key:
        """What it is called on the link."""
        return self.session_id, self.kind, self.number


def still_name(number: int, capture_ns: int, utility: float) -> str:
    """Of the file of a still."""
    return f"still-{number}-{capture_ns}-{utility:.6g}.still"


def base_name(first_frame: int, capture_ns: int) -> str:
    """Of the file of a segment."""
    return f"base-{first_frame}-{capture_ns}.mkv"


def object_of(entry: Entry) -> bytes:
    """Its bytes as they cross the link. Raises OSError, WireError, DamagedError or ValueError where they cannot."""
    if entry.kind is BacklogKind.BASE:
        data = pack_backlog_units(read_segment(entry.path))
        if len(data) > MAX_BACKLOG_BYTES:
            raise DamagedError(f"{len(data)} bytes are more than can be sent")
        return data
    if entry.path.stat().st_size > MAX_BACKLOG_BYTES:
        raise DamagedError("it is larger than can be sent")
    data = entry.path.read_bytes()
    if entry.kind is BacklogKind.STILL:
        still = parse_backlog_still(data)
        RoiHeader.parse(still.attachment, still.payload)
    else:
        Info.parse(data)
    return data


def found(path: Path, session_id: int) -> Entry | None:
    """What a file is by its name; None for all that is no whole object."""
    try:
        if path.name == "info":
            return info_entry(path, session_id)
        if (still := _STILL.fullmatch(path.name)) is not None:
            return still_entry(path, session_id, int(still[1]), int(still[2]), float(still[3]))
        if (base := _BASE.fullmatch(path.name)) is not None and index_of(path).exists():
            return base_entry(path, session_id, int(base[1]), int(base[2]))
    except (OSError, ValueError):
        return None
    return None


def info_entry(path: Path, session_id: int) -> Entry:
    """The facts of a session."""
    return Entry(session_id, BacklogKind.INFO, 0, 0, path, blocks(path.stat().st_size))


def still_entry(path: Path, session_id: int, number: int, capture_ns: int, utility: float) -> Entry:
    """A still that its method gave this utility."""
    if math.isnan(utility):
        raise ValueError("a utility that is no number")
    if utility > 0:
        strength = max(_LEAST_STRENGTH, math.log2(min(utility, 1e12)))
    else:
        strength = _LEAST_STRENGTH - math.log2(1 + min(-utility, 1e12))
    worth = strength + capture_ns / _HALF_LIFE_NS
    size = blocks(path.stat().st_size)
    return Entry(session_id, BacklogKind.STILL, number, capture_ns, path, size, worth=worth)


def base_entry(path: Path, session_id: int, first_frame: int, capture_ns: int) -> Entry:
    """A segment, by its first frame."""
    size = blocks(path.stat().st_size) + blocks(index_of(path).stat().st_size)
    return Entry(
        session_id, BacklogKind.BASE, first_frame, capture_ns, path, size, max(0, last_ns(path) - capture_ns)
    )


def write_whole(path: Path, data: bytes) -> None:
    """A file is there whole or not at all."""
    scratch = path.with_name(path.name + ".part")
    try:
        scratch.write_bytes(data)
        scratch.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            scratch.unlink()
        raise


def unlink(path: Path) -> None:
    """Remove a file, and the index that belongs to it."""
    for one in (path, index_of(path)) if path.suffix == ".mkv" else (path,):
        with contextlib.suppress(OSError):
            one.unlink()
