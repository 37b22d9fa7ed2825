"""From ``results.parquet`` and what else lies in a study's folder to ``report.html``, ``report.md`` and figures."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from pathlib import Path

from hvt_common.errors import UserError
from hvt_study.matrix.accounting import in_accounting
from hvt_study.metrics.bits import Accounting
from hvt_study.report.data.document import Drawing, Pictures, Report
from hvt_study.report.data.table_file import RESULTS, SWEEP, read_results
from hvt_study.report.example.store import load_example
from hvt_study.report.make import make_report
from hvt_study.report.pages.render import FIGURES, html_page, markdown_page
from hvt_study.report.tables.sweep_table import sweep_table

_OURS = re.compile(
    r"(?:(?:answer|timeline|(?:differences|equal-quality|utility|codecs)-\d+)(?:-[A-Za-z0-9.-]+)?\.(?:svg|pdf)"
    r"|crop-\d+-(?:source|base|still)\.png)"
)
"""Files that a report of ours may have written."""


def write_report(folder: Path, *, accounting: Accounting | None = None) -> None:
    """Read the table again and write ``report.md``, ``report.html`` and ``figures/`` beside it, each file whole.

    Figures of an earlier report that this one does not have are removed.

    ``accounting`` is what the pages divide rates by; None: what the table does.

    Raises:
        UserError: the table cannot be used, or the folder not be written.
    """
    rows = read_results(folder / RESULTS)
    report = make_report(
        rows if accounting is None else in_accounting(rows, accounting),
        sweep=sweep_table(folder / SWEEP),
        example=load_example(folder),
    )
    try:
        figures = dict(_figure_files(report))
        (folder / FIGURES).mkdir(exist_ok=True)
        for name, content in figures.items():
            _put(folder / FIGURES / name, content)
        _put(folder / "report.md", markdown_page(report).encode())
        _put(folder / "report.html", html_page(report).encode())
        _remove_others(folder / FIGURES, figures.keys())
    except OSError as error:
        raise UserError(f"{folder} cannot be written ({error.strerror}): name a folder that can") from None


def _figure_files(report: Report) -> Iterator[tuple[str, bytes]]:
    for part in (part for section in report.sections for part in section.parts):
        if isinstance(part, Drawing):
            yield f"{part.name}.svg", _on_white(part.svg).encode()
            yield f"{part.name}.pdf", part.pdf
        elif isinstance(part, Pictures):
            for picture in (one for row in part.rows for one in row.pictures):
                yield f"{picture.name}.png", picture.png


def _put(path: Path, content: bytes) -> None:
    scratch = path.with_name(path.name + ".part")
    scratch.write_bytes(content)
    scratch.replace(path)


def _on_white(svg: str) -> str:
    """A file is looked at on whatever ground its viewer has; black lines ask for a light one."""
    head = svg.index(">", svg.index("<svg")) + 1
    return f'{svg[:head]}\n <rect width="100%" height="100%" fill="#ffffff"/>{svg[head:]}'


def _remove_others(figures: Path, names: Collection[str]) -> None:
    for path in figures.iterdir():
        if path.name not in names and _OURS.fullmatch(path.name):
            path.unlink()
