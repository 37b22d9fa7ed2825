"""Which runs a study takes, and in which order they are done."""

import json
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from hvt_common.errors import UserError
from hvt_study.matrix.plan import Regime, StudyPlan, check_parameters, parse_regimes, run_all, staying
from hvt_study.metrics.bits import in_accounting
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


def test_every_hybrid_gets_its_own_video():
    """The hybrid would be compared with video that had other bits; two runs of one study would give two files."""
    plan, seen, orders = plan_of(), [], []
    for workers in (1, 4):
        seen.clear()
        with ThreadPoolExecutor(workers) as pool:
            rows = run_all(
                plan, pool=pool, run=result, at_once=workers, on_row=lambda *step: seen.append(step)
            )
        orders.append([row["key"] for row in rows])
    # A sequence and regime: M0 and R0 at the budget, three hybrids in two codecs each; M2 fails at 300 kbps.
    hybrids = 2 * 2 * 3 * 2 - 2 * 2
    assert len(rows) == len(set(orders[0])) == 2 * 2 * (2 + 6) + 2 * hybrids
    assert [step[1] for step in seen] == list(range(1, len(rows) + 1))
    assert seen[-1][2] == len(rows)
    assert orders[0] == orders[1], "whatever the pool"


def test_one_flight_is_never_done_twice_at_once():
    """Two processes would fly the same video side by side, and only one be of use."""
    flying, most = Counter(), Counter()

    def run(spec):
        row = result(spec)
        if spec.target is not None:
            flight = (spec.sequence, spec.regime, spec.method, grid_target(spec.target.total_bps))
            flying[flight] += 1
            most[flight] = max(most[flight], flying[flight])
            time.sleep(0.005)  # long enough for another to begin
            flying[flight] -= 1
        return row

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
    wanted = (Regime("low", 800_000), Regime("moderate", 1_400_000), Regime("300kbps", 300_000))
    assert parse_regimes("low, moderate,300kbps") == wanted
    with pytest.raises(UserError, match=r"'lo'.*low, moderate or a bitrate"):
        parse_regimes("lo")
    with pytest.raises(UserError, match=r"'M9'.*choose from M0"):
        chosen_methods("M0,M9")
    assert [row.name for row in chosen_methods("M5,m0")] == ["M0", "M5"]
    assert all(row.says for row in METHODS.values())


def row(method, *, total=100_000, to="", target=None, sequence="one", provider="auto", **run):
    """As a table has it, as far as it matters here."""
    aim = {"method": to, "still_codec": "", "total_bps": target} if to else None
    models = {
        "detector": "a",
        "edge_detector": "a",
        "classifier": "none",
        "refine": "fuse",
        "provider": provider,
    }
    spec = {
        "dataset": "demo:0",
        "sequence": sequence,
        "method": method,
        "regime": "low",
        "budget_bps": 300_000,
    }
    spec |= {"still_codec": "", "labels": "annotations", "size": [1280, 720], "max_frames": None}
    spec |= {"detect_every": 5, "models": models, "target": aim, "tune": [], **run}
    rates = dict.fromkeys(("base_bps", "roi_bps", "track_bps", "other_bps", "back_bps", "stills_per_min"), 0)
    told = {"key": json.dumps(spec), "method": method, "failed": "", "matched_to": to, "total_bps": total}
    told |= {"target_bps": target, "config": json.dumps({"run": spec}), "accounting": "span"}
    return told | {"duration_s": 20.0, "clip_s": 52.0, **rates}


def test_what_this_study_does_not_have_stays_and_what_was_done_now_takes_the_place():
    """Who adds a method or a sequence would lose what was there; two rows of one run would both be averaged."""
    matched = row("M0", to="M5", target=100_000)
    earlier = [row("M5"), matched, row("M0", sequence="two"), row("M0", max_frames=90)]
    assert staying([row("M0"), row("M6")], earlier) == earlier
    assert staying(earlier[:2], earlier[:2]) == []
    assert staying([row("M5", provider="cpu", tune=["a=1"])], [row("M5")]) == []


def test_video_at_a_total_that_nobody_spends_any_more_goes():
    """After a change of HVT, M5 spends other bits: the old video would be compared with the new stills."""
    earlier = [row("M5"), row("M0", to="M5", target=100_000), row("R0", to="M5", target=100_000)]
    assert staying([row("M5", total=104_000)], earlier) == []
    assert staying([row("M5", total=None)], earlier) == []  # it fails by now
    assert staying([row("M5"), row("M0", to="M5", target=100_000)], earlier) == earlier[2:]


def test_rates_come_back_from_the_pilots_accounting():
    """An interrupted study with --accounting pilot would lose the rows that match."""
    earlier = [row("M0", to="M5", target=123_457)]
    (stays,) = staying([row("M5", total=123_457)], in_accounting(earlier, "pilot"))
    assert (stays["accounting"], stays["key"]) == ("span", earlier[0]["key"])
    assert abs(stays["target_bps"] - 123_457) <= 2


def test_other_parameters_need_another_folder():
    """After a night of flights the report would refuse a table with two kinds of M5."""
    methods = chosen_methods("M0,M5")
    plan = StudyPlan((), methods, (), ("jpeg",), (), "annotations", Path(), tune={"M5": ("a=1",)})
    check_parameters(plan, [row("M5", tune=["a=1"]), row("M0"), row("M6", tune=["b=2"])], out=Path("study"))
    for tune, said in ((["a=2"], "a=2"), ([], "its defaults")):
        with pytest.raises(UserError, match=f"--out study holds runs of M5 with {said}"):
            check_parameters(plan, [row("M5", tune=tune)], out=Path("study"))
