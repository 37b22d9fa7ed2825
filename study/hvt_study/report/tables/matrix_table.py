"""The method matrix: one figure of every method in every regime."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from hvt_study.metrics.bootstrap import Interval
from hvt_study.report.data.arms import Arm, Setting, values
from hvt_study.report.data.captions import INTERVALS, under
from hvt_study.report.data.document import Cell, Head, Table, words
from hvt_study.report.data.intervals import interval_of
from hvt_study.report.data.metric_names import METRICS, NOTHING, written
from hvt_study.runs.methods import METHODS

__all__ = ["matrix_table"]


def matrix_table(setting: Setting, column: str) -> Table | None:
    """A row a method and codec, a column a regime; None where no run has the figure."""
    metric = METRICS[column]
    arms = [arm for regime in setting.regimes for arm in setting.arms(regime)]
    names = list(dict.fromkeys((arm.method, arm.still_codec) for arm in arms))
    names.sort(key=lambda one: list(METHODS).index(one[0]) if one[0] in METHODS else len(METHODS))
    figures = {
        Arm(regime, *name): _known(setting, Arm(regime, *name), column)
        for regime in setting.regimes
        for name in names
    }
    if not any(figures.values()):
        return None
    best = {arm for regime in setting.regimes for arm in _best(figures, regime)}
    rows: list[tuple[Cell, ...]] = []
    for method, codec in names:
        says = METHODS[method].says if method in METHODS else ""
        cells = [Cell(method), Cell(codec or NOTHING), Cell(says)]
        for arm in (Arm(regime, method, codec) for regime in setting.regimes):
            interval = interval_of(figures[arm].values())
            mean, span = written(interval, metric)
            cells.append(Cell(mean, _beneath(span, interval, setting), strong=arm in best))
        rows.append(tuple(cells))
    heads = words("method", "codec", "what it does")
    heads += tuple(Head(_budget(setting, name)) for name in setting.regimes)
    caption = (
        f"Method matrix, {metric.name}, {setting.name}: {metric.definition(setting.accounting)}. Each method at the "
        f"regime's whole budget, mean over sequences; beneath, the {INTERVALS}, and n where it is a mean of fewer "
        "than all. Bold: the highest mean of a regime, among the methods that have the same sequences, and of those "
        f"the most. {under(setting)}"
    )
    return Table(caption, heads, tuple(rows))


def _known(setting: Setting, arm: Arm, column: str) -> dict[str, float]:
    """By sequence."""
    own = values(setting.runs(arm), column)
    return {name: value for name, value in own.items() if not math.isnan(value)}


def _best(figures: Mapping[Arm, Mapping[str, float]], regime: str) -> Iterable[Arm]:
    """Means of other sequences are of another height: only those of the same ones are held against each other."""
    alike: dict[frozenset[str], dict[Arm, float]] = {}
    for arm, known in figures.items():
        if arm.regime == regime and known:
            alike.setdefault(frozenset(known), {})[arm] = interval_of(known.values()).mean
    several = [names for names, means in alike.items() if len(means) > 1]
    if not several:
        return []
    means = alike[max(several, key=lambda names: (len(names), len(alike[names])))]
    return [arm for arm, mean in means.items() if mean == max(means.values())]


def _beneath(span: str, interval: Interval, setting: Setting) -> str:
    n = f"n = {interval.sequences}" if 0 < interval.sequences < setting.sequences else ""
    return f"{span} {n}".strip()


def _budget(setting: Setting, regime: str) -> str:
    """A regime that is named by its budget needs no second word."""
    return regime if "bps" in regime else f"{regime}, {setting.budget_bps(regime) / 1e3:g} kbps"
