"""The search for the budget at which a method spends what another did."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_study.runs.video_shape import grid_target, match, within

totals = st.floats(2e4, 1e7)


@given(target=totals, ratio=st.floats(0.5, 1.3), power=st.floats(0.8, 1.2), seed=st.integers(0, 99))
def test_a_method_that_follows_its_budget_is_matched(target, ratio, power, seed):
    """A comparison at other bits than the hybrid's would say nothing, or lie."""

    def spends(budget):
        wobble = 1 + 0.002 * math.sin(budget * (seed + 1))
        return ratio * 1e6 * (budget / 1e6) ** power * wobble

    found = match(spends, target_bps=target)
    assert within(found.total_bps, target)
    assert found.tries <= 7
    assert found.total_bps == spends(found.budget_bps)


def test_a_method_that_cannot_spend_so_much_is_told_apart():
    """It would be averaged as if it had spent the same."""
    found = match(lambda budget: min(budget, 300_000), target_bps=800_000)
    assert not within(found.total_bps, 800_000)
    assert found.total_bps == 300_000


def test_a_curve_of_steps_ends_the_search():
    """x265 may jump from one total to the next: the search would go on for ever, or return the worse side."""
    asked = []

    def spends(budget):
        asked.append(budget)
        return 500_000 if budget < 616_000 else 640_000

    found = match(spends, target_bps=600_000)
    assert found.total_bps == 640_000
    assert len(asked) == len(set(asked)) <= 7


@given(target=totals)
def test_near_totals_share_their_target(target):
    """Two methods that spent the same would be compared with two different flights of video."""
    near = grid_target(target)
    assert abs(near / target - 1) < 0.0051
    assert grid_target(near) == pytest.approx(near)


def test_a_budget_that_is_refused_ends_the_search():
    """A run would be lost because a budget beside the right one cannot be flown, or the search crash."""
    assert match(lambda _: None, target_bps=300_000) is None
    found = match(lambda budget: None if budget < 300_000 else budget * 1.2, target_bps=300_000)
    assert found.tries == 1
    assert found.total_bps == pytest.approx(1.2 * found.budget_bps)
