"""Which files of a folder are due to go, as a pure function of what the index says."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from hvt_common.units import SECOND_NS, Limit
from hvt_ground.recordings.row import RecordingRow

__all__ = ["Due", "Retention", "due"]

_CLOCK_SET_NS = 1_577_836_800 * SECOND_NS
"""2020: a file that is older was written before the machine knew the time, and nobody knows how old it is."""


@dataclass(frozen=True, slots=True)
class Retention:
    """What stays: files within all ``limits``, their video up to ``video_age``. Without them all stays."""

    limits: tuple[Limit, ...] = ()
    video_age: Limit | None = None


@dataclass(frozen=True, slots=True)
class Due:
    """Names of files."""

    remove: tuple[str, ...] = ()
    strip: tuple[str, ...] = ()
    """These lose their video."""


def due(rows: Sequence[RecordingRow], retention: Retention, *, in_use: Collection[str], now_ns: int) -> Due:
    """What is to be done, the oldest first.

    | a file | is |
    |---|---|
    | that is written to (``in_use``) | left alone, but counts among the bytes |
    | whose last byte is older than a time of ``limits`` | removed |
    | that is the oldest left while all have more bytes than ``limits`` allow | removed |
    | with video, older than ``video_age`` | stripped of it |
    """
    ordered = sorted(rows, key=lambda row: (row.written_ns, row.file))
    free = [row for row in ordered if row.file not in in_use]
    removed: list[str] = []
    for limit in retention.limits:
        if limit.seconds is not None:
            removed += [row.file for row in free if _older(row, limit, now_ns)]
    for limit in retention.limits:
        if limit.size_bytes is not None:
            excess = sum(row.size_bytes for row in rows if row.file not in removed) - limit.size_bytes
            for row in free:
                if excess > 0 and row.file not in removed:
                    removed.append(row.file)
                    excess -= row.size_bytes
    video = retention.video_age
    stripped = [
        row.file
        for row in free
        if video is not None and row.video and row.file not in removed and _older(row, video, now_ns)
    ]
    return Due(tuple(removed), tuple(stripped))


def _older(row: RecordingRow, limit: Limit, now_ns: int) -> bool:
    age_ns = now_ns - row.written_ns
    return row.written_ns >= _CLOCK_SET_NS and age_ns > (limit.seconds or 0.0) * SECOND_NS
