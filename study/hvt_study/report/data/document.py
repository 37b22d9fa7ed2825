"""The parts of a report, before it is a page: sections of paragraphs, tables, drawings and pictures."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias


@dataclass(frozen=True, slots=True)
class Head:
    """Head of a column."""

    text: str
    number: bool = True
    """Set flush right."""
    says: str = ""
    """The explanation for those who point at it."""


def words(*texts: str) -> tuple[Head, ...]:
    return tuple(Head(text, number=False) for text in texts)


@dataclass(frozen=True, slots=True)
class Cell:
    """Cell of a table."""

    text: str
    under: str = ""
    """A second, smaller line, such as an interval."""
    strong: bool = False


def cells(*contents: object) -> tuple[Cell, ...]:
    return tuple(Cell(str(one)) for one in contents)


@dataclass(frozen=True, slots=True)
class Table:
    """A table; its caption says which labels it is of and how many sequences."""

    caption: str
    heads: tuple[Head, ...]
    rows: tuple[tuple[Cell, ...], ...]
    breaks: frozenset[int] = frozenset()
    """Rows before which a line is drawn."""


def breaks_between(keys: Iterable[object]) -> frozenset[int]:
    """Rows before which the key is another one than that of the row above: a line is drawn there."""
    return frozenset(row for row, (one, other) in enumerate(pairwise(keys), start=1) if one != other)


@dataclass(frozen=True, slots=True)
class Drawing:
    """A figure in lines."""

    name: str
    caption: str
    svg: str
    pdf: bytes
    alternative: str
    """The description for those who do not see it."""


@dataclass(frozen=True, slots=True)
class Picture:
    """Pixels."""

    name: str
    png: bytes
    alternative: str


@dataclass(frozen=True, slots=True)
class PictureRow:
    """Pictures of one thing side by side."""

    label: str
    pictures: tuple[Picture, ...]


@dataclass(frozen=True, slots=True)
class Pictures:
    """Rows of pictures under common heads."""

    caption: str
    heads: tuple[str, ...]
    rows: tuple[PictureRow, ...]


Part: TypeAlias = str | Table | Drawing | Pictures


@dataclass(frozen=True, slots=True)
class Section:
    """Under one heading."""

    title: str
    parts: tuple[Part, ...]


@dataclass(frozen=True, slots=True)
class Report:
    """All of it."""

    title: str
    lead: tuple[str, ...]
    sections: tuple[Section, ...]


def numbered(section: Section, before: Counter[str]) -> list[tuple[str, Part]]:
    """The parts of a section with their names, ``Table 3``, ``Figure 1``; paragraphs have no name.

    ``before`` counts those of the sections before, and is added to.
    """
    named: list[tuple[str, Part]] = []
    for part in section.parts:
        if isinstance(part, str):
            named.append(("", part))
            continue
        kind = "Table" if isinstance(part, Table) else "Figure"
        before[kind] += 1
        named.append((f"{kind} {before[kind]}", part))
    return named
