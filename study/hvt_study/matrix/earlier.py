"""Rows of an earlier start in the same folder: those that this one has nothing better for stay.

Who adds a method, a budget or a sequence to ``--out`` gets a table of all. Who is interrupted loses no finished run.
Of one run two rows never stand: what was flown now takes the place of what was flown before.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from hvt_common.errors import UserError
from hvt_study.cache.results import content_key
from hvt_study.matrix.accounting import in_accounting
from hvt_study.matrix.plan import StudyPlan
from hvt_study.runs.match_total import SAME_TOTAL
from hvt_study.runs.spec import said_run

RunRow = Mapping[str, Any]
_CONDITIONS = ("dataset", "sequence", "regime", "budget_bps", "labels", "size", "max_frames", "detect_every")


def staying(done: Iterable[RunRow], earlier: Iterable[RunRow]) -> list[dict[str, Any]]:
    """Which earlier rows belong beside those that were done now, in their order, rates by the processed span.

    Not those of which there is a newer one, whatever its parameters and whatever ran its networks; and no video at
    the total of a run that spends something else by now.
    """
    done = list(done)
    replaced = {(_place(row), row["method"]) for row in done}
    totals = {_place(row): row["total_bps"] for row in done if not row["matched_to"]}
    return [
        row
        for row in in_accounting(earlier, "span")
        if (_place(row), row["method"]) not in replaced and _up_to_date(row, totals)
    ]


def check_parameters(plan: StudyPlan, earlier: Iterable[RunRow], *, out: Path) -> None:
    """`UserError` where a table holds runs of a method of this study with other parameters: no report takes both."""
    tunes = {method.name: list((plan.tune or {}).get(method.name, ())) for method in plan.methods}
    for row in earlier:
        known = said_run(row).get("tune")
        if row["failed"] or known is None or known == tunes.get(row["method"], known):
            continue
        said = " ".join(known) or "its defaults"
        raise UserError(
            f"--out {out} holds runs of {row['method']} with {said}, which go into no table with others: "
            "name another folder, or remove its results.parquet"
        )


def _up_to_date(row: RunRow, totals: Mapping[str, int | None]) -> bool:
    if not row["matched_to"] or _place(row) not in totals:
        return True
    total, target = totals[_place(row)], row["target_bps"]
    if not total or not target:
        return False
    return math.isclose(target, total, rel_tol=SAME_TOTAL)


def _place(row: RunRow) -> str:
    """Names a run that decides what it spends, by what it is and not by how: those that match its total share it."""
    run = said_run(row)
    if not run:
        return str(row["key"])
    whose = run.get("target") or run
    models = {name: value for name, value in (run.get("models") or {}).items() if name != "provider"}
    return content_key(
        whose.get("method"), whose.get("still_codec"), models, [run.get(name) for name in _CONDITIONS]
    )
