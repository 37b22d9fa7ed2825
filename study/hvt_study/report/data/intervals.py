"""Means, intervals and medians over sequences, as tables and figures show them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from statistics import median_low

from hvt_study.metrics.bootstrap import Interval, mean_interval

__all__ = ["ENOUGH", "interval_of", "mean_of", "median_of"]

ENOUGH = 5
"""Sequences from which an interval is shown and a verdict drawn. Of two or three the percentile interval is all but
their range, and leaves out 0 in a quarter or half of all cases in which there is no effect."""


def interval_of(values: Iterable[float]) -> Interval:
    """The mean of what is not NaN, with its 95 % bootstrap interval; that is NaN with fewer than `ENOUGH` values."""
    return _interval(tuple(value for value in values if not math.isnan(value)))


def mean_of(values: Iterable[float]) -> Interval:
    """The mean alone."""
    return replace(mean_interval(values, resamples=1), low=math.nan, high=math.nan)


def median_of(values: Iterable[float]) -> Interval:
    """The median in the mean's place, of two middle values the lower: one infinite wait does not make it infinite."""
    known = [value for value in values if not math.isnan(value)]
    return Interval(median_low(known) if known else math.nan, math.nan, math.nan, len(known))


@lru_cache(maxsize=10_000)
def _interval(values: tuple[float, ...]) -> Interval:
    """Table, figure and summary ask for the same."""
    return mean_interval(values) if len(values) >= ENOUGH else mean_of(values)
