"""Paired differences: each hybrid against video at the total that it really spent, sequence by sequence."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hvt_study.report.data.arms import Arm, BySequence, Setting, values
from hvt_study.report.data.intervals import Interval, interval_of


@dataclass(frozen=True, slots=True)
class Pair:
    """An arm and a video-only method at its totals."""

    arm: Arm
    reference: str
    runs: BySequence
    """Of the arm, that count."""
    matched: BySequence
    """Of the reference, that count."""

    @property
    def names(self) -> list[str]:
        """Sequences of which both sides count."""
        return sorted(self.runs.keys() & self.matched.keys())

    def gaps(self, column: str) -> dict[str, float]:
        """Arm - reference, by sequence; only where both have the figure."""
        ours, theirs = values(self.runs, column), values(self.matched, column)
        gaps = {name: ours[name] - theirs[name] for name in self.names}
        return {name: gap for name, gap in gaps.items() if not np.isnan(gap)}

    def interval(self, column: str) -> Interval:
        """Of the mean gap over the sequences of both; none of few sequences."""
        return interval_of(self.gaps(column).values())

    def most_off_pct(self) -> float:
        """The largest distance of two totals, in per cent of the arm's; 0 without pairs."""
        ours, theirs = values(self.runs, "total_bps"), values(self.matched, "total_bps")
        return max((100 * abs(theirs[name] / ours[name] - 1) for name in self.names), default=0.0)


def pairs(setting: Setting, *, references: tuple[str, ...] | None = None) -> Iterator[Pair]:
    """All of a setting, by regime and arm; only against these references where they are given."""
    wanted = [name for name in setting.references() if references is None or name in references]
    for regime in setting.regimes:
        for arm in setting.hybrids(regime):
            runs = setting.runs(arm)
            for reference in wanted:
                yield Pair(arm, reference, runs, setting.matched(arm, reference))
