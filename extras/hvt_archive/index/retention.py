"""Decides which files of a folder are due to go, as a pure function of the index."""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from hvt_common.units import SECOND_NS, Limit
from hvt_ground.recordings.row import RecordingRow

_OWN = re.compile(r"hvt-(.+)-(\d{8}-\d{6})(-\d+|-backlog)*\.rrd")
_CLOCK_SET_NS = 1_577_836_800 * SECOND_NS
"""2020: a name of before was given before the machine knew the time, and nobody knows how old the file is."""
_TRUSTED_SHARE = 1 / 4


@dataclass(frozen=True, slots=True)
class Retention:
    """The rules: files within all ``limits`` stay, their video up to ``video_age``. Without rules all stays."""

    limits: tuple[Limit, ...] = ()
    video_age: Limit | None = None

    @property
    def ages(self) -> tuple[Limit, ...]:
        """Those of the limits that are times."""
        return tuple(one for one in self.limits if one.seconds is not None)

    @property
    def trusted_ns(self) -> int:
        """The most that the clock's word for the time between two boots counts.

        A clock that is wrong once, by however much, makes no file of today too old.
        """
        ages = [one.seconds or 0.0 for one in (*self.ages, self.video_age) if one is not None]
        return round(min(ages, default=0.0) * _TRUSTED_SHARE * SECOND_NS)


@dataclass(frozen=True, slots=True)
class Due:
    """Names of files."""

    remove: tuple[str, ...] = ()
    outdated: tuple[str, ...] = ()
    """Too old: these go one by one."""
    strip: tuple[str, ...] = ()
    """These lose their video, one by one."""


def due(
    rows: Sequence[RecordingRow], retention: Retention, *, in_use: Callable[[str], bool], now_ns: int
) -> Due:
    """The due removals, the oldest first.

    | a file | is |
    |---|---|
    | that is written to (``in_use``) | left alone, but counts among the bytes |
    | whose last byte is older than a time of ``limits``, and its name too | removed |
    | of an edge above its share, the oldest of these, while all have more bytes than ``limits`` allow | removed |
    | with video, older than ``video_age`` as above | stripped of it |

    Each edge has the same share of the bytes that ``limits`` allow: one that sends much evicts nobody else's.
    """
    ordered = sorted(rows, key=lambda row: (row.written_ns, in_name(row.file)[1], row.file))
    outdated = dict.fromkeys(
        row.file
        for limit in retention.ages
        for row in ordered
        if _older(row, limit, now_ns) and not in_use(row.file)
    )
    removed: dict[str, None] = {}
    for limit in retention.limits:
        if limit.size_bytes is not None:
            removed |= dict.fromkeys(_surplus(ordered, limit.size_bytes, in_use))
    video = retention.video_age
    stripped = tuple(
        row.file
        for row in ordered
        if video is not None
        and row.video
        and row.file not in outdated
        and row.file not in removed
        and _older(row, video, now_ns)
        and not in_use(row.file)
    )
    return Due(tuple(removed), tuple(outdated), stripped)


def _surplus(
    ordered: Sequence[RecordingRow], most_bytes: int, in_use: Callable[[str], bool]
) -> Iterator[str]:
    # An edge below its share never gets above it here, so one pass finds them; only files in use may be left over.
    held = Counter[str]()
    for row in ordered:
        held[row.edge] += row.size_bytes
    excess, share = held.total() - most_bytes, most_bytes / max(1, len(held))
    spared: list[RecordingRow] = []
    for fair in (True, False):
        for row in ordered if fair else spared:
            if excess <= 0:
                return
            if in_use(row.file):
                continue
            if fair and held[row.edge] <= share:
                spared.append(row)
                continue
            held[row.edge] -= row.size_bytes
            excess -= row.size_bytes
            yield row.file


def in_name(name: str) -> tuple[str, str]:
    """The edge and the local time in a name that a ground gives of its own accord; empty for the copy of somebody."""
    found = _OWN.fullmatch(name)
    return (found[1], found[2]) if found else ("", "")


def _begun_ns(name: str) -> int | None:
    """The beginning of a file's session by its name, Unix time; None where that says nothing."""
    try:
        return int(time.mktime(time.strptime(in_name(name)[1], "%Y%m%d-%H%M%S"))) * SECOND_NS
    except (ValueError, OverflowError):
        return None


def _older(row: RecordingRow, limit: Limit, now_ns: int) -> bool:
    # Whether it is older, by the index's own time and by its name.
    limit_ns = (limit.seconds or 0.0) * SECOND_NS
    if now_ns - row.written_ns <= limit_ns:
        return False
    began_ns = _begun_ns(row.file)
    return began_ns is not None and began_ns >= _CLOCK_SET_NS and now_ns - began_ns > limit_ns
