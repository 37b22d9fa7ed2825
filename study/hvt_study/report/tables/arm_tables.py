"""End-to-end results in the paper's form: a row a method and regime; and the matrix of one figure of them all."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd

from hvt_study.report.data.arms import Arm, BySequence, Setting, values
from hvt_study.report.data.captions import INTERVALS, same_sequences, under
from hvt_study.report.data.document import Cell, Head, Table, breaks_between, words
from hvt_study.report.data.intervals import interval_of, mean_of, median_of
from hvt_study.report.data.metric_names import METRICS, NOTHING, definition, figure_cell
from hvt_study.runs.methods import METHODS

_SPENT = (
    *("total_bps", "base_bps", "roi_bps", "track_bps", "other_bps", "back_bps", "fps", "stills_per_min"),
    *("mean_still_bytes", "tracks_refined", "delay_p50_ms", "delay_p95_ms", "still_delay_p50_ms"),
    *("still_delay_p95_ms", "edge_cpu_ms"),
)
_SEEN = (
    *("map_50", "map_50_95", "recall", "precision", "f1", "mota", "idf1", "hota", "id_switches"),
    *("found_share", "gaps", "longest_gap_s"),
)
_NAMED = (
    *("named_f1_before", "named_f1", "false_per_frame", "top1_before", "top1", "top1_all_before"),
    *("top1_all", "macro_f1_before", "macro_f1", "macro_f1_all_before", "macro_f1_all"),
    *("first_correct_p50_s", "first_correct_p90_s", "first_correct_never"),
)
_SIZES = (
    *("map_50_small", "map_50_medium", "map_50_large", "top1_small", "top1_medium", "top1_large"),
    *("top1_all_small", "top1_all_medium", "top1_all_large"),
)
_PILOT = ("total_bps", "base_bps", "roi_bps", "total_bps_pilot", "base_bps_pilot", "roi_bps_pilot")
_OPINIONS = (
    *("confidence_base", "confidence_refined", "confidence_gain", "positive_rate", "change_rate"),
    "entropy_gain_nats",
)
_PROXIES = (
    *(*_OPINIONS, "proxy_pairs"),
    *(*(f"small_{column}" for column in _OPINIONS), "small_pairs"),
)
_BENEATH = f"means over sequences, beneath the {INTERVALS}, and n where fewer than the row's have the figure"


@dataclass(frozen=True, slots=True)
class _Kind:
    """One of the tables."""

    title: str
    says: str
    columns: Sequence[str]
    intervals: bool = False
    only_with: str = ""
    """A column without which an arm is left out."""

    def __call__(self, setting: Setting) -> Table:
        """A row an arm, a line between regimes. Columns and arms that have no figure at all are left out."""
        arms = [(arm, setting.runs(arm)) for regime in setting.regimes for arm in setting.arms(regime)]
        if self.only_with:
            arms = [(arm, runs) for arm, runs in arms if _has_any(runs, self.only_with)]
        shown = [name for name in self.columns if any(_has_any(runs, name) for _, runs in arms)]
        rows: list[tuple[Cell, ...]] = []
        for arm, runs in arms:
            n = f"{len(runs)} of {setting.sequences}" if len(runs) < setting.sequences else str(len(runs))
            cells = [Cell(arm.regime), Cell(arm.method), Cell(arm.still_codec or NOTHING), Cell(n)]
            rows.append((*cells, *(_mean_cell(runs, name, interval=self.intervals) for name in shown)))
        heads = (*words("regime", "method", "codec"), Head("n", says="sequences whose run counts"))
        metrics = [METRICS[name] for name in shown]
        heads += tuple(Head(one.title, says=definition(one, setting.accounting)) for one in metrics)
        caption = f"{self.title}, {setting.name}: {self.says}. {same_sequences(setting)}{under(setting)}"
        return Table(caption, heads, tuple(rows), breaks_between(arm.regime for arm, _ in arms))


spent_table = _Kind("End-to-end results, what was spent", "means over sequences", _SPENT)
seen_table = _Kind("End-to-end results, what was seen", _BENEATH, _SEEN, intervals=True)
named_table = _Kind(
    "End-to-end results, classes",
    f"{_BENEATH}. Before: the same run without the stills' word. Of the times to the first right class the median "
    "over sequences (of two middle ones the lower), infinite where that share of tracks was never named right",
    _NAMED,
    intervals=True,
)
size_table = _Kind(
    "By size of objects",
    f"small below 32², large from 96² source pixels; {_BENEATH}",
    _SIZES,
    intervals=True,
)
pilot_table = _Kind(
    "Both accountings",
    "bytes by the processed span, and by the length of the whole clip, as the pilot's notebooks had it. Means over "
    "sequences",
    _PILOT,
)
proxy_table = _Kind(
    "The pilot's proxies",
    "what one model says of the still and of the base at its place; they need no labels. Means over sequences",
    _PROXIES,
    only_with="confidence_gain",
)


def _has_any(runs: BySequence, column: str) -> bool:
    return any(row[column] is not None for row in runs.values())


def _mean_cell(runs: BySequence, column: str, *, interval: bool) -> Cell:
    """The mean over those sequences that have the figure; where some lack it, that is said beneath."""
    own, metric = values(runs, column), METRICS[column]
    take = median_of if metric.over == "median" else interval_of if interval else mean_of
    return figure_cell(take(own.values()), metric, of=len(own))


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
            cells.append(figure_cell(interval, metric, of=setting.sequences, strong=place in best))
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
