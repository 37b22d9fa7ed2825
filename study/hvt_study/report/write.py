"""From ``results.parquet`` and the other files of studies' folders to one table, pages and figures.

The HTML page needs no other file: style, drawings and pictures are in it, and nothing is loaded from the network. It
takes the reader's light or dark, and prints on A4. The templates lie beside this file.
"""

import base64
import re
import shutil
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from html import escape
from pathlib import Path

from jinja2 import Environment, PackageLoader, select_autoescape
from markupsafe import Markup

from hvt_common.errors import UserError, check_not_read
from hvt_common.files import write_whole
from hvt_study.metrics.bits import Accounting, in_accounting
from hvt_study.report.data.arms import settings
from hvt_study.report.data.document import Drawing, Pictures, Report, numbered
from hvt_study.report.data.table_file import RESULTS, SWEEP, read_results, write_results
from hvt_study.report.example.choice import load_example, save_example
from hvt_study.report.make import make_report
from hvt_study.report.tables import sweep_table

FIGURES = "figures"
_ID = re.compile(r'\bid="([^"]+)"')
_REFERENCE = re.compile(r'(?:xlink:)?href="#([^"]+)"|url\(#([^)]+)\)')


def html_page(report: Report) -> str:
    return _rendered("report.html.j2", report)


def markdown_page(report: Report) -> str:
    return _rendered("report.md.j2", report)


def inline_svg(drawing: Drawing) -> str:
    """A drawing within a page: without the parts for files, its names its own, its black the page's ink."""
    svg = drawing.svg[drawing.svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\s+xmlns(:\w+)?="[^"]*"', "", svg)
    svg = _ID.sub(lambda found: f'id="{drawing.name}-{found[1]}"', svg)
    svg = _REFERENCE.sub(
        lambda found: (
            f'href="#{drawing.name}-{found[1]}"' if found[1] else f"url(#{drawing.name}-{found[2]})"
        ),
        svg,
    )
    svg = svg.replace("#000000", "currentColor").replace(
        "'DejaVu Sans'", "system-ui, 'DejaVu Sans', sans-serif"
    )
    # Black shapes have no fill of their own.
    label = f'<svg fill="currentColor" role="img" aria-label="{escape(drawing.alternative)}"'
    # The size in points would hold it back; its shape is in the viewBox.
    head, rest = svg.split(">", 1)
    head = re.sub(r'\s(width|height)="[^"]*"', "", head).replace("<svg", label, 1)
    return f"{head}>{rest}".strip()


def _rendered(template: str, report: Report) -> str:
    templates = Environment(
        loader=PackageLoader("hvt_study.report"),
        autoescape=select_autoescape(["html.j2"]),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    templates.filters |= {
        "anchor": lambda text: re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-"),
        "base64": lambda png: base64.b64encode(png).decode(),
        "cell": lambda text: " ".join(text.split()).replace("|", "\\|"),  # only our own bars part cells
        "short": lambda caption: re.split(r": |\. ", caption, maxsplit=1)[0],  # up to the first stop
        "svg": lambda drawing: Markup(inline_svg(drawing)),  # noqa: S704 - made here, its text escaped
    }
    before: Counter[str] = Counter()
    sections = [(section, numbered(section, before)) for section in report.sections]
    return templates.get_template(template).render(report=report, sections=sections, figures=FIGURES)


_OURS = re.compile(
    r"(?:(?:answer|timeline|(?:differences|equal-quality|utility|codecs)-\d+)(?:-[A-Za-z0-9.-]+)?\.(?:svg|pdf)"
    r"|crop-\d+-(?:source|base|still)\.png)"
)
"""Files that a report of ours may have written."""


def write_report(folder: Path, *, accounting: Accounting | None = None) -> None:
    """Read the table again and write ``report.md``, ``report.html`` and ``figures/`` beside it, each file whole.

    Figures of an earlier report that this one does not have are removed.

    ``accounting`` is the time that the pages divide rates by; None: that of the table. Raises `UserError` where the
    table cannot be used, or the folder not be written.
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
            write_whole(folder / FIGURES / name, content)
        write_whole(folder / "report.md", markdown_page(report).encode())
        write_whole(folder / "report.html", html_page(report).encode())
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


def _on_white(svg: str) -> str:
    """A file is looked at on whatever ground its viewer has; black lines ask for a light one."""
    head = svg.index(">", svg.index("<svg")) + 1
    return f'{svg[:head]}\n <rect width="100%" height="100%" fill="#ffffff"/>{svg[head:]}'


def _remove_others(figures: Path, names: Collection[str]) -> None:
    for path in figures.iterdir():
        if path.name not in names and _OURS.fullmatch(path.name):
            path.unlink()


def join_studies(folders: Sequence[Path], out: Path) -> None:
    """Write one table of all their runs into ``out``; of a run that several have the first counts.

    Rates are in the accounting of the first table. The flight in pictures and the selector sweep are those of the
    first folder that has one. Raises `UserError` where a table cannot be used, two runs that differ are at one place,
    or ``out`` cannot be written.
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
