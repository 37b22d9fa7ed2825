"""Curves: utility over bitrate, and those of the still codecs; and figures of pairs, one a regime.

Pairs: differences at matched totals, and the bits that video needs to show as much.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hvt_study.report.data.arms import Arm, BySequence, Setting, values
from hvt_study.report.data.captions import INTERVALS, METRICS, interval_of, mean_of, under
from hvt_study.report.data.document import Drawing
from hvt_study.report.data.pairs import EqualQuality, Pair
from hvt_study.report.figures.drawing import (
    GREY,
    INK,
    drawn,
    fill_of,
    log_axis,
    plain_axes,
    rate_axis,
    style_of,
)

_UTILITY = ("named_f1", "top1_all", "map_50")
_CODEC = ("named_f1", "confidence_gain", "stills_per_min")
_LEGEND_COLUMNS = 6
_TOTAL = {"pilot": "total by the whole clip, kbps"}


def utility_figure(setting: Setting, *, name: str) -> Drawing | None:
    """Mean figures over the bits really spent, a line a method; None where no run counts."""
    shown = [column for column in _UTILITY if _any_value(setting, column)]
    if not shown:
        return None
    lines = [line for line in setting.lines if _line(setting, line, shown)[0]]
    codecs = _codecs(setting)

    def paint(figure: Figure) -> None:
        panels = figure.subplots(1, len(shown), squeeze=False, sharex=True)[0]
        for axes, column in zip(panels, shown, strict=True):
            for line in lines:
                _draw_utility(axes, setting, line, column, shown=shown, codecs=codecs)
            axes.set_ylabel(METRICS[column].title)
            axes.set_xlabel(_TOTAL.get(setting.accounting, "total, kbps"))
            rate_axis(axes, [_budget_kbps(setting, regime) for regime in setting.regimes])
            plain_axes(axes)
        handles, names = panels[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=_LEGEND_COLUMNS, frameon=False)

    return drawn(
        name,
        paint,
        height_in=2.75 + 0.17 * math.ceil(len(lines) / _LEGEND_COLUMNS),
        caption=(
            f"Utility over bitrate, {setting.name}: each method at the whole budget of each regime, over the mean "
            "total really spent; marks are the budgets. A line is the mean of those sequences that count in all its "
            "regimes and have the figures, of all of the setting unless the legend says n; without any such sequence "
            "marks are not joined, and each is of its own. Lines of other sequences are not to be compared. How sure "
            f"the differences are, the figure of pairs says. {under(setting)}"
        ),
        alternative=f"{', '.join(METRICS[column].title for column in shown)} over total bitrate, a line a method",
    )


def codec_figure(setting: Setting, *, name: str) -> Drawing | None:
    """Figures over the size of stills, a row of panels a regime; None with fewer than two codecs."""
    codecs = _codecs(setting)
    if len(codecs) < 2:
        return None
    regimes = [
        regime for regime in setting.regimes if any(_sizes(setting, arm) for arm in setting.arms(regime))
    ]
    if not regimes:
        return None

    def paint(figure: Figure) -> None:
        grid = figure.subplots(len(regimes), len(_CODEC), squeeze=False, sharex=True)
        for panels, regime in zip(grid, regimes, strict=True):
            for axes, column in zip(panels, _CODEC, strict=True):
                for method in dict.fromkeys(arm.method for arm in setting.arms(regime)):
                    _draw_codecs(axes, setting, regime, method, column, codecs=codecs)
                axes.set_title(f"{METRICS[column].title}, {regime}")
                plain_axes(axes)
        grid[0][0].set_xscale("log")
        log_axis(grid[0][0], [step * 10**power for power in range(1, 7) for step in (1, 2, 5)])
        for axes in grid[-1]:
            axes.set_xlabel("bytes/still")
        named = {
            label: one
            for axes in grid.flat
            for one, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        figure.legend(
            named.values(), named.keys(), loc="outside lower center", ncols=_LEGEND_COLUMNS, frameon=False
        )

    return drawn(
        name,
        paint,
        height_in=0.7 + 1.7 * len(regimes),
        caption=(
            f"Codec curves, {setting.name}: what each method shows with each still codec, over the mean size that "
            f"its stills have with it; mean and {INTERVALS}. Gain is of confidence, by the still. Each codec sends "
            f"as many as the budget carries. {under(setting)}"
        ),
        alternative="Figures of each method with each still codec over the size of stills",
    )


_Points = list[tuple[Arm, BySequence]]


def _line(setting: Setting, line: tuple[str, str], shown: list[str]) -> tuple[_Points, int]:
    """Runs of a line's regimes, and of how many sequences each mean is: 0 where no sequence is in all of them."""
    arms = [Arm(regime, *line) for regime in setting.regimes]
    known = [(arm, runs) for arm in arms if (runs := setting.runs(arm))]
    needed = [
        name for name in shown if any(row[name] is not None for _, runs in known for row in runs.values())
    ]
    whole = [
        (arm, {name: row for name, row in runs.items() if all(row[column] is not None for column in needed)})
        for arm, runs in known
    ]
    points: _Points = [(arm, runs) for arm, runs in whole if runs and needed]
    common = set.intersection(*(set(runs) for _, runs in points)) if points else set()
    if not common:
        return points, 0
    return [(arm, {name: runs[name] for name in sorted(common)}) for arm, runs in points], len(common)


