"""The rows of the one table: scenario, measure, value, bar, holds; to be read, and as JSON."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.table import Table


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
    """For the terminal: the first column, measure, value, bar, holds."""
    from rich.table import Table  # the bars alone are for any Python

    found = Table(title=title, title_justify="left")
    for name in rows[0]:
        found.add_column(name, justify="right" if name in ("value", "bar", "holds") else "left")
    for *of, value, bar, holds_ in (one.values() for one in rows):
        shown = f"{value:.3f}" if isinstance(value, float) else "" if value is None else str(value)
        found.add_row(*of, shown, bar or "", {True: "yes", False: "NO", None: ""}[holds_])
    return found


def save(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """As JSON, which knows no infinity: it says ``never``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = [
        {**one, "value": "never"} if isinstance(one["value"], float) and math.isinf(one["value"]) else one
        for one in rows
    ]
    path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
