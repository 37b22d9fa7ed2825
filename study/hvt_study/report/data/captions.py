"""How tables say a figure: means, bootstrap intervals and medians over sequences, names, digits, captions.

The interval is SciPy's percentile bootstrap (Efron and Tibshirani, "An Introduction to the Bootstrap", 1993, chapter
13). Sequences are drawn, each with all others over the same picture (`picture_of`): frames of one sequence are not
independent of each other, nor are seeds of one picture. Differences are drawn as pairs
(`hvt_study.report.data.pairs`): the difficulty of a sequence for both sides cancels.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from statistics import median_low
from types import MappingProxyType

import numpy as np
from scipy.stats import bootstrap

from hvt_study.metrics.bits import Accounting
from hvt_study.report.data.arms import Setting, picture_of, place
from hvt_study.report.data.document import Cell
from hvt_study.runs.spec import COLUMNS, Column

ENOUGH = 5
"""Sequences from which an interval is shown and a verdict drawn. Of two or three the percentile interval is all but
their range, and leaves out 0 in a quarter or half of all cases in which there is no effect."""
_RESAMPLES = 10_000
_BATCH = 1_000


@dataclass(frozen=True, slots=True)
class Interval:
    """A mean and where it may lie."""

    mean: float
    """NaN where no sequence has the figure."""
    low: float
    """NaN with fewer than `ENOUGH` sequences, as is ``high``."""
    high: float
    sequences: int


def interval_of(values: Mapping[str, float]) -> Interval:
    """The mean of values that are not NaN, by sequence, with its 95 % bootstrap interval.

    The interval is NaN with fewer than `ENOUGH` sequences, of which those over one picture are one.
    """
    known = {name: value for name, value in values.items() if not math.isnan(value)}
    pictures: dict[str, list[float]] = {}
    for name, value in known.items():
        pictures.setdefault(picture_of(name), []).append(value)
    return _interval(tuple(known.values()), tuple(map(tuple, pictures.values())))


def mean_of(values: Iterable[float]) -> Interval:
    """The mean alone; one infinite value makes it infinite."""
    known = [value for value in values if not math.isnan(value)]
    mean = sum(known) / len(known) if known else math.nan
    if known and math.isfinite(mean):
        mean = float(np.mean(known))
    return Interval(mean, math.nan, math.nan, len(known))


def median_of(values: Iterable[float]) -> Interval:
    """The median in the mean's place, of two middle values the lower: one infinite wait does not make it infinite."""
    known = [value for value in values if not math.isnan(value)]
    return Interval(median_low(known) if known else math.nan, math.nan, math.nan, len(known))


@lru_cache(maxsize=10_000)
def _interval(values: tuple[float, ...], pictures: tuple[tuple[float, ...], ...]) -> Interval:
    """Table, figure and summary need the same; the same values give the same interval."""
    mean = mean_of(values)
    if len(pictures) < ENOUGH or not math.isfinite(mean.mean):
        return mean
    drawn = bootstrap(
        ([sum(one) for one in pictures], [len(one) for one in pictures]),
        lambda sums, counts, axis: sums.sum(axis=axis) / counts.sum(axis=axis),
        paired=True,
        n_resamples=_RESAMPLES,
        batch=_BATCH,
        method="percentile",
        rng=0,
    )
    found = drawn.confidence_interval
    return replace(mean, low=float(found.low), high=float(found.high))


INTERVALS = f"95 % bootstrap interval over sequences, those of one picture as one (from {ENOUGH} on)"
_LABELS = {
    "annotations": "annotations (people's, or exact)",
    "reference": "reference (the detector on source frames before they are coded, in tiles, "
    "none smaller than the base)",
}
_NAMED = 4


def under(setting: Setting) -> str:
    n = setting.sequences
    parts = [f"{n} sequence{'' if n == 1 else 's'}{_datasets(setting)}"]
    parts += [f"labels: {_LABELS.get(setting.labels, setting.labels)}", str(setting.models)]
    parts += setting.conditions.unusual()
    parts += [f"{method} with {' '.join(tune)}" for method, tune in setting.tunes.items()]
    if setting.accounting == "pilot":
        parts.append("rates by the length of the whole clip, as the pilot's")
    return f"{'; '.join(parts)}."


def same_sequences(setting: Setting) -> str:
    """A sentence for tables of means of which not all are of all sequences; empty where they are."""
    if all(len(setting.runs(arm)) == setting.sequences for arm in setting.all_arms):
        return ""
    return "Means of fewer sequences (n) are not to be compared with the others. "


def time_of(accounting: Accounting | str) -> str:
    return "length of the whole clip" if accounting == "pilot" else "processed span"


def _datasets(setting: Setting) -> str:
    names = [place(one) for one in setting.datasets]
    if len(names) == 1:
        return ""
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return f" of {', '.join(names[:_NAMED])}{more}"


NOTHING = "\N{EN DASH}"
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
