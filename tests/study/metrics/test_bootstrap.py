"""Confidence intervals over sequences, against SciPy's and against what they promise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import bootstrap

from hvt_study.metrics.bootstrap import difference_interval, mean_interval

SKEWED = np.random.default_rng(3).exponential(size=24)


@pytest.mark.parametrize(("kind", "method"), [("percentile", "percentile"), ("bca", "BCa")])
def test_scipy_agrees(kind, method):
    """A wrong interval would call noise a finding."""
    ours = mean_interval(SKEWED, kind=kind, resamples=40_000)
    theirs = bootstrap((SKEWED,), np.mean, n_resamples=40_000, method=method, rng=5).confidence_interval
    assert ours.mean == pytest.approx(SKEWED.mean())
    width = theirs.high - theirs.low
    assert ours.low == pytest.approx(theirs.low, abs=0.02 * width)
    assert ours.high == pytest.approx(theirs.high, abs=0.02 * width)


def test_bca_leans_with_the_skew():
    """The two kinds must differ where it matters, or one of them is not computed."""
    plain, bca = (mean_interval(SKEWED, kind=kind) for kind in ("percentile", "bca"))
    assert bca.low > plain.low
    assert bca.high > plain.high


def test_the_same_seed_gives_the_same_interval():
    """A report that changes from run to run proves nothing."""
    assert mean_interval(SKEWED, seed=4) == mean_interval(SKEWED, seed=4)
    assert mean_interval(SKEWED, seed=4) != mean_interval(SKEWED, seed=5)


def test_the_interval_holds_the_true_mean_about_as_often_as_it_says():
    """Sequences of a mean of 1: of 95 % intervals of thirty of them some 93 % hold it."""
    rng = np.random.default_rng(0)
    held = 0
    for trial in range(200):
        one = mean_interval(rng.normal(1, 0.3, 30), resamples=1000, seed=trial)
        held += one.low <= 1 <= one.high
    assert 178 <= held <= 198


def test_pairs_cancel_what_makes_a_sequence_hard():
    """A steady small gain over M0 must show although sequences differ by far more."""
    rng = np.random.default_rng(1)
    base = {f"s{k}": float(value) for k, value in enumerate(rng.uniform(0.2, 0.9, 12))}
    ours = {name: value + 0.02 + 0.001 * k for k, (name, value) in enumerate(base.items())}
    gap = difference_interval(ours, base)
    assert gap.low > 0.02
    assert gap.high - gap.low < 0.01
    assert difference_interval(base, ours).high < 0
    apart = mean_interval(ours.values())
    assert apart.high - apart.low > 0.1


def test_only_sequences_with_both_figures_are_compared():
    """A run that failed must not pull the others' difference."""
    gap = difference_interval({"a": 1.0, "b": 2.0, "c": math.nan}, {"a": 0.5, "c": 0.1, "d": 9.0})
    assert (gap.mean, gap.sequences) == (0.5, 1)
    assert math.isnan(gap.low)


def test_few_and_no_values():
    """One sequence has a mean and no interval; equal ones an interval of no width; none nothing."""
    one = mean_interval([0.4, math.nan])
    assert (one.mean, one.sequences, math.isnan(one.low), math.isnan(one.high)) == (0.4, 1, True, True)
    assert mean_interval([]).sequences == 0
    assert math.isnan(mean_interval([math.nan]).mean)
    for kind in ("percentile", "bca"):
        equal = mean_interval([0.3] * 5, kind=kind)
        assert (equal.low, equal.high) == (pytest.approx(0.3), pytest.approx(0.3))
    endless = mean_interval([1.0, math.inf, 2.0])
    assert endless.mean == math.inf
    assert math.isnan(endless.low)
    assert math.isnan(mean_interval([math.inf, -math.inf]).mean)