def _draw_utility(
    axes: Axes,
    setting: Setting,
    line: tuple[str, str],
    column: str,
    *,
    shown: list[str],
    codecs: tuple[str, ...],
) -> None:
    points, count = _line(setting, line, shown)
    style, arm = style_of(line[0]), Arm("", *line)
    means = [mean_of(values(runs, column).values()).mean for _, runs in points]
    n = "" if count == setting.sequences else f" (n = {count})" if count else " (n differs)"
    axes.plot(
        [float(np.mean([row["total_bps"] for row in runs.values()])) / 1e3 for _, runs in points],
        means,
        linestyle=style.dashes if count else "none",
        fillstyle=fill_of(arm, codecs),
        label=f"{arm.name}{n}",
        **style.marks(1.1),
    )


def _draw_codecs(
    axes: Axes, setting: Setting, regime: str, method: str, column: str, *, codecs: tuple[str, ...]
) -> None:
    """A mark a codec, joined in the order of sizes."""
    style = style_of(method)
    places: list[tuple[float, float]] = []
    for codec in codecs:
        arm = Arm(regime, method, codec)
        sizes, interval = _sizes(setting, arm), interval_of(values(setting.runs(arm), column))
        if not sizes or math.isnan(interval.mean):
            continue
        places.append((float(np.mean(sizes)), interval.mean))
        if not math.isnan(interval.low):
            axes.vlines(places[-1][0], interval.low, interval.high, color=style.colour, linewidth=0.8)
        fill = fill_of(arm, codecs)
        axes.plot(*places[-1], fillstyle=fill, linestyle="none", label=arm.name, **style.marks(1.1))
    if places:
        line: Any = {"color": style.colour, "linestyle": style.dashes, "linewidth": 0.8}
        axes.plot(*zip(*sorted(places), strict=True), zorder=1, **line)


def _sizes(setting: Setting, arm: Arm) -> list[float]:
    found = values(setting.runs(arm), "mean_still_bytes").values()
    return [value for value in found if value > 0]


def _budget_kbps(setting: Setting, regime: str) -> float:
    """In the setting's accounting, as the totals are."""
    factor = 1.0
    if setting.accounting == "pilot":
        rows = [
            row for row in setting.rows if row["regime"] == regime and row["duration_s"] and row["clip_s"]
        ]
        factor = float(np.mean([row["duration_s"] / row["clip_s"] for row in rows])) if rows else 1.0
    return setting.budget_bps(regime) * factor / 1e3


def _codecs(setting: Setting) -> tuple[str, ...]:
    return tuple(dict.fromkeys(row["still_codec"] for row in setting.rows if row["still_codec"]))


def _any_value(setting: Setting, column: str) -> bool:
    return any(
        not math.isnan(value)
        for arm in setting.all_arms
        for value in values(setting.runs(arm), column).values()
    )


_One = TypeVar("_One", Pair, EqualQuality)
_ROW_IN = 0.19
_DOT = 9.0
_LEFT, _RIGHT = r"$\leftarrow$", r"$\rightarrow$"
_THIN: Mapping[str, Any] = MappingProxyType({"markeredgewidth": 0.2, "linestyle": "none", "zorder": 4})
_RATIO_MARKS = (1.0, 2.0, 0.5, 5.0, 0.2, 10.0, 0.1, 20.0, 0.8, 1.25, 1.6, 3.0)


def difference_figures(
    setting: Setting, found: Sequence[Pair], *, name: str, column: str
) -> Iterator[Drawing]:
    """Forest plots: mean gap, its interval, and every sequence's gap behind it."""
    found = [pair for pair in found if pair.gaps(column)]
    regimes = list(dict.fromkeys(pair.arm.regime for pair in found))
    for regime in regimes:
        own = [pair for pair in found if pair.arm.regime == regime]
        yield _differences(setting, own, name=_of_regime(name, regime, regimes), column=column)


def equal_figures(
    setting: Setting, found: Sequence[EqualQuality], *, name: str, column: str
) -> Iterator[Drawing]:
    """How many times the bits video needs, each sequence and the median; arrows where a curve ends too soon."""
    found = [one for one in found if one.ratios]
    regimes = list(dict.fromkeys(one.arm.regime for one in found))
    for regime in regimes:
        own = [one for one in found if one.arm.regime == regime]
        if any(0 < ratio < math.inf for one in own for ratio in one.ratios):
            yield _ratios(setting, own, name=_of_regime(name, regime, regimes), column=column)


