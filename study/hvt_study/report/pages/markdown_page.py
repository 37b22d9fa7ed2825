"""A report as Markdown, with its figures as files beside it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator

from hvt_study.report.data.document import Cell, Drawing, Part, Pictures, Report, Table, numbered

__all__ = ["FIGURES", "markdown_page"]

FIGURES = "figures"
"""Folder of figures, beside the page."""


def markdown_page(report: Report) -> str:
    """The whole page."""
    blocks = [f"# {report.title}", *report.lead]
    before: Counter[str] = Counter()
    for section in report.sections:
        blocks.append(f"## {section.title}")
        for name, part in numbered(section, before):
            blocks += _blocks(name, part)
    return "\n\n".join(blocks) + "\n"


def _blocks(name: str, part: Part) -> Iterator[str]:
    if isinstance(part, str):
        yield part
        return
    yield f"**{name}.** {part.caption}"
    if isinstance(part, Table):
        yield _table(part)
    elif isinstance(part, Drawing):
        yield f"![{part.alternative}]({FIGURES}/{part.name}.svg)"
    else:
        yield _pictures(part)


def _table(table: Table) -> str:
    heads = _line(head.text for head in table.heads)
    rules = _line("---:" if head.number else "---" for head in table.heads)
    return "\n".join([heads, rules, *(_line(map(_cell, row)) for row in table.rows)])


def _pictures(pictures: Pictures) -> str:
    lines = [_line(("", *pictures.heads)), _line("---" for _ in range(len(pictures.heads) + 1))]
    for row in pictures.rows:
        shown = (f"![{one.alternative}]({FIGURES}/{one.name}.png)" for one in row.pictures)
        lines.append(_line((row.label, *shown)))
    return "\n".join(lines)


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(_plain(cell) for cell in cells)} |"


def _plain(text: str) -> str:
    """One line, in which only our own bars part cells."""
    return " ".join(text.split()).replace("|", "\\|")


def _cell(cell: Cell) -> str:
    text = f"**{cell.text}**" if cell.strong else cell.text
    return f"{text} {cell.under}".strip()
