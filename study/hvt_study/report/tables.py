"""Tables of a report: a row a method and regime, the matrix of one figure, pairs, and their notes."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from hvt_common.errors import UserError
from hvt_study.report.data.arms import Arm, BySequence, RunRow, Setting, counts, place, values
from hvt_study.report.data.captions import (
    ENOUGH,
    INTERVALS,
    METRICS,
    NOTHING,
    definition,
    figure_cell,
    interval_of,
    mean_of,
    median_of,
    same_sequences,
    under,
)
from hvt_study.report.data.document import Cell, Head, Table, breaks_between, cells, words
from hvt_study.report.data.pairs import EqualQuality, Pair
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
    title: str
    says: str
    columns: Sequence[str]
    intervals: bool = False
    only_with: str = ""
    """A column without which an arm is left out."""

    def __call__(self, setting: Setting) -> Table:
        """A row an arm, a line between regimes. Columns and arms that have no figure at all are left out."""
        arms = [(arm, setting.runs(arm)) for arm in setting.all_arms]
        if self.only_with:
            arms = [(arm, runs) for arm, runs in arms if _has_any(runs, self.only_with)]
        shown = [name for name in self.columns if any(_has_any(runs, name) for _, runs in arms)]
        rows: list[tuple[Cell, ...]] = []
        for arm, runs in arms:
            n = f"{len(runs)} of {setting.sequences}" if len(runs) < setting.sequences else str(len(runs))
            first = cells(arm.regime, arm.method, arm.still_codec or NOTHING, n)
            rows.append((*first, *(_mean_cell(runs, name, interval=self.intervals) for name in shown)))
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
    if interval and metric.over != "median":
        return figure_cell(interval_of(own), metric, of=len(own))
    take = median_of if metric.over == "median" else mean_of
    return figure_cell(take(own.values()), metric, of=len(own))


def matrix_table(setting: Setting, column: str) -> Table | None:
    """A row a method and codec, a column a regime; None where no run has the figure."""
    metric = METRICS[column]
    names = sorted(
        setting.lines, key=lambda one: list(METHODS).index(one[0]) if one[0] in METHODS else len(METHODS)
    )
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
        found = list(cells(method, codec or NOTHING, says))
        for one in ((regime, method, codec) for regime in setting.regimes):
            interval = interval_of(figures[one].to_dict())
            found.append(figure_cell(interval, metric, of=setting.sequences, strong=one in best))
        rows.append(tuple(found))
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
    """The best of one regime, a column a method: only means of the same sequences are compared."""
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


_COMPARED = (
    *("named_f1", "false_per_frame", "map_50", "map_50_95", "f1", "top1", "top1_all", "macro_f1"),
    *("macro_f1_all", "mota", "idf1", "hota"),
)
_DECIDES = "named_f1"


def differences_table(setting: Setting, found: Sequence[Pair]) -> Table | None:
    """Each hybrid less each video-only method at its total; None where nothing was matched."""
    if not found:
        return None
    shown = [name for name in _COMPARED if any(pair.gaps(name) for pair in found)]
    rows = tuple((*_who(pair), *(_gap(pair, name) for name in shown), Cell(_ahead(pair))) for pair in found)
    breaks = breaks_between((pair.arm.regime, pair.arm.name) for pair in found)
    metrics = [METRICS[name] for name in shown]
    heads = (
        *words("regime", "method", "against"),
        Head("n", says="sequences of which both runs count, of those of which the method's does"),
        Head("kbps", says="mean total of the method and of its match"),
        *(Head(f"Δ {one.title}", says=definition(one, setting.accounting)) for one in metrics),
        Head("ahead", says=f"sequences with more {METRICS[_DECIDES].title}, with less"),
    )
    off = max((pair.most_off_pct() for pair in found if pair.names), default=None)
    apart = "No pair counts" if off is None else f"The totals of no pair are more than {off:.2f} % apart"
    caption = (
        f"Paired differences at matched totals, {setting.name}: method less video-only method on the same sequence, "
        f"mean; beneath, the {INTERVALS}, and n where fewer than the row's have the figure. Bold where the interval "
        f"leaves out 0. Ahead: sequences with more and with less {METRICS[_DECIDES].title}. {apart}. "
        f"{under(setting)}"
    )
    return Table(caption, heads, rows, breaks)


def equal_table(setting: Setting, found: Sequence[EqualQuality], *, column: str) -> Table | None:
    """How many times the bits video needs; None where no curve can be read."""
    found = [one for one in found if one.ratios or one.unread]
    if not any(one.ratios for one in found):
        return None
    rows = tuple(
        (
            *cells(one.arm.regime, one.arm.name, one.reference),
            Cell(ratio(one.median), strong=len(one.ratios) >= ENOUGH and one.median > 1),
            *cells(len(one.ratios) - one.above - one.below, one.above, one.below, one.unread),
        )
        for one in found
    )
    breaks = breaks_between(one.arm.regime for one in found)
    heads = (
        *words("regime", "method", "video"),
        Head("bits needed", says="of video, by those of the method; median over sequences"),
        Head("read", says="sequences in which the curve reaches the level"),
        Head("above", says="sequences in which no video that was flown shows as much"),
        Head("below", says="sequences in which the least video that was flown shows more"),
        Head("unreadable", says="sequences with fewer than two totals of video, or without the figure"),
    )
    caption = (
        f"Bits at equal accuracy ({METRICS[column].title}), {setting.name}: what video alone needs to show as much, "
        "by the bits of the method; median over sequences, the lower of two middle ones, bold where it is more than "
        f"1 and of {ENOUGH} sequences or more. Read off each sequence's own curve of video, straight over the "
        "logarithm of the bitrate, never beyond its ends: above and below count sequences where it ends too soon. "
        f"{under(setting)}"
    )
    return Table(caption, heads, rows, breaks)


def ratio(value: float) -> str:
    """A ratio of bits, in words where the curve ends."""
    if math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "more than flown"
    return "less than flown" if value == 0 else f"{value:.2f} x"


def _who(pair: Pair) -> tuple[Cell, ...]:
    names = pair.names
    ours, theirs = values(pair.runs, "total_bps"), values(pair.matched, "total_bps")
    kbps = f"{_mean_kbps(ours, names)} / {_mean_kbps(theirs, names)}" if names else NOTHING
    n = f"{len(names)} of {len(pair.runs)}" if len(names) < len(pair.runs) else str(len(names))
    return cells(pair.arm.regime, pair.arm.name, pair.reference, n, kbps)


def _mean_kbps(totals: dict[str, float], names: Sequence[str]) -> str:
    return f"{sum(totals[name] for name in names) / len(names) / 1e3:.1f}"


def _gap(pair: Pair, column: str) -> Cell:
    interval = pair.interval(column)
    sure = interval.low > 0 or interval.high < 0
    return figure_cell(interval, METRICS[column], of=len(pair.names), sign=True, strong=sure)


def _ahead(pair: Pair) -> str:
    gaps = pair.gaps(_DECIDES).values()
    if not gaps:
        return NOTHING
    return f"{sum(gap > 0 for gap in gaps)} : {sum(gap < 0 for gap in gaps)}"


def metrics_table(accounting: str) -> Table:
    """The meaning of each figure, where rates are of this accounting."""
    better = {"more": "higher", "less": "lower", "": NOTHING}
    rows = tuple(
        cells(one.group, one.title, one.name, definition(one, accounting), better[one.better])
        for one in METRICS.values()
    )
    titles = ("about", "metric", "column", "definition", "better")
    caption = "Metrics. A figure that a run cannot have is null in the table and a dash here, never 0."
    return Table(caption, words(*titles), rows, breaks_between(one.group for one in METRICS.values()))


def failed_table(rows: Iterable[RunRow]) -> Table | None:
    """Every run that counts nowhere, by name, with the reason; None where all count."""
    failed = [row for row in rows if not counts(row)]
    if not failed:
        return None
    said = tuple(
        cells(
            *(place(row["dataset"]), row["sequence"], row["regime"]),
            f"{row['method']} {row['still_codec']}".strip(),
            f"{row['matched_to']} {row['matched_codec']}".strip() or NOTHING,
            row["failed"] or "missed the total that it was to match by more than 1 %",
        )
        for row in failed
    )
    titles = ("dataset", "sequence", "regime", "method", "at the total of", "why")
    other = any(row["accounting"] == "pilot" for row in failed)
    rates = " Rates in the reasons are over the processed span, not the whole clip." if other else ""
    caption = f"Runs that failed or missed their match ({len(failed)}): they are in no average.{rates}"
    return Table(caption, words(*titles), said)


_TYPES = {"policy": str, "selected": int, "ratio": float, "frame_coverage": float}


def sweep_table(path: Path) -> Table | None:
    """The selector sweep that ``hvt-study sweep --out`` left here; None where there is none.

    Raises `UserError` where the file is not of that command.
    """
    if not path.exists():
        return None
    try:
        found = pd.read_csv(path, dtype=_TYPES, usecols=list(_TYPES))
        if found.empty or found.isna().any(axis=None):
            raise ValueError("no rows, or cells without a value")  # noqa: TRY301
    except (OSError, ValueError):
        raise UserError(
            f"{path} is not a table of {','.join(_TYPES)}: write it with hvt-study sweep --out {path.parent}"
        ) from None
    heads = (
        Head("selector", number=False),
        Head("selected"),
        Head("ratio", says="of the raw detections"),
        Head("frame coverage", says="share of frames with raw detections that keep at least one ROI"),
    )
    rows = tuple(
        cells(row.policy, row.selected, f"{row.ratio:.4f}", f"{row.frame_coverage:.4f}")
        for row in found.itertuples()
    )
    caption = "Selector sweep: what each of the pilot's selectors keeps of raw detections in all. No labels."
    return Table(caption, heads, rows)
