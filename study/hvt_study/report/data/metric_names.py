"""What each figure of a row is called in tables, how it is written, and what it is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

from hvt_study.report.data.captions import time_of
from hvt_study.report.data.document import Cell
from hvt_study.report.data.intervals import Interval
from hvt_study.runs.columns import COLUMNS, Column

NOTHING = "\N{EN DASH}"
"""Stands where a run has no such figure."""
_MINUS = "\N{MINUS SIGN}"

_SCALE = {"kbps": 1e-3}
_DIGITS = {"share": 3, "kbps": 1, "count": 1, "seconds": 2, "ms": 0, "bytes": 0, "rate": 1, "nats": 3}


METRICS: Mapping[str, Column] = MappingProxyType({one.name: one for one in COLUMNS if one.title})
"""By column, in the order of tables."""


def definition(metric: Column, accounting: str) -> str:
    """In a table whose rates are of this accounting."""
    return metric.description.replace("{time}", time_of(accounting))


def number(value: float, metric: Column, *, sign: bool = False) -> str:
    """A figure in the unit of its metric; `NOTHING` for NaN. ``sign`` writes a plus, too."""
    if math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞"
    text = f"{value * _SCALE.get(metric.style, 1):{'+' if sign else ''}.{_DIGITS[metric.style]}f}"
    if not any(digit in text for digit in "123456789"):  # neither -0.000 nor +0.000
        text = text.lstrip("+-")
    return text.replace("-", _MINUS)


def written(interval: Interval, metric: Column, *, sign: bool = False) -> tuple[str, str]:
    """The mean, and its interval in brackets; the latter is empty where there is none."""
    mean = number(interval.mean, metric, sign=sign)
    if math.isnan(interval.low):
        return mean, ""
    return mean, f"[{number(interval.low, metric, sign=sign)}, {number(interval.high, metric, sign=sign)}]"


def figure_cell(
    interval: Interval, metric: Column, *, of: int, sign: bool = False, strong: bool = False
) -> Cell:
    """The mean; beneath it its interval, and how many sequences have the figure where some ``of`` them lack it."""
    mean, span = written(interval, metric, sign=sign)
    n = f"n = {interval.sequences}" if 0 < interval.sequences < of else ""
    return Cell(mean, f"{span} {n}".strip(), strong=strong)
