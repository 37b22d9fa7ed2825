"""The rows of the one table: scenario, measure, value, bar, holds; to be read, and as JSON."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

_COLUMNS = ("scenario", "measure", "value", "bar", "holds")


def row(scenario: str, measure: str, value: float | None, bar: str | None) -> dict[str, Any]:
    """One row; without a bar nothing is said of holding."""
    value = None if value is None else round(value, 3)
    return {
        "scenario": scenario,
        "measure": measure,
        "value": value,
        "bar": bar,
        "holds": None if bar is None else holds(value, bar),
    }


def holds(value: float | None, bar: str) -> bool:
    """Whether ``value`` is as a bar such as ``<= 2`` says; an unknown or infinite value is not."""
    sign, limit = re.fullmatch(r"(<=|>=|==)\s*(\S+)", bar).groups()  # type: ignore[union-attr]
    if value is None or not math.isfinite(value):
        return False
    return {"<=": value <= float(limit), ">=": value >= float(limit), "==": value == float(limit)}[sign]


def table(rows: Sequence[dict[str, Any]], *, title: str) -> Table:
    """For the terminal."""
    found = Table(title=title, title_justify="left")
    for name in _COLUMNS:
        found.add_column(name, justify="left" if name in ("scenario", "measure") else "right")
    for one in rows:
        value = one["value"]
        shown = f"{value:.2f}" if isinstance(value, float) else "" if value is None else str(value)
        sign = {True: "yes", False: "NO", None: ""}[one["holds"]]
        found.add_row(one["scenario"], one["measure"], shown, one["bar"] or "", sign)
    return found


def save(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """As JSON, which knows no infinity: it says ``never``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = [
        {**one, "value": "never"} if isinstance(one["value"], float) and math.isinf(one["value"]) else one
        for one in rows
    ]
    path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
