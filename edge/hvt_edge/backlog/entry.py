"""One object of the store: its key, its rank, and the segment that is being written."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from hvt_common.protocol.messages import MAX_BACKLOG_BYTES, BacklogKind, ObjectKey
from hvt_common.units import SECOND_NS
from hvt_common.values import AccessUnit

FIRST_STORED = 2**31
"""Stored stills have numbers of their own, from here on, so that the numbers of sent stills have no gaps."""
SEGMENT_NS = 10 * SECOND_NS
"""Length of a segment, after which a keyframe is wanted: eviction and sending go by segments."""
_HALF_LIFE_NS = 600 * SECOND_NS
_LEAST_STRENGTH = -60.0
MOST_UNIT_BYTES = _MOST_SEGMENT_BYTES = MAX_BACKLOG_BYTES - 512 * 1024
"""Limit of an access unit and of a segment: a larger one is more than any ground takes in one object."""
_MOST_SEGMENT_UNITS = 2400


@dataclass(frozen=True, slots=True)
class Entry:
    """One stored object."""

    row: int
    session_id: int
    kind: BacklogKind
    number: int
    rank: float
    """The object of least rank is deleted first when the store is full: worth of a still, start time of a segment."""
    span_ns: int
    """The length of the video: from its first frame to its last."""

    @property
    def key(self) -> ObjectKey:
        return self.session_id, self.kind, self.number

    def __str__(self) -> str:
        return f"{self.kind} {self.number} of session {self.session_id:08x}"


def entry_of(values: tuple[Any, ...]) -> Entry:
    """Read a row of the file, in the order of `Entry`; raises `ValueError` for a row that no edge has written."""
    row, session, kind, number, rank, span_ns = values
    kinds = [type(one) for one in (session, kind, number, rank, span_ns)]
    if kinds != [str, str, int, float, int] or not (0 <= number < 2**32 and span_ns >= 0):
        raise ValueError(f"row {row} holds what no edge writes")
    session_id = int(session, 16)
    if not 0 <= session_id < 2**64:
        raise ValueError(f"row {row} is of no session")
    return Entry(row, session_id, BacklogKind(kind), number, rank, span_ns)


@dataclass(slots=True)
class OpenSegment:
    """The segment that is being written, and the rule for the unit that begins the next."""

    row: int
    first: AccessUnit
    last: AccessUnit
    size_bytes: int = 0
    units: int = 0

    @property
    def span_ns(self) -> int:
        return self.last.capture_ns - self.first.capture_ns

    def ends_before(self, unit: AccessUnit) -> bool:
        if unit.frame_index <= self.last.frame_index or unit.capture_ns <= self.last.capture_ns:
            return True
        if self.units >= _MOST_SEGMENT_UNITS or self.size_bytes + len(unit.data) > _MOST_SEGMENT_BYTES:
            return True
        long = unit.capture_ns - self.first.capture_ns >= SEGMENT_NS // 2
        return unit.keyframe and (long or not self.first.keyframe)

    def append(self, unit: AccessUnit) -> None:
        self.last = unit
        self.size_bytes += len(unit.data)
        self.units += 1


def worth(utility: float, capture_ns: int) -> float:
    """A still's worth: log2 of its utility plus its time in half-lives, so the order of two stills never changes."""
    if utility > 0:
        strength = max(_LEAST_STRENGTH, math.log2(min(utility, 1e12)))
    else:
        strength = _LEAST_STRENGTH - math.log2(1 + min(-utility, 1e12))
    return strength + capture_ns / _HALF_LIFE_NS


def moved_rank(kind: BacklogKind, moved_ns: int) -> float:
    """The change of an object's rank when its time moves by ``moved_ns``."""
    return moved_ns / _HALF_LIFE_NS if kind is BacklogKind.STILL else float(moved_ns)
