"""What a killed edge left in its store, read as the next start of the edge would read it."""

from __future__ import annotations

import math
import secrets
from dataclasses import dataclass
from pathlib import Path

from hvt_common.protocol.messages import BacklogKind
from hvt_edge.backlog.disk import Folder
from hvt_edge.backlog.segment import DamagedError, last_ns, read_segment

__all__ = ["StoreLeft", "store_left"]

_BUFFERED_S = 0.301


@dataclass(frozen=True, slots=True)
class StoreLeft:
    """Numbers of one store."""

    objects: int
    """Stills and stretches of video."""
    unreadable: int
    """Of them; a stretch of which nothing had reached the disk yet is missing, not unreadable."""
    missing_s: float = 0.0
    """Of a stretch: from the first frame that cannot be read to the end of the last one noted in its index."""
    stills: frozenset[int] = frozenset()
    """Their numbers."""


def store_left(path: Path, *, frame_s: float = 0.1) -> StoreLeft:
    """Open it, read everything, give nothing back; a store that was never needed is not there."""
    if not path.is_dir():
        return StoreLeft(0, 0)
    session_id = secrets.randbits(64)
    with Folder(path, max_bytes=10**9, session_id=session_id, info=lambda: b"") as folder:
        entries = [*folder.best_stills(), *folder.newest_segments()]
        missing = {
            one.path: _missing_s(one.path, frame_s=frame_s) for one in entries if one.kind is BacklogKind.BASE
        }
        unreadable = sum(
            folder.read(one) is None and missing.get(one.path, math.inf) > _BUFFERED_S for one in entries
        )
    stills = frozenset(one.number for one in entries if one.kind is BacklogKind.STILL)
    return StoreLeft(len(entries), unreadable, max(missing.values(), default=0.0), stills)


def _missing_s(video: Path, *, frame_s: float) -> float:
    noted_ns = last_ns(video)
    try:
        whole_ns = read_segment(video)[-1].capture_ns
    except DamagedError:  # its first frames were not flushed: all that is noted is missing
        return _noted_s(video, frame_s=frame_s)
    return (noted_ns - whole_ns) / 1e9


def _noted_s(video: Path, *, frame_s: float) -> float:
    first_ns = int(video.stem.rpartition("-")[2])
    noted_ns = last_ns(video)
    return (noted_ns - first_ns) / 1e9 + frame_s if noted_ns else 0.0
