"""What stands behind the results: the definition of each figure, and the runs that count nowhere."""

from __future__ import annotations

from collections.abc import Iterable

from hvt_study.report.data.arms import RunRow, counts, place
from hvt_study.report.data.document import Cell, Table, breaks_between, words
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
