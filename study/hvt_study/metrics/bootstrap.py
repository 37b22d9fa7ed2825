"""Bootstrap confidence intervals of means over sequences, and of paired differences.

Efron and Tibshirani, "An Introduction to the Bootstrap", 1993: the percentile interval (chapter 13) and BCa (chapter
14). The sequence is what is drawn: frames of one sequence are not independent of each other. The same seed gives the
same interval. With fewer than some ten sequences every bootstrap interval is too narrow; say how many there were.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr, ndtri

__all__ = ["Interval", "Kind", "difference_interval", "mean_interval"]

Kind: TypeAlias = Literal["percentile", "bca"]
_Values = npt.NDArray[np.float64]

_CELLS = 1 << 22
"""Of values drawn at a time."""


@dataclass(frozen=True, slots=True)
class Interval:
    """A mean and where it may lie."""

    mean: float
    """NaN where no sequence has the figure."""
    low: float
    """NaN with fewer than two sequences, as is ``high``."""
    high: float
    sequences: int
    """That have the figure."""


def mean_interval(
    values: Iterable[float],
    *,
    kind: Kind = "percentile",
    level: float = 0.95,
    resamples: int = 10_000,
    seed: int = 0,
) -> Interval:
    """Of the mean of one value a sequence; NaNs are left out, infinite values make an infinite mean without interval.

    Args:
        values: one a sequence, in an order that stays.
        kind: ``percentile``, or ``bca`` (bias-corrected and accelerated).
        level: share of such intervals that are to hold the true mean, 0…1.
        resamples: how many samples are drawn.
        seed: of the draws.
    """
    known = np.array([value for value in values if not math.isnan(value)], np.float64)
    if not len(known):
        return Interval(math.nan, math.nan, math.nan, 0)
    mean = float(known.mean()) if np.isfinite(known).all() else sum(known.tolist())
    if len(known) == 1 or not math.isfinite(mean):
        return Interval(mean, math.nan, math.nan, len(known))
    means = _drawn_means(known, resamples, seed)
    tails = np.array([(1 - level) / 2, (1 + level) / 2])
    if kind == "bca":
        tails = _corrected(tails, known, means)
    low, high = np.quantile(means, tails).tolist()
    return Interval(mean, low, high, len(known))


def difference_interval(
    values: Mapping[str, float],
    reference: Mapping[str, float],
    *,
    kind: Kind = "percentile",
    level: float = 0.95,
    resamples: int = 10_000,
    seed: int = 0,
) -> Interval:
    """Of the mean of ``values - reference`` over the sequences (keys) that have both figures.

    Positive says that ``values`` are greater. The pairs are drawn, not the two sides each: what makes a sequence hard
    for both of them cancels.
    """
    both = sorted(values.keys() & reference.keys())
    gaps = [values[name] - reference[name] for name in both]
    return mean_interval(gaps, kind=kind, level=level, resamples=resamples, seed=seed)


def _drawn_means(values: _Values, resamples: int, seed: int) -> _Values:
    """(resamples,) means of as many values drawn with replacement."""
    rng = np.random.default_rng(seed)
    count = len(values)
    step = max(1, _CELLS // count)
    sizes = [min(step, resamples - begun) for begun in range(0, resamples, step)]
    return np.concatenate([values[rng.integers(0, count, (size, count))].mean(axis=1) for size in sizes])


def _corrected(tails: _Values, values: _Values, means: _Values) -> _Values:
    """The tails that BCa takes instead (equations 14.10, 14.14 and 14.15); the same where all values are equal."""
    mean = values.mean()
    without = (values.sum() - values) / (len(values) - 1)
    away = without.mean() - without
    spread = (away**2).sum()
    if spread <= 1e-24 * max(1.0, mean**2):
        return tails
    below = ((means < mean).mean() + (means <= mean).mean()) / 2
    bias = ndtri(below)
    acceleration = (away**3).sum() / (6 * spread**1.5)
    shifted = bias + ndtri(tails)
    return np.asarray(ndtr(bias + shifted / (1 - acceleration * shifted)), np.float64)
