"""End-to-end results in the paper's form: a row a method and regime, what was spent and what was seen."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from hvt_study.report.data.arms import BySequence, Setting, values
from hvt_study.report.data.captions import INTERVALS, same_sequences, under
from hvt_study.report.data.document import Cell, Head, Table, words
from hvt_study.report.data.intervals import interval_of, mean_of, median_of
from hvt_study.report.data.metric_names import METRICS, NOTHING, written

__all__ = ["named_table", "pilot_table", "proxy_table", "seen_table", "size_table", "spent_table"]

_SPENT = (
    *("total_bps", "base_bps", "roi_bps", "track_bps", "other_bps", "back_bps", "fps", "stills_per_min"),
    *("mean_still_bytes", "tracks_refined", "delay_p50_ms", "delay_p95_ms", "still_delay_p50_ms"),
    *("still_delay_p95_ms", "edge_cpu_ms"),
)
_SEEN = ("map_50", "map_50_95", "recall", "precision", "f1", "mota", "idf1", "hota", "id_switches")
_NAMED = (
    *("top1_before", "top1", "top1_all_before", "top1_all", "macro_f1_before", "macro_f1"),
    *("macro_f1_all_before", "macro_f1_all"),
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


def spent_table(setting: Setting) -> Table:
    """End to end, what was spent: bits, stills, delay."""
    caption = (
        f"End-to-end results, what was spent, {setting.name}: means over sequences. {same_sequences(setting)}"
        f"{under(setting)}"
    )
    return _by_arm(setting, _SPENT, caption=caption)


def seen_table(setting: Setting) -> Table:
    """End to end, what was found and kept track of for it, with intervals."""
    caption = (
        f"End-to-end results, what was seen, {setting.name}: {_BENEATH}. "
        f"{same_sequences(setting)}{under(setting)}"
    )
    return _by_arm(setting, _SEEN, caption=caption, intervals=True)


def named_table(setting: Setting) -> Table:
    """End to end, what it was called, with intervals."""
    caption = (
        f"End-to-end results, classes, {setting.name}: {_BENEATH}. Before: the same run without the stills' word. Of "
        "the times to the first right class the median over sequences (of two middle ones the lower), infinite where "
        f"that share of tracks was never named right. {same_sequences(setting)}{under(setting)}"
    )
    return _by_arm(setting, _NAMED, caption=caption, intervals=True)


def size_table(setting: Setting) -> Table:
    """Accuracy by the size of objects."""
    caption = (
        f"By size of objects, {setting.name}: small below 32², large from 96² source pixels; {_BENEATH}. "
        f"{same_sequences(setting)}{under(setting)}"
    )
    return _by_arm(setting, _SIZES, caption=caption, intervals=True)


def pilot_table(setting: Setting) -> Table:
    """Both accountings side by side."""
    caption = (
        f"Both accountings, {setting.name}: bytes by the processed span, and by the length of the whole clip, as the "
        f"pilot's notebooks had it. Means over sequences. {same_sequences(setting)}{under(setting)}"
    )
    return _by_arm(setting, _PILOT, caption=caption)


def proxy_table(setting: Setting) -> Table:
    """The pilot's proxies, of methods that send stills."""
    caption = (
        f"The pilot's proxies, {setting.name}: what one model says of the still and of the base at its place; they "
        f"ask no labels. Means over sequences. {same_sequences(setting)}{under(setting)}"
    )
    return _by_arm(setting, _PROXIES, caption=caption, only_with=("confidence_gain",))


def _by_arm(
    setting: Setting,
    columns: Sequence[str],
    *,
    caption: str,
    intervals: bool = False,
    only_with: tuple[str, ...] = (),
) -> Table:
    """A row an arm, a line between regimes. Columns and arms that have no figure at all are left out."""
    arms = [(arm, setting.runs(arm)) for regime in setting.regimes for arm in setting.arms(regime)]
    if only_with:
        arms = [(arm, runs) for arm, runs in arms if _has_any(runs, only_with)]
    shown = [name for name in columns if any(_has_any(runs, (name,)) for _, runs in arms)]
    rows: list[tuple[Cell, ...]] = []
    breaks, regime = set(), ""
    for arm, runs in arms:
        if regime not in ("", arm.regime):
            breaks.add(len(rows))
        regime = arm.regime
        n = f"{len(runs)} of {setting.sequences}" if len(runs) < setting.sequences else str(len(runs))
        cells = [Cell(arm.regime), Cell(arm.method), Cell(arm.still_codec or NOTHING), Cell(n)]
        rows.append((*cells, *(_mean_cell(runs, name, interval=intervals) for name in shown)))
    heads = words("regime", "method", "codec")
    heads += (Head("n", says="sequences whose run counts"),)
    heads += tuple(
        Head(METRICS[name].name, says=METRICS[name].definition(setting.accounting)) for name in shown
    )
    return Table(caption, heads, tuple(rows), frozenset(breaks))


def _has_any(runs: BySequence, columns: Iterable[str]) -> bool:
    return any(row[name] is not None for row in runs.values() for name in columns)


def _mean_cell(runs: BySequence, column: str, *, interval: bool) -> Cell:
    """The mean over those sequences that have the figure; where some lack it, that is said beneath."""
    own, metric = values(runs, column), METRICS[column]
    take = median_of if metric.over == "median" else interval_of if interval else mean_of
    found = take(own.values())
    mean, span = written(found, metric)
    n = f"n = {found.sequences}" if 0 < found.sequences < len(own) else ""
    return Cell(mean, f"{span} {n}".strip())
