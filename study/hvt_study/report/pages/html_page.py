"""A report as one HTML file that needs no other.

Style, drawings and pictures are in it, and nothing is asked of the network. It follows the reader's light or dark,
and prints on A4.
"""

from __future__ import annotations

import base64
import re
from collections import Counter
from collections.abc import Iterator
from html import escape

from hvt_study.report.data.document import (
    Cell,
    Drawing,
    Head,
    Part,
    Pictures,
    Report,
    Section,
    Table,
    numbered,
)

__all__ = ["html_page", "inline_svg"]

_STYLE = """
:root { color-scheme: light dark; --ink: #1c1e21; --soft: #5d646d; --rule: #d5d9de; --faint: #eceef1;
  --paper: #ffffff; --link: #0072b2; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e4e6e9; --soft: #9aa3ad; --rule: #3c424a; --faint: #272b31; --paper: #16181c; --link: #56b4e9; } }
* { box-sizing: border-box; }
html { scroll-behavior: smooth; }
body { margin: 0 auto; max-width: 78rem; padding: 2.5rem 1.5rem 5rem; background: var(--paper); color: var(--ink);
  font: 1rem/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .75rem; letter-spacing: -.01em; }
h2 { font-size: 1.3rem; margin: 3rem 0 .75rem; padding-top: .75rem; border-top: 2px solid var(--ink); }
p { max-width: 46rem; margin: .6rem 0; }
a { color: var(--link); }
nav { margin: 1.5rem 0 0; padding: .9rem 1.25rem; background: var(--faint); border-radius: .4rem; }
nav ol { margin: 0; padding-left: 1.4rem; columns: 20rem; }
nav ul { margin: 0 0 .3rem; padding-left: 1rem; list-style: none; font-size: .8rem; }
nav li { break-inside: avoid; }
nav ul a { color: var(--soft); text-decoration: none; }
nav ul a:hover { text-decoration: underline; }
figure { margin: 1.6rem 0 2.2rem; }
figcaption { max-width: 60rem; margin: 0 0 .6rem; font-size: .84rem; line-height: 1.4; color: var(--soft); }
figcaption b { color: var(--ink); }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .8rem; line-height: 1.25; font-variant-numeric: tabular-nums;
  border-top: 1.5px solid var(--ink); border-bottom: 1.5px solid var(--ink); }
th { font-weight: 600; text-align: left; vertical-align: bottom; padding: .4rem .6rem; max-width: 7.5rem;
  border-bottom: 1px solid var(--ink); }
td { padding: .3rem .6rem; vertical-align: top; border-top: 1px solid var(--faint); }
td.number, th.number { text-align: right; }
td.number { white-space: nowrap; }
tr.break td { border-top: 1px solid var(--soft); }
tbody tr:hover td { background: var(--faint); }
small { display: block; font-size: .68rem; color: var(--soft); }
svg { display: block; width: 100%; height: auto; max-width: 62rem; }
td img { display: block; height: 9rem; width: auto; max-width: 20rem; object-fit: contain; image-rendering: pixelated;
  background: var(--faint); }
td.label { max-width: 16rem; }
@media print {
  @page { size: A4 landscape; margin: 12mm; }
  :root { color-scheme: light; --ink: #000; --soft: #444; --rule: #bbb; --faint: #eee; --paper: #fff; }
  body { max-width: none; padding: 0; font-size: 9pt; }
  .wide { overflow: visible; }
  table { font-size: 6.6pt; }
  th, td { padding: 2pt 3pt; }
  th { max-width: 5rem; }
  small { font-size: 5.6pt; }
  thead { display: table-header-group; }
  tr, figcaption { break-inside: avoid; }
  figcaption { break-after: avoid; }
  h2 { break-after: avoid; }
  svg { max-width: 24cm; max-height: 15.5cm; }
  figure.drawing { break-inside: avoid; }
  nav ul { display: none; }
}
"""
_ID = re.compile(r'\bid="([^"]+)"')
_REFERENCE = re.compile(r'(?:xlink:)?href="#([^"]+)"|url\(#([^)]+)\)')


def html_page(report: Report) -> str:
    """The whole page."""
    before: Counter[str] = Counter()
    sections = [(section, numbered(section, before)) for section in report.sections]
    return "\n".join(
        (
            "<!DOCTYPE html>",
            '<html lang="en">',
            '<head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(report.title)}</title>",
            f"<style>{_STYLE}</style></head>",
            "<body>",
            f"<h1>{escape(report.title)}</h1>",
            *(f"<p>{escape(text)}</p>" for text in report.lead),
            *_contents(sections),
            *(line for section, parts in sections for line in _section(section, parts)),
            "</body></html>\n",
        )
    )


