"""Means, bootstrap intervals and medians over sequences, as tables and figures show them.

The interval is SciPy's percentile bootstrap (Efron and Tibshirani, "An Introduction to the Bootstrap", 1993, chapter
13). A sequence is what is drawn: frames of one sequence are not independent of each other. Differences are drawn as
pairs (`hvt_study.report.data.pairs`): what makes a sequence hard for both sides cancels.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from statistics import median_low

import numpy as np
from scipy.stats import bootstrap

ENOUGH = 5
"""Sequences from which an interval is shown and a verdict drawn. Of two or three the percentile interval is all but
their range, and leaves out 0 in a quarter or half of all cases in which there is no effect."""
_RESAMPLES = 10_000
_BATCH = 1_000


@dataclass(frozen=True, slots=True)
class Interval:
    """A mean and where it may lie."""

    mean: float
    """NaN where no sequence has the figure."""
    low: float
    """NaN with fewer than `ENOUGH` sequences, as is ``high``."""
    high: float
    sequences: int
    """That have the figure."""


def interval_of(values: Iterable[float]) -> Interval:
    """The mean of what is not NaN, with its 95 % bootstrap interval; that is NaN with fewer than `ENOUGH` values."""
    return _interval(tuple(value for value in values if not math.isnan(value)))


def mean_of(values: Iterable[float]) -> Interval:
    """The mean alone; one infinite value makes it infinite."""
    known = [value for value in values if not math.isnan(value)]
    mean = sum(known) / len(known) if known else math.nan
    if known and math.isfinite(mean):
        mean = float(np.mean(known))
    return Interval(mean, math.nan, math.nan, len(known))


def median_of(values: Iterable[float]) -> Interval:
    """The median in the mean's place, of two middle values the lower: one infinite wait does not make it infinite."""
    known = [value for value in values if not math.isnan(value)]
    return Interval(median_low(known) if known else math.nan, math.nan, math.nan, len(known))


@lru_cache(maxsize=10_000)
def _interval(values: tuple[float, ...]) -> Interval:
    """Table, figure and summary need the same; the same values give the same interval."""
    mean = mean_of(values)
    if len(values) < ENOUGH or not math.isfinite(mean.mean):
        return mean
    drawn = bootstrap((values,), np.mean, n_resamples=_RESAMPLES, batch=_BATCH, method="percentile", rng=0)
    found = drawn.confidence_interval
    return replace(mean, low=float(found.low), high=float(found.high))
