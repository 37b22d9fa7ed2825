"""The selector sweep of ``hvt-study sweep``, as the paper has it."""

from __future__ import annotations

import csv
from pathlib import Path

from hvt_common.errors import UserError
from hvt_study.matrix.sweep import COLUMNS as SWEEP_COLUMNS
from hvt_study.report.data.document import Cell, Head, Table

__all__ = ["sweep_table"]


def sweep_table(path: Path) -> Table | None:
    """The selector sweep that ``hvt-study sweep --out`` left here; None where there is none.

    Raises:
        UserError: the file is not what that command writes.
    """
    if not path.exists():
        return None
    try:
        cells = _cells(path)
    except (OSError, UnicodeDecodeError, ValueError, KeyError, TypeError, csv.Error):
        raise UserError(
            f"{path} is not a table of {','.join(SWEEP_COLUMNS)}: write it with hvt-study sweep --out {path.parent}"
        ) from None
    heads = (
        Head("selector", number=False),
        Head("selected"),
        Head("ratio", says="of the raw detections"),
        Head("frame coverage", says="share of frames with raw detections that keep at least one ROI"),
    )
    caption = "Selector sweep: what each of the pilot's selectors keeps of raw detections in all. No labels."
    return Table(caption, heads, cells)


def _cells(path: Path) -> tuple[tuple[Cell, ...], ...]:
    with path.open(encoding="utf-8", newline="") as file:
        reader = csv.DictReader(file)
        rows = list(reader)
    if not rows or not set(SWEEP_COLUMNS) <= set(reader.fieldnames or ()):
        raise ValueError("no rows, or other columns")
    return tuple(
        (
            Cell(row["policy"]),
            Cell(str(int(row["selected"]))),
            Cell(f"{float(row['ratio']):.4f}"),
            Cell(f"{float(row['frame_coverage']):.4f}"),
        )
        for row in rows
    )
