"""The store of a killed edge, read as the next start of the edge would read it."""

import secrets
from dataclasses import dataclass
from pathlib import Path

from hvt_common.protocol.messages import BacklogKind, parse_backlog_units
from hvt_edge.backlog.disk import FILE_NAME, Store
from hvt_edge.backlog.entry import Entry


@dataclass(frozen=True, slots=True)
class StoreLeft:
    """Numbers of one store."""

    objects: int
    """Stills and stretches of video."""
    unreadable: int
    """Those of them that cannot be read."""
    missing_s: float = 0.0
    """The time of a stretch from the first frame that cannot be read to the end of the last one stored."""
    stills: frozenset[int] = frozenset()
    """Their numbers."""


def store_left(path: Path) -> StoreLeft:
    """Open it, read everything, give nothing back; a store that was never needed is not there."""
    if not (path / FILE_NAME).exists():
        return StoreLeft(0, 0)
    with Store(path, max_bytes=10**9, session_id=secrets.randbits(64), info=lambda: b"") as store:
        store.enter()
        entries = [*store.best_stills(), *store.newest_segments()]
        whole = {entry: store.read(entry) for entry in entries}
    stills = frozenset(one.number for one in entries if one.kind is BacklogKind.STILL)
    missing_s = max((_missing_s(entry, data) for entry, data in whole.items()), default=0.0)
    return StoreLeft(len(entries), sum(data is None for data in whole.values()), missing_s, stills)


def _missing_s(entry: Entry, data: bytes | None) -> float:
    if entry.kind is not BacklogKind.BASE or data is None:
        return entry.span_ns / 1e9
    units = parse_backlog_units(data)
    return (entry.span_ns - (units[-1].capture_ns - units[0].capture_ns)) / 1e9
