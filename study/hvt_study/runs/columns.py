"""One row a run: the columns of ``results.parquet``, in their order, out of ``columns.csv`` beside this file.

Metrics that a run cannot have are null.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Literal

Type = Literal["text", "int", "real", "yes"]


@dataclass(frozen=True, slots=True)
class Column:
    """A column, its type, what it says, and how the tables of the report show it."""

    name: str
    type: Type
    group: str
    """Of metrics; empty for what no table of the report shows."""
    title: str
    """In the head of a table."""
    style: Literal["", "share", "kbps", "count", "seconds", "ms", "bytes", "rate", "nats"]
    better: Literal["", "more", "less"]
    over: Literal["", "mean", "median"]
    """What is taken over sequences: waits may be infinite, which a mean does not survive."""
    description: str
    """``{time}`` stands for what rates are divided by."""


def _columns() -> tuple[Column, ...]:
    text = files("hvt_study.runs").joinpath("columns.csv").read_text(encoding="utf-8")
    rows: list[dict[str, Any]] = list(csv.DictReader(text.splitlines()))
    return tuple(Column(**row) for row in rows)


COLUMNS: tuple[Column, ...] = _columns()
"""The table of a study."""