def inline_svg(drawing: Drawing) -> str:
    """A drawing within a page: without what only files need, its names its own, its black the page's ink."""
    svg = drawing.svg[drawing.svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\s+xmlns(:\w+)?="[^"]*"', "", svg)
    svg = _ID.sub(lambda found: f'id="{drawing.name}-{found[1]}"', svg)
    svg = _REFERENCE.sub(lambda found: _renamed(drawing.name, found), svg)
    svg = svg.replace("#000000", "currentColor").replace(
        "'DejaVu Sans'", "system-ui, 'DejaVu Sans', sans-serif"
    )
    # What is black says nothing of its fill.
    label = f'<svg fill="currentColor" role="img" aria-label="{escape(drawing.alternative)}"'
    # The size in points would hold it back; its shape is in the viewBox.
    head, rest = svg.split(">", 1)
    head = re.sub(r'\s(width|height)="[^"]*"', "", head).replace("<svg", label, 1)
    return f"{head}>{rest}".strip()


def _renamed(name: str, found: re.Match[str]) -> str:
    return f'href="#{name}-{found[1]}"' if found[1] else f"url(#{name}-{found[2]})"


def _contents(sections: list[tuple[Section, list[tuple[str, Part]]]]) -> Iterator[str]:
    yield "<nav><ol>"
    for section, parts in sections:
        yield f'<li><a href="#{_anchor(section.title)}">{escape(section.title)}</a>'
        named = [(name, part) for name, part in parts if not isinstance(part, str)]
        if named:
            yield "<ul>"
            for name, part in named:
                yield f'<li><a href="#{_anchor(name)}">{name}: {escape(_short(part.caption))}</a></li>'
            yield "</ul>"
        yield "</li>"
    yield "</ol></nav>"


def _section(section: Section, parts: list[tuple[str, Part]]) -> Iterator[str]:
    yield f'<section id="{_anchor(section.title)}"><h2>{escape(section.title)}</h2>'
    for name, part in parts:
        yield from _part(name, part)
    yield "</section>"


def _part(name: str, part: Part) -> Iterator[str]:
    if isinstance(part, str):
        yield f"<p>{escape(part)}</p>"
        return
    kind = "drawing" if isinstance(part, Drawing) else "table"
    yield f'<figure id="{_anchor(name)}" class="{kind}">'
    yield f"<figcaption><b>{name}.</b> {escape(part.caption)}</figcaption>"
    if isinstance(part, Table):
        yield from _table(part)
    elif isinstance(part, Drawing):
        yield inline_svg(part)
    else:
        yield from _pictures(part)
    yield "</figure>"


def _table(table: Table) -> Iterator[str]:
    yield '<div class="wide"><table><thead><tr>'
    yield "".join(map(_head, table.heads))
    yield "</tr></thead><tbody>"
    for index, row in enumerate(table.rows):
        cells = "".join(_cell(cell, head) for cell, head in zip(row, table.heads, strict=True))
        begin = '<tr class="break">' if index in table.breaks else "<tr>"
        yield f"{begin}{cells}</tr>"
    yield "</tbody></table></div>"


def _pictures(pictures: Pictures) -> Iterator[str]:
    yield '<div class="wide"><table><thead><tr><th></th>'
    yield "".join(f"<th>{escape(head)}</th>" for head in pictures.heads)
    yield "</tr></thead><tbody>"
    for row in pictures.rows:
        shown = "".join(
            f'<td><img alt="{escape(one.alternative)}" src="data:image/png;base64,{_base64(one.png)}"></td>'
            for one in row.pictures
        )
        yield f'<tr><td class="label">{escape(row.label)}</td>{shown}</tr>'
    yield "</tbody></table></div>"


def _head(head: Head) -> str:
    says = f' title="{escape(head.says)}"' if head.says else ""
    return f"<th{_kind(head)}{says}>{escape(head.text)}</th>"


def _cell(cell: Cell, head: Head) -> str:
    text = f"<b>{escape(cell.text)}</b>" if cell.strong else escape(cell.text)
    under = f"<small>{escape(cell.under)}</small>" if cell.under else ""
    return f"<td{_kind(head)}>{text}{under}</td>"


def _kind(head: Head) -> str:
    return ' class="number"' if head.number else ""


def _anchor(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


def _short(caption: str) -> str:
    """Up to the first stop, for the contents."""
    return re.split(r": |\. ", caption, maxsplit=1)[0]


def _base64(png: bytes) -> str:
    return base64.b64encode(png).decode()
