"""Beside the results: the definition of each figure, the runs that count nowhere, and the pilot's selector sweep."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from hvt_common.errors import UserError
from hvt_study.matrix.sweep import COLUMNS as SWEEP_COLUMNS
from hvt_study.report.data.arms import RunRow, counts, place
from hvt_study.report.data.document import Cell, Head, Table, breaks_between, words
from hvt_study.report.data.metric_names import METRICS, NOTHING, definition


def metrics_table(accounting: str) -> Table:
    """What each figure is, where rates are of this accounting."""
    better = {"more": "higher", "less": "lower", "": NOTHING}
    rows = tuple(
        (
            Cell(one.group),
            Cell(one.title),
            Cell(one.name),
            Cell(definition(one, accounting)),
            Cell(better[one.better]),
        )
        for one in METRICS.values()
    )
    titles = ("about", "metric", "column", "definition", "better")
    caption = "Metrics. A figure that a run cannot have is null in the table and a dash here, never 0."
    return Table(caption, words(*titles), rows, breaks_between(one.group for one in METRICS.values()))


def failed_table(rows: Iterable[RunRow]) -> Table | None:
    """Every run that counts nowhere, by name, with the reason; None where all count."""
    failed = [row for row in rows if not counts(row)]
    if not failed:
        return None
    cells = tuple(
        (
            Cell(place(row["dataset"])),
            Cell(row["sequence"]),
            Cell(row["regime"]),
            Cell(f"{row['method']} {row['still_codec']}".strip()),
            Cell(f"{row['matched_to']} {row['matched_codec']}".strip() or NOTHING),
            Cell(row["failed"] or "missed the total that it was to match by more than 1 %"),
        )
        for row in failed
    )
    titles = ("dataset", "sequence", "regime", "method", "at the total of", "why")
    other = any(row["accounting"] == "pilot" for row in failed)
    rates = " Rates in the reasons are over the processed span, not the whole clip." if other else ""
    caption = f"Runs that failed or missed their match ({len(failed)}): they are in no average.{rates}"
    return Table(caption, words(*titles), cells)


_TYPES = {"policy": str, "selected": int, "ratio": float, "frame_coverage": float}


def sweep_table(path: Path) -> Table | None:
    """The selector sweep that ``hvt-study sweep --out`` left here; None where there is none.

    Raises:
        UserError: the file is not what that command writes.
    """
    if not path.exists():
        return None
    try:
        found = pd.read_csv(path, dtype=_TYPES, usecols=list(_TYPES))
        if found.empty or found.isna().any(axis=None):
            raise ValueError("no rows, or cells without a value")  # noqa: TRY301
    except (OSError, ValueError):
        raise UserError(
            f"{path} is not a table of {','.join(SWEEP_COLUMNS)}: write it with hvt-study sweep --out {path.parent}"
        ) from None
    heads = (
        Head("selector", number=False),
        Head("selected"),
        Head("ratio", says="of the raw detections"),
        Head("frame coverage", says="share of frames with raw detections that keep at least one ROI"),
    )
    rows = tuple(
        (
            Cell(row.policy),
            Cell(str(row.selected)),
            Cell(f"{row.ratio:.4f}"),
            Cell(f"{row.frame_coverage:.4f}"),
        )
        for row in found.itertuples()
    )
    caption = "Selector sweep: what each of the pilot's selectors keeps of raw detections in all. No labels."
    return Table(caption, heads, rows)
