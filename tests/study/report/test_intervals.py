"""Confidence intervals over sequences, against values worked out by hand and against what they promise."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hvt_study.report.data.captions import ENOUGH, interval_of, mean_of


def test_an_interval_worked_out_by_hand():
    """A wrong interval would call noise a finding."""
    # The number of ones among five drawn from 0 0 0 0 1 is binomial (5, 0.2): its distribution function is
    # 0.328 at 0, 0.942 at 2 and 0.993 at 3, so that 95 % of the means lie from 0 to 3/5.
    found = interval_of([0.0, 0.0, 1.0, 0.0, 0.0])
    assert (found.mean, found.low, found.high, found.sequences) == (0.2, 0.0, pytest.approx(0.6), 5)


def test_the_same_values_give_the_same_interval():
    """A report that changes from run to run proves nothing."""
    values = np.random.default_rng(3).exponential(size=24).tolist()
    first = interval_of(values)
    assert interval_of([*values, math.nan]) == first
    assert first.low < first.mean < first.high


def test_the_interval_holds_the_true_mean_about_as_often_as_it_says():
    """Sequences of a mean of 1: of 95 % intervals of thirty of them some 93 % hold it."""
    rng = np.random.default_rng(0)
    intervals = [interval_of(rng.normal(1, 0.3, 30).tolist()) for _ in range(100)]
    assert 87 <= sum(one.low <= 1 <= one.high for one in intervals) <= 99


def test_few_and_no_values():
    """Few sequences have a mean and no interval; equal ones an interval of no width; none nothing."""
    few = interval_of([0.4, math.nan] * (ENOUGH - 1))
    assert (few.mean, few.sequences, math.isnan(few.low), math.isnan(few.high)) == (
        0.4,
        ENOUGH - 1,
        True,
        True,
    )
    assert interval_of([]).sequences == 0
    assert math.isnan(interval_of([math.nan]).mean)
    equal = interval_of([0.3] * 5)
    assert (equal.low, equal.high) == (pytest.approx(0.3), pytest.approx(0.3))


def test_a_wait_without_end():
    """An infinite wait makes an infinite mean, and no interval."""
    endless = interval_of([1.0, math.inf, 2.0, 3.0, 4.0])
    assert endless.mean == math.inf
    assert math.isnan(endless.low)
    assert math.isnan(mean_of([math.inf, -math.inf]).mean)
