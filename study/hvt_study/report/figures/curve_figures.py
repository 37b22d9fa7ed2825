"""Curves: utility over bitrate, and those of the still codecs."""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hvt_study.report.data.arms import Arm, BySequence, Setting, values
from hvt_study.report.data.captions import INTERVALS, METRICS, interval_of, mean_of, under
from hvt_study.report.data.document import Drawing
from hvt_study.report.figures.drawing import drawn, fill_of, log_axis, plain_axes, rate_axis, style_of

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
