"""Which rows of a table stay when a study is started again in the same folder."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hvt_common.errors import UserError
from hvt_study.matrix.plan import StudyPlan, check_parameters, staying
from hvt_study.metrics.bits import in_accounting
from hvt_study.runs.methods import chosen_methods


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
    return {
        "key": json.dumps(spec),
        "method": method,
        "failed": "",
        "matched_to": to,
        "total_bps": total,
        "target_bps": target,
        "config": json.dumps({"run": spec}),
        "accounting": "span",
        "duration_s": 20.0,
        "clip_s": 52.0,
        **rates,
    }


def test_what_this_study_does_not_have_stays():
    """Who adds a method, a sequence or a length to a study would lose all that was in it."""
    earlier = [
        row("M5"),
        row("M0", to="M5", target=100_000),
        row("M0", sequence="two"),
        row("M0", max_frames=90),
    ]
    assert staying([row("M0"), row("M6")], earlier) == earlier


def test_what_was_done_now_takes_the_place():
    """Two rows of one run would both be averaged, or the report be refused."""
    done = [row("M5"), row("M0", to="M5", target=100_000)]
    assert staying(done, done) == []
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
