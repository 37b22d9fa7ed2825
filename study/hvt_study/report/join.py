"""Several studies as one: tables of machines that shared the work, or of the same sequences under other conditions.

Runs under other conditions (size, detections, length, fusion) have tables of their own in the report; two that differ
in what no table tells apart are refused before anything is written.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from hvt_common.errors import UserError, check_not_read
from hvt_study.matrix.accounting import in_accounting
from hvt_study.metrics.bits import Accounting
from hvt_study.report.data.arms import settings
from hvt_study.report.data.table_file import RESULTS, SWEEP, read_results, write_results
from hvt_study.report.example.store import load_example, save_example


def join_studies(folders: Sequence[Path], out: Path) -> None:
    """Write one table of all their runs into ``out``; of a run that several have the first counts.

    Rates are in the accounting of the first table. The flight in pictures and the selector sweep are those of the
    first folder that has one.

    Raises:
        UserError: a table cannot be used, two runs that differ are at one place, or ``out`` cannot be written.
    """
    if len(folders) > 1:  # of one study a table of the same runs is written
        check_not_read(out / RESULTS, (folder / RESULTS for folder in folders), name="--out")
    tables = [read_results(folder / RESULTS) for folder in folders]
    accounting: Accounting = next((row["accounting"] for rows in tables for row in rows), "span")
    joined = {row["key"]: row for rows in reversed(tables) for row in in_accounting(rows, accounting)}
    order = dict.fromkeys(row["key"] for rows in tables for row in rows)
    rows = [joined[key] for key in order]
    settings(rows)  # refuses those that do not go together
    try:
        out.mkdir(parents=True, exist_ok=True)
        sweep = next((folder / SWEEP for folder in folders if (folder / SWEEP).exists()), None)
        if sweep is not None and not (out / SWEEP).exists():
            shutil.copyfile(sweep, out / SWEEP)
    except OSError as error:
        raise UserError(f"--out {out} cannot be written ({error.strerror}): name a folder that can") from None
    write_results(rows, out / RESULTS)
    example = next((found for folder in folders if (found := load_example(folder)) is not None), None)
    if example is not None:
        save_example(out, example)
