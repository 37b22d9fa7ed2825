"""Tracks as tables: CSV and Parquet with the columns of ``--tracks``, and MOTChallenge's text."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from hvt_ground.exports.recorded import Recorded
from hvt_ground.sinks.tracks_table import COLUMNS, track_rows

__all__ = ["write_csv", "write_mot", "write_parquet"]

_TYPES = {
    "frame": pa.int64(),
    "capture_utc": pa.string(),
    "id": pa.int64(),
    **dict.fromkeys(("x", "y", "w", "h", "confidence"), pa.float32()),
    **dict.fromkeys(("base_class", "class", "origin"), pa.dictionary(pa.int32(), pa.string())),
    **dict.fromkeys(("refined", "late", "doubted"), pa.bool_()),
}


def write_csv(recorded: Recorded, path: Path) -> None:
    """One line a track and frame, the columns of `hvt_ground.sinks.tracks_table`."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows(_rows(recorded))


def write_parquet(recorded: Recorded, path: Path) -> None:
    """The same as a Parquet file."""
    columns = list(zip(*_rows(recorded), strict=True)) or [()] * len(COLUMNS)
    table = {}
    for name, column in zip(COLUMNS, columns, strict=True):
        kind = _TYPES[name]
        number = float if pa.types.is_floating(kind) else bool if pa.types.is_boolean(kind) else None
        values = column if number is None else [number(one) for one in column]
        table[name] = (
            pa.array(values, pa.string()).cast(kind)
            if pa.types.is_dictionary(kind)
            else pa.array(values, kind)
        )
    pq.write_table(pa.table(table), path, compression="zstd")


def write_mot(recorded: Recorded, path: Path) -> None:
    """``frame,id,x,y,w,h,confidence,-1,-1,-1``: base pixels, frames from 1 (MOTChallenge, Dendorfer et al., 2020).

    Tracks that stills doubt are left out: the format has no word for them.
    """
    place = {name: COLUMNS.index(name) for name in COLUMNS}
    with path.open("w", encoding="utf-8") as file:
        for row in _rows(recorded):
            if not row[place["doubted"]]:
                values = (row[place[name]] for name in ("frame", "id", "x", "y", "w", "h", "confidence"))
                file.write(",".join(map(str, values)) + ",-1,-1,-1\n")


def _rows(recorded: Recorded) -> Iterator[tuple[object, ...]]:
    for overlay in recorded.overlays():
        yield from track_rows(overlay)
