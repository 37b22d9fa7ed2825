"""Reads the table of `hvt-ground --timing` (see `hvt_archive.exports.tables`)."""

import csv
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Arrival:
    """One message as the ground got it. Times are Unix seconds; edge and ground share this machine's clock."""

    kind: str
    """base, roi, tracks, status, backlog-still, backlog-base or backlog-info."""
    sequence: int
    frame_index: int
    capture_s: float
    send_s: float
    received_s: float
    shown: bool
    """It was decoded (base), or read (roi)."""
    line_bytes: int

    @property
    def delay_s(self) -> float:
        return self.received_s - self.capture_s


def read_timing(path: Path) -> list[Arrival]:
    """All whole rows, as they were written; none where there is no file yet."""
    if not path.exists():
        return []
    text = path.read_text(encoding="ascii")
    whole = text[: text.rfind("\n") + 1]
    return [
        Arrival(
            kind=row["kind"],
            sequence=int(row["sequence"]),
            frame_index=int(row["frame_index"]),
            capture_s=int(row["capture_ns"]) / 1e9,
            send_s=int(row["send_ns"]) / 1e9,
            received_s=int(row["received_ns"]) / 1e9,
            shown=int(row["shown_ns"]) > 0,
            line_bytes=int(row["line_bytes"]),
        )
        for row in csv.DictReader(whole.splitlines())
    ]
