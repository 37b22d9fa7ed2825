"""The method matrix: one figure of every method in every regime."""

from __future__ import annotations

import math

import pandas as pd

from hvt_study.report.data.arms import Arm, Setting, values
from hvt_study.report.data.captions import INTERVALS, under
from hvt_study.report.data.document import Cell, Head, Table, words
from hvt_study.report.data.intervals import interval_of
from hvt_study.report.data.metric_names import METRICS, NOTHING, definition, written
from hvt_study.runs.methods import METHODS


def matrix_table(setting: Setting, column: str) -> Table | None:
    """A row a method and codec, a column a regime; None where no run has the figure."""
    metric = METRICS[column]
    arms = [arm for regime in setting.regimes for arm in setting.arms(regime)]
    names = list(dict.fromkeys((arm.method, arm.still_codec) for arm in arms))
    names.sort(key=lambda one: list(METHODS).index(one[0]) if one[0] in METHODS else len(METHODS))
    figures = pd.DataFrame(
        {
            (regime, *name): pd.Series(values(setting.runs(Arm(regime, *name)), column), dtype=float)
            for regime in setting.regimes
            for name in names
        }
    )
    if not figures.notna().any(axis=None):
        return None
    best = {(regime, *name) for regime in setting.regimes for name in _best(figures[regime])}
    rows: list[tuple[Cell, ...]] = []
    for method, codec in names:
        says = METHODS[method].says if method in METHODS else ""
        cells = [Cell(method), Cell(codec or NOTHING), Cell(says)]
        for place in ((regime, method, codec) for regime in setting.regimes):
            interval = interval_of(figures[place])
            mean, span = written(interval, metric)
            n = f"n = {interval.sequences}" if 0 < interval.sequences < setting.sequences else ""
            cells.append(Cell(mean, f"{span} {n}".strip(), strong=place in best))
        rows.append(tuple(cells))
    heads = words("method", "codec", "what it does")
    heads += tuple(Head(_budget(setting, name)) for name in setting.regimes)
    caption = (
        f"Method matrix, {metric.title}, {setting.name}: {definition(metric, setting.accounting)}. Each method at "
        f"the regime's whole budget, mean over sequences; beneath, the {INTERVALS}, and n where it is a mean of "
        "fewer than all. Bold: the highest mean of a regime, among the methods that have the same sequences, and of "
        f"those the most. {under(setting)}"
    )
    return Table(caption, heads, tuple(rows))


def _best(figures: pd.DataFrame) -> list[tuple[str, str]]:
    """Of one regime, a column a method: only means of the same sequences are held against each other."""
    known = figures.dropna(axis="columns", how="all")
    alike: dict[tuple[bool, ...], list[tuple[str, str]]] = {}
    for name in known:
        alike.setdefault(tuple(known[name].notna()), []).append(name)
    several = [names for names in alike.values() if len(names) > 1]
    if not several:
        return []
    means = known[max(several, key=lambda names: (known[names[0]].count(), len(names)))].mean()
    return [name for name, mean in means.items() if mean == means.max() and not math.isnan(mean)]


def _budget(setting: Setting, regime: str) -> str:
    """A regime that is named by its budget needs no second word."""
    return regime if "bps" in regime else f"{regime}, {setting.budget_bps(regime) / 1e3:g} kbps"
