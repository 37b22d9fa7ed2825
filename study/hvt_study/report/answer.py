"""The answer in one sentence a setting: how far the best method is ahead of video, and how sure that is."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from hvt_study.report.data.arms import Setting
from hvt_study.report.data.document import Drawing
from hvt_study.report.data.intervals import ENOUGH
from hvt_study.report.data.metric_names import METRICS, written
from hvt_study.report.data.pairs import Pair, pairs
from hvt_study.report.figures.pair_figures import difference_figures

DECIDES = "named_f1"
"""The figure by which methods are held against video."""
REFERENCES = ("M0", "M0-fps", "M0-best", "R0")


def answer(found: Sequence[Setting]) -> Iterator[str | Drawing]:
    """Against plain video at the same bits; of the first setting in a figure, too."""
    metric = METRICS[DECIDES]
    for setting in found:
        plain = [pair for pair in pairs(setting, references=("M0",)) if pair.gaps(DECIDES)]
        if not plain:
            continue
        best = max(plain, key=lambda pair: pair.interval(DECIDES).mean)
        ahead = " ".join(filter(None, written(best.interval(DECIDES), metric, sign=True)))
        yield (
            f"{setting.name}, labels: {setting.labels}. The method furthest ahead of video at the same bits is "
            f"{best.arm.name} in the {best.arm.regime} regime, {ahead} {metric.title} "
            f"(n = {len(best.gaps(DECIDES))}). {_tally(plain)}"
        )
    for setting in found[:1]:
        yield from forests(setting, name="answer")


def forests(setting: Setting, *, name: str) -> Iterator[Drawing]:
    """Paired differences, a figure a regime."""
    yield from difference_figures(
        setting, list(pairs(setting, references=REFERENCES)), name=name, column=DECIDES
    )


def _tally(found: Sequence[Pair]) -> str:
    """Verdicts are of intervals, and intervals of enough sequences only."""
    intervals = [pair.interval(DECIDES) for pair in found]
    sure = [one for one in intervals if not math.isnan(one.low)]
    few = len(found) - len(sure)
    if not sure:
        return (
            f"That is no verdict: {_pairs(few, 'has', 'have')} fewer than {ENOUGH} sequences, of which an interval "
            "says nothing."
        )
    ahead, behind = sum(one.low > 0 for one in sure), sum(one.high < 0 for one in sure)
    left = f"; {few} more have fewer than {ENOUGH} sequences and are not counted" if few else ""
    return (
        f"Of {_pairs(len(sure), '', '')} the interval lies above 0 in {ahead}, below in {behind}, and holds 0 in "
        f"{len(sure) - ahead - behind}{left}. No account is taken of how many were looked at."
    )


def _pairs(count: int, one: str, several: str) -> str:
    return f"{count} pair{'' if count == 1 else 's'} of method and regime {one if count == 1 else several}".rstrip()
