"""The selector sweep of ``hvt-study sweep``, as the paper has it."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from hvt_common.errors import UserError
from hvt_study.matrix.sweep import COLUMNS as SWEEP_COLUMNS
from hvt_study.report.data.document import Cell, Head, Table

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
