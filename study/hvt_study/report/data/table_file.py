"""``results.parquet``: one row a run; types and order as `hvt_study.runs.spec.COLUMNS` has them."""

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from hvt_common.errors import UserError
from hvt_common.files import write_whole
from hvt_study.runs.spec import COLUMNS, Column

RESULTS = "results.parquet"
SWEEP = "sweep.csv"
_TYPES = {"text": pa.string(), "int": pa.int64(), "real": pa.float64(), "yes": pa.bool_()}
_NAMED = 4
_NEEDED = ("budget_bps", "duration_s", "clip_s", "total_bps", "target_bps")
"""Figures that no table may be without."""

SCHEMA = pa.schema(
    [
        pa.field(
            column.name,
            _TYPES[column.type],
            nullable=column.type != "text",
            metadata={"description": column.description} if column.description else None,
        )
        for column in COLUMNS
    ],
    metadata={"hvt": "results of hvt-study, one row a run"},
)
"""Text is empty where a run has none, figures are null; a column's meaning is its field's ``description``."""


def write_results(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write the table, whole or not at all: the old one stays until the new one is complete.

    NaN becomes null. A column that a row does not have is null, or the empty text. Raises `UserError` where the file
    cannot be written.
    """
    table = pa.table(
        {column.name: [_value(row.get(column.name), column) for row in rows] for column in COLUMNS},
        schema=SCHEMA,
    )
    content = io.BytesIO()
    pq.write_table(table, content, compression="zstd")
    try:
        write_whole(path, content.getvalue())
    except OSError as error:
        raise UserError(f"{path} cannot be written ({_why(error)}): name a folder that can") from None


def read_results(path: Path) -> list[dict[str, Any]]:
    """The rows in the order in which they were written; null is None. Columns that are not ours are passed over.

    Raises `UserError` where the file is missing, damaged, or no table of a study.
    """
    try:
        with path.open("rb") as file:
            table = pq.read_table(file)
    except FileNotFoundError:
        raise UserError(f"{path} does not exist: hvt-study run --out {path.parent} writes it") from None
    except (OSError, pa.ArrowException) as error:
        raise UserError(f"{path} cannot be read as Parquet ({_why(error)}): run the study again") from None
    absent = [column for column in COLUMNS if column.name not in table.column_names]
    missing = [column.name for column in absent if column.type in ("text", "yes") or column.name in _NEEDED]
    if missing:
        more = f" and {len(missing) - _NAMED} more" if len(missing) > _NAMED else ""
        raise UserError(
            f"{path} has no column {', '.join(missing[:_NAMED])}{more}: run the study again with this version"
        )
    for column in absent:  # a figure that an earlier version did not have is null
        table = table.append_column(column.name, pa.nulls(len(table), _TYPES[column.type]))
    try:
        rows: list[dict[str, Any]] = table.select(SCHEMA.names).cast(SCHEMA).to_pylist()
    except (pa.ArrowException, ValueError) as error:
        raise UserError(f"{path} has a column of another type ({_why(error)}): run the study again") from None
    return rows


def _value(value: Any, column: Column) -> Any:
    if column.type == "text":
        return "" if value is None else str(value)
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return None
    return {"int": int, "real": float, "yes": bool}[column.type](value)


def _why(error: BaseException) -> str:
    """The first line of a library's message; the others are its own affairs."""
    own = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return own.strip().partition("\n")[0].rstrip(".") or type(error).__name__
