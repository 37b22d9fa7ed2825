"""Hybrids against video: differences at the total that each really spent, and bits at equal accuracy.

Differences are taken sequence by sequence. Bits at equal accuracy are those that video alone needs to show as much:
each sequence has a curve of its own, all counted runs of video over it, whatever their regime. Between two runs the
curve is straight over the logarithm of the bitrate; where it goes down with more bits, the least bits count at which
video has shown as much.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from statistics import median_low

import numpy as np

from hvt_study.report.data.arms import Arm, BySequence, Setting, values
from hvt_study.report.data.captions import Interval, interval_of


@dataclass(frozen=True, slots=True)
class Pair:
    """An arm and a video-only method at its totals."""

    arm: Arm
    reference: str
    runs: BySequence
    matched: BySequence

    @property
    def names(self) -> list[str]:
        return sorted(self.runs.keys() & self.matched.keys())

    def gaps(self, column: str) -> dict[str, float]:
        """Arm - reference, by sequence; only where both have the figure."""
        ours, theirs = values(self.runs, column), values(self.matched, column)
        gaps = {name: ours[name] - theirs[name] for name in self.names}
        return {name: gap for name, gap in gaps.items() if not np.isnan(gap)}

    def interval(self, column: str) -> Interval:
        """Interval of the mean gap over the sequences of both; none for few sequences."""
        return interval_of(self.gaps(column))

    def most_off_pct(self) -> float:
        """The largest distance of two totals, in per cent of the arm's."""
        ours, theirs = values(self.runs, "total_bps"), values(self.matched, "total_bps")
        return max(100 * abs(theirs[name] / ours[name] - 1) for name in self.names)


def pairs(setting: Setting, *, references: tuple[str, ...] | None = None) -> Iterator[Pair]:
    """All of a setting, by regime and arm; only against these references where they are given."""
    wanted = [name for name in setting.references() if references is None or name in references]
    for regime in setting.regimes:
        for arm in setting.hybrids(regime):
            runs = setting.runs(arm)
            for reference in wanted:
                yield Pair(arm, reference, runs, setting.matched(arm, reference))


@dataclass(frozen=True, slots=True)
class EqualQuality:
    """Bits of one arm against one video-only method, at equal quality."""

    arm: Arm
    reference: str
    ratios: tuple[float, ...]
    """Bits that video needs / bits of the hybrid, a sequence each, ascending. Infinite: more than the most that was
    flown; 0: less than the least."""
    unread: int
    """Sequences whose curve has fewer than two points, or that lack the figure."""

    @property
    def median(self) -> float:
        """Over the sequences that have a ratio or a bound, the lower of two middle ones; NaN where there are none."""
        return median_low(self.ratios) if self.ratios else math.nan

    @property
    def above(self) -> int:
        """Sequences in which no flown video shows as much."""
        return sum(math.isinf(ratio) for ratio in self.ratios)

    @property
    def below(self) -> int:
        """Sequences in which the least flown video shows more."""
        return sum(ratio == 0 for ratio in self.ratios)


def needed_bps(points: Iterable[tuple[float, float]], *, level: float) -> float:
    """Where a curve of (bits a second, figure) first reaches a level.

    Infinite where it never does; 0 where its first point is above already; NaN with fewer than two points, or no
    level.
    """
    curve = sorted(points)
    if len({bps for bps, _ in curve}) < 2 or math.isnan(level):
        return math.nan
    if curve[0][1] > level:
        return 0.0
    for (left_bps, left), (right_bps, right) in pairwise(curve):
        if left >= level:
            return left_bps
        if right >= level:
            share = (level - left) / (right - left)
            return float(left_bps * (right_bps / left_bps) ** share)
    return math.inf


def equal_quality(setting: Setting, arm: Arm, *, reference: str, column: str) -> EqualQuality:
    """Read every sequence's curve at the arm's value there."""
    video = setting.video(reference)
    runs = setting.runs(arm)
    levels, spent = values(runs, column), values(runs, "total_bps")
    ratios = []
    for name, level in levels.items():
        rows = [row for row in video.get(name, ()) if row[column] is not None]
        points = [(float(row["total_bps"]), float(row[column])) for row in rows]
        ratios.append(needed_bps(points, level=level) / spent[name])
    known = sorted(ratio for ratio in ratios if not math.isnan(ratio))
    return EqualQuality(arm, reference, tuple(known), len(ratios) - len(known))
