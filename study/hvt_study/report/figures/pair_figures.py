"""Figures of pairs: differences at matched totals, and the bits that video needs to show as much; one a regime."""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, TypeVar

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hvt_study.report.data.arms import Setting
from hvt_study.report.data.captions import INTERVALS, METRICS, under
from hvt_study.report.data.document import Drawing
from hvt_study.report.data.pairs import EqualQuality, Pair
from hvt_study.report.figures.drawing import GREY, INK, drawn, log_axis, plain_axes, style_of

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
