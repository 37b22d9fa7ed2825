"""A report as one HTML file that needs no other, and as Markdown with its figures as files beside it.

Style, drawings and pictures are in the HTML file, and nothing is loaded from the network. It takes the reader's light
or dark, and prints on A4. The templates lie beside this file.
"""

from __future__ import annotations

import base64
import re
from collections import Counter
from html import escape

from jinja2 import Environment, PackageLoader, select_autoescape
from markupsafe import Markup

from hvt_study.report.data.document import Drawing, Report, numbered

FIGURES = "figures"
"""Folder of figures, beside the Markdown page."""
_ID = re.compile(r'\bid="([^"]+)"')
_REFERENCE = re.compile(r'(?:xlink:)?href="#([^"]+)"|url\(#([^)]+)\)')


def html_page(report: Report) -> str:
    """The whole page."""
    return _rendered("report.html.j2", report)


def markdown_page(report: Report) -> str:
    """The whole page."""
    return _rendered("report.md.j2", report)


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


def _rendered(template: str, report: Report) -> str:
    templates = Environment(
        loader=PackageLoader("hvt_study.report.pages"),
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