def _of_regime(name: str, regime: str, regimes: Sequence[str]) -> str:
    return name if len(regimes) == 1 else f"{name}-{re.sub('[^A-Za-z0-9.]+', '-', regime)}"


def _differences(setting: Setting, found: Sequence[Pair], *, name: str, column: str) -> Drawing:
    title = METRICS[column].title
    return _forest(
        setting,
        found,
        name=name,
        draw=lambda axes, pair, row: _draw_gap(axes, pair, column, row=row),
        finish=lambda axes, reference: axes.set_title(f"against {reference}"),
        even=0,
        label=f"difference in {title} at the same bits",
        caption=(
            f"Paired differences in {title} at matched totals, {setting.name}, {found[0].arm.regime}: "
            f"mean and {INTERVALS}; small dots are sequences. To the right of the line the method shows more than "
            "video at the same bits."
        ),
        alternative=f"Forest plot of the difference in {title} of each method to video",
    )


def _ratios(setting: Setting, found: Sequence[EqualQuality], *, name: str, column: str) -> Drawing:
    read = [ratio for one in found for ratio in one.ratios if 0 < ratio < math.inf]
    low, high = min(0.8, *read) / 1.15, max(1.25, *read) * 1.15

    def finish(axes: Axes, reference: str) -> None:
        axes.set_xlim(low / 1.08, high * 1.08)
        log_axis(axes, _RATIO_MARKS)
        axes.set_title(f"bits of {reference}")

    title = METRICS[column].title
    return _forest(
        setting,
        found,
        name=name,
        draw=lambda axes, one, row: _draw_ratios(axes, one, row=row, ends=(low, high)),
        finish=finish,
        even=1,
        label=f"bits that video needs / bits of the method, at equal {title}",
        caption=(
            f"Bits at equal accuracy ({title}), {setting.name}, {found[0].arm.regime}: small dots are "
            "sequences, the large mark is their median. An arrow to the right: no video that was flown shows as "
            "much; to the left: the least video that was flown shows more; what lies beyond cannot be read."
        ),
        alternative="Ratio of the bits that video alone needs to those of each method",
    )


def _forest(
    setting: Setting,
    found: Sequence[_One],
    *,
    name: str,
    draw: Callable[[Axes, _One, int], None],
    finish: Callable[[Axes, str], object],
    even: float,
    label: str,
    caption: str,
    alternative: str,
) -> Drawing:
    """A panel a video-only method, a row an arm from the top, and a line where both sides are ``even``."""
    arms = list(dict.fromkeys(one.arm for one in found))
    references = list(dict.fromkeys(one.reference for one in found))

    def paint(figure: Figure) -> None:
        panels = figure.subplots(1, len(references), squeeze=False, sharex=True, sharey=True)[0]
        for axes, reference in zip(panels, references, strict=True):
            for one in (one for one in found if one.reference == reference):
                draw(axes, one, arms.index(one.arm))
            axes.axvline(even, color=INK, linewidth=0.7)
            finish(axes, reference)
            axes.set_yticks(range(len(arms)), [arm.name for arm in arms])
            axes.set_ylim(len(arms) - 0.4, -0.6)
            plain_axes(axes, grid="x")
        figure.supxlabel(label, fontsize=8)

    height_in = 0.9 + _ROW_IN * len(arms)
    caption = f"{caption} {under(setting)}"
    return drawn(name, paint, height_in=height_in, caption=caption, alternative=alternative)


def _draw_gap(axes: Axes, pair: Pair, column: str, *, row: int) -> None:
    style, interval = style_of(pair.arm.method), pair.interval(column)
    gaps = list(pair.gaps(column).values())
    axes.scatter(gaps, [row] * len(gaps), s=_DOT, color=GREY, alpha=0.55, linewidths=0, zorder=2)
    if not math.isnan(interval.low):
        axes.errorbar(
            interval.mean,
            row,
            xerr=[[interval.mean - interval.low], [interval.high - interval.mean]],
            color=style.colour,
            elinewidth=1.2,
            capsize=2.5,
            capthick=1.2,
            zorder=3,
        )
    axes.plot([interval.mean], [row], zorder=4, **style.marks())


def _draw_ratios(axes: Axes, one: EqualQuality, *, row: int, ends: tuple[float, float]) -> None:
    low, high = ends
    read = [ratio for ratio in one.ratios if 0 < ratio < math.inf]
    axes.scatter(read, [row] * len(read), s=_DOT, color=GREY, alpha=0.6, linewidths=0, zorder=2)
    style, middle = style_of(one.arm.method), one.median
    for place, marker, count in ((low, _LEFT, one.below), (high, _RIGHT, one.above)):
        if count:
            axes.plot([place], [row], color=GREY, marker=marker, markersize=7, **_THIN)
    if 0 < middle < math.inf:
        axes.plot([middle], [row], zorder=4, **style.marks())
    else:
        place, marker = (low, _LEFT) if middle == 0 else (high, _RIGHT)
        axes.plot([place], [row], color=style.colour, marker=marker, markersize=11, **_THIN)
