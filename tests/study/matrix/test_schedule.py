"""Which runs a study takes, and in which order they are done."""

from __future__ import annotations

import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from hvt_common.errors import UserError
from hvt_study.matrix.plan import Regime, StudyPlan, parse_regimes
from hvt_study.matrix.schedule import run_all
from hvt_study.runs.methods import METHODS, chosen_methods
from hvt_study.runs.spec import ModelChoice
from hvt_study.runs.video_shape import grid_target

SPENT = {"M2": 700_000, "M5": 780_000, "M6": 783_000}


def plan_of(methods="M0,R0,M2,M5,M6", codecs=("jpeg", "residual"), regimes="low,300kbps"):
    return StudyPlan(
        sequences=(("demo:0-1", "seed-0"), ("demo:0-1", "seed-1")),
        methods=chosen_methods(methods),
        regimes=parse_regimes(regimes),
        still_codecs=codecs,
        models=(ModelChoice("aerial-nano", "aerial-nano"),),
        labels="annotations",
        cache=Path("nowhere"),
    )


def result(spec):
    total = spec.target.total_bps if spec.target else SPENT.get(spec.method, spec.budget_bps)
    failed = "the budget is too small" if spec.method == "M2" and spec.regime == "300kbps" else ""
    return {"total_bps": None if failed else total, "failed": failed, "key": spec.key}


def test_every_hybrid_gets_its_own_video(tmp_path):
    """The hybrid would be compared with video that had other bits."""
    plan, seen = plan_of(), []
    with ThreadPoolExecutor(3) as pool:
        rows = run_all(plan, pool=pool, run=result, at_once=3, on_row=lambda *step: seen.append(step))
    # A sequence and regime: M0 and R0 at the budget, three hybrids in two codecs each; M2 fails at 300 kbps.
    hybrids = 2 * 2 * 3 * 2 - 2 * 2
    assert len(rows) == 2 * 2 * (2 + 6) + 2 * hybrids
    assert len({row["key"] for row in rows}) == len(rows)
    assert [step[1] for step in seen] == list(range(1, len(rows) + 1))
    assert seen[-1][2] == len(rows)


def test_the_order_of_rows_does_not_depend_on_the_pool():
    """Two runs of one study would give two files."""
    plan = plan_of()
    orders = []
    for workers in (1, 4):
        with ThreadPoolExecutor(workers) as pool:
            orders.append([row["key"] for row in run_all(plan, pool=pool, run=result, at_once=workers)])
    assert orders[0] == orders[1]


def test_one_flight_is_never_done_twice_at_once():
    """Two processes would fly the same video side by side, and only one be of use."""
    flying, most = Counter(), Counter()

    def run(spec):
        if spec.target is not None:
            near = grid_target(spec.target.total_bps)
            flight = (spec.sequence, spec.regime, spec.method, near)
            flying[flight] += 1
            most[flight] = max(most[flight], flying[flight])
            time.sleep(0.005)  # long enough for another to begin
            row = result(spec)
            flying[flight] -= 1
            return row
        return result(spec)

    with ThreadPoolExecutor(8) as pool:
        rows = run_all(plan_of(codecs=("jpeg", "webp")), pool=pool, run=run, at_once=8)
    assert len(most) < sum(row["total_bps"] is not None for row in rows), "some share their flight"
    assert set(most.values()) == {1}


def test_an_error_ends_the_study_and_leaves_nothing_running():
    """It would go on for hours after it had failed, or hang."""

    def run(spec):
        if spec.method == "M5":
            raise UserError("cache is full")
        return result(spec)

    with ThreadPoolExecutor(2) as pool, pytest.raises(UserError, match="full"):
        run_all(plan_of(), pool=pool, run=run, at_once=2)


def test_words_for_regimes():
    """A budget of the paper would be another here."""
    assert parse_regimes("low, moderate,300kbps") == (
        Regime("low", 800_000),
        Regime("moderate", 1_400_000),
        Regime("300kbps", 300_000),
    )
    with pytest.raises(UserError, match=r"'lo'.*low, moderate or a bitrate"):
        parse_regimes("lo")
    with pytest.raises(UserError, match=r"'M9'.*choose from M0"):
        chosen_methods("M0,M9")
    assert [row.name for row in chosen_methods("M5,m0")] == ["M0", "M5"]
    assert all(row.says for row in METHODS.values())
