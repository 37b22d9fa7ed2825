"""Tracks as tables: CSV and Parquet with the columns of ``--tracks``, and MOTChallenge's text."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from hvt_ground.recordings.contract import Recorded
from hvt_ground.sinks.event_tables import TRACK_COLUMNS, plain_cells, track_rows

_BATCH_ROWS = 100_000
_TYPES = {
    "frame_index": pa.int64(),
    "capture_utc": pa.string(),
    "id": pa.int64(),
    **dict.fromkeys(("x", "y", "w", "h", "confidence"), pa.float32()),
    **dict.fromkeys(("base_class", "class", "origin"), pa.dictionary(pa.int32(), pa.string())),
    **dict.fromkeys(("refined", "late", "doubted"), pa.bool_()),
    **dict.fromkeys(("latitude", "longitude"), pa.float64()),
    "error_m": pa.float32(),
}


def write_csv(recorded: Recorded, path: Path) -> None:
    """One line a track and frame, the columns of `hvt_ground.sinks.event_tables`."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(TRACK_COLUMNS)
        writer.writerows(map(plain_cells, _rows(recorded)))


def write_parquet(recorded: Recorded, path: Path) -> None:
    """The same as a Parquet file."""
    schema = pa.schema([(name, _TYPES[name]) for name in TRACK_COLUMNS])
    rows = _rows(recorded)
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        while batch := list(islice(rows, _BATCH_ROWS)):
            writer.write_table(_table(batch, schema))


def _table(rows: Sequence[tuple[object, ...]], schema: pa.Schema) -> pa.Table:
    columns = []
    for field, column in zip(schema, zip(*rows, strict=True), strict=True):
        kind = field.type
        number = float if pa.types.is_floating(kind) else bool if pa.types.is_boolean(kind) else None
        values = column if number is None else [None if one == "" else number(one) for one in column]
        text = pa.types.is_dictionary(kind)
        columns.append(pa.array(values, pa.string()).cast(kind) if text else pa.array(values, kind))
    return pa.table(columns, schema=schema)


def write_mot(recorded: Recorded, path: Path) -> None:
    """``frame,id,x,y,w,h,confidence,-1,-1,-1``: base pixels, frames from 1 (MOTChallenge, Dendorfer et al., 2020).

    Tracks that stills doubt are left out: the format has no word for them.
    """
    doubted = TRACK_COLUMNS.index("doubted")
    with path.open("w", encoding="utf-8") as file:
        for overlay in recorded.overlays():
            for row in track_rows(overlay):
                if not row[doubted]:
                    _, _, *values = row[: TRACK_COLUMNS.index("confidence") + 1]
                    file.write(",".join(map(str, (overlay.frame_index + 1, *values))) + ",-1,-1,-1\n")


def _rows(recorded: Recorded) -> Iterator[tuple[object, ...]]:
    for overlay in recorded.overlays():
        yield from track_rows(overlay)
