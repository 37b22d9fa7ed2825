"""Tables of pairs: differences at matched totals, and the bits that video needs to show as much."""

from __future__ import annotations

import math
from collections.abc import Sequence

from hvt_study.report.data.arms import Setting, values
from hvt_study.report.data.captions import INTERVALS, under
from hvt_study.report.data.document import Cell, Head, Table, breaks_between, words
from hvt_study.report.data.intervals import ENOUGH
from hvt_study.report.data.metric_names import METRICS, NOTHING, definition, figure_cell
from hvt_study.report.data.pairs import EqualQuality, Pair

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
    heads = words("regime", "method", "against")
    heads += (Head("n", says="sequences of which both runs count, of those of which the method's does"),)
    heads += (Head("kbps", says="mean total of the method and of its match"),)
    heads += tuple(
        Head(f"Δ {METRICS[name].title}", says=definition(METRICS[name], setting.accounting)) for name in shown
    )
    heads += (Head("ahead", says=f"sequences with more {METRICS[_DECIDES].title}, with less"),)
    off = max(pair.most_off_pct() for pair in found)
    caption = (
        f"Paired differences at matched totals, {setting.name}: method less video-only method on the same sequence, "
        f"mean; beneath, the {INTERVALS}, and n where fewer than the row's have the figure. Bold where the interval "
        f"leaves out 0. Ahead: sequences with more and with less {METRICS[_DECIDES].title}. The totals of no pair "
        f"are more than {off:.2f} % apart. {under(setting)}"
    )
    return Table(caption, heads, rows, breaks)


def equal_table(setting: Setting, found: Sequence[EqualQuality], *, column: str) -> Table | None:
    """How many times the bits video needs; None where no curve can be read."""
    found = [one for one in found if one.ratios or one.unread]
    if not any(one.ratios for one in found):
        return None
    rows = tuple(
        (
            Cell(one.arm.regime),
            Cell(one.arm.name),
            Cell(one.reference),
            Cell(ratio(one.median), strong=len(one.ratios) >= ENOUGH and one.median > 1),
            Cell(str(len(one.ratios) - one.above - one.below)),
            Cell(str(one.above)),
            Cell(str(one.below)),
            Cell(str(one.unread)),
        )
        for one in found
    )
    breaks = breaks_between(one.arm.regime for one in found)
    heads = words("regime", "method", "video")
    heads += (Head("bits needed", says="of video, by those of the method; median over sequences"),)
    heads += (Head("read", says="sequences in which the curve reaches the level"),)
    heads += (Head("above", says="sequences in which no video that was flown shows as much"),)
    heads += (Head("below", says="sequences in which the least video that was flown shows more"),)
    heads += (
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
    """Of bits, in words where the curve ends."""
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
    return Cell(pair.arm.regime), Cell(pair.arm.name), Cell(pair.reference), Cell(n), Cell(kbps)


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
