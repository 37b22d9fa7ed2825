"""``hvt-study plan``: what a study would take, before it is begun."""

import json
import re
from pathlib import Path

import pytest

from hvt_common.errors import UserError
from hvt_edge.stills.policy.registry import METHODS
from hvt_study.cli import main
from hvt_study.commands.plan import estimate, hours_in_words
from hvt_study.datasets.layouts.uri import open_dataset
from hvt_study.matrix.plan import StudyPlan, first_runs, matched_runs, parse_regimes
from hvt_study.matrix.tuning import tuned_methods
from hvt_study.runs.methods import chosen_methods
from hvt_study.runs.run_settings import edge_flags, settings
from hvt_study.runs.spec import ModelChoice
from hvt_study.runs.video_shape import VideoShape
from studies.layouts import write_visdrone
from studies.small_study import SIZE, arguments

CLIPS = 79
NINE = "M0,R0,M1,M2,M3,M4,M5,M6,DDS"


def plan_of(methods, **named):
    names = (("visdrone:there", "a"), ("visdrone:there", "b"))
    models = (ModelChoice("aerial-nano", "aerial-nano"),)
    usual = {"still_codecs": ("jpeg", "residual"), "labels": "annotations", "cache": None, "size": SIZE}
    usual |= {"regimes": parse_regimes("low,moderate")} | named
    return StudyPlan(sequences=names, methods=chosen_methods(methods), models=models, **usual)


def test_all_of_visdrone_by_nine_methods_and_two_budgets(tmp_path, capsys):
    """Nobody begins a study of weeks without knowing that it is one."""
    write_visdrone(tmp_path, *(f"uav{number:07d}_v" for number in range(CLIPS)))
    words = arguments(f"visdrone:{tmp_path}", tmp_path / "out", "--methods", NINE)
    assert main(["plan", *words]) == 0
    told = dict(re.findall(r"^[ │]*(.+?)[ │]{2,}(\S.*?)[ │]*$", capsys.readouterr().out, re.MULTILINE))
    assert told["sequences"] == f"{CLIPS}"
    # M0 and R0 at two budgets; seven others, each with both again at its total.
    assert told["runs"] == f"{CLIPS * 2 * (2 + 7 * 3)}"
    assert told["frames, 15 a second"] == f"{CLIPS * 3}"
    assert told["pictures and annotations"].endswith("MB")
    assert re.search(r"^\d+\.\d+", told["hours with 1 process"])
    assert re.fullmatch(r"[1-9]\d* ms", told["one frame of a flight"])
    assert not (tmp_path / "out").exists()
    without = words[: words.index("--out")] + words[words.index("--out") + 2 :]
    assert main(["plan", *without]) == 0, "nothing is written: no place has to be named"


def test_each_classifier_is_a_study_of_its_own(tmp_path, capsys):
    """The second one would be left out, or stand in the first one's averages."""
    write_visdrone(tmp_path, "a")
    words = (f"visdrone:{tmp_path}", "--methods", "M0,M5", "--regimes", "300kbps", "--size", "320x180")
    runs = []
    for more in ([], ["--classifier", "detector", "--classifier", "none", "--classifier", "none"]):
        assert main(["plan", *words, *more]) == 0
        runs.append(int(re.search(r"runs[ │]+(\d+)", capsys.readouterr().out)[1]))
    assert runs == [3, 6]


def test_hours_are_of_every_flight(tmp_path):
    """DDS and the best frame rate are several flights in one row: the estimate would be a fifth of the truth."""
    write_visdrone(tmp_path, "a", "b", count=60)
    sequences = open_dataset(f"visdrone:{tmp_path}")
    frames = 60
    assert sum(one.clip_frames for one in sequences) == frames

    def cpu_s(methods, **named):
        return estimate(plan_of(methods, **named), sequences, frame_s=1.0).cpu_s

    assert cpu_s("M0") == 2 * frames
    assert cpu_s("M0-fps") == 6 * cpu_s("M0")
    assert cpu_s("DDS") == 5 * cpu_s("M0")
    assert cpu_s("M5") == 2 * cpu_s("M0")  # in two codecs
    assert cpu_s("M0", labels="reference") == cpu_s("M0") + frames
    assert cpu_s("M0,M5") > cpu_s("M0") + 2 * cpu_s("M5")  # video at each total takes more than one coding
    found = estimate(plan_of("M0,M5"), sequences, frame_s=1.0)
    assert found.hours(4) == found.cpu_s / 4 / 3600
    assert found.runs == 2 * 2 * (1 + 2 * 2)
    assert found.scratch_bytes == 30 * 160 * 96 * 3
    assert found.source_bytes > 120 * 1000


def test_a_budget_that_cannot_be_flown_is_told(tmp_path, capsys):
    """Hours would be promised for a study of which nothing can be flown."""
    write_visdrone(tmp_path, "a")
    words = arguments(f"visdrone:{tmp_path}", tmp_path / "out", "--methods", "M0,M5", "--regimes", "9kbps")
    assert main(["plan", *words]) == 2
    assert "M5 at 9kbps cannot be flown" in capsys.readouterr().err


def test_one_line_is_for_plan_and_run(tmp_path, capsys):
    """Who has written the line for `run` must be able to ask first what it takes, with as many processes."""
    write_visdrone(tmp_path, "a")
    run = arguments(f"visdrone:{tmp_path}", tmp_path / "out", "--methods", "M0,M5", "--jobs", "3")
    words = ["plan", *run]
    assert main([*words, "--accounting", "pilot", "--tune", "M5:small_weight=0.7"]) == 0
    told = capsys.readouterr().out
    assert re.findall(r"hours with (\d+)", told) == ["3"]
    assert re.search(r"hours with 3 processes[ │]+0\.\d{4} \((less than 1 s|\d+ (s|minutes))\)", told)
    for more, wanted in (
        (("--jobs", "0"), "--jobs 0"),
        (("--still-codecs", ","), "still codec '' is not known"),
        (("--dask", "tcp://127.0.0.1:1"), "--jobs 3 has no effect with --dask"),
        (("--tune", "M6:again=2"), "--tune of M6 has no effect: it is not among --methods M0,M5"),
        (("--matched-to", "M0"), "--matched-to 'M0' is not known: choose from M5"),
    ):
        assert main([*words, *more]) == 2
        assert wanted in capsys.readouterr().err


def test_video_is_coded_again_for_those_that_are_named():
    """A matrix in which one method is compared with video would take five times as long."""
    plan = plan_of("M0,M5,auto", matched_to=("auto",))
    row = {"failed": "", "total_bps": 250_000}
    matched = {one.method: list(matched_runs(plan, one, row)) for one in first_runs(plan)}
    assert {name: len(runs) for name, runs in matched.items()} == {"M0": 0, "M5": 0, "auto": 1}


def test_parameters_are_those_of_the_runs(tmp_path):
    """Weights that a search has found would never stand against video of the same bits."""
    found = tmp_path / "tune.json"
    found.write_text(json.dumps({"method": "M5", "parameters": {"small_weight": 0.7, "min_cost": 0.5}}))
    plan = plan_of("M0,M5,M6", tune=tuned_methods([str(found), "m6:again=2", "M5:small_weight=0.75"]))
    tunes = {spec.method: spec.tune for spec in first_runs(plan)}
    assert tunes == {"M0": (), "M5": ("min_cost=0.5", "small_weight=0.75"), "M6": ("again=2",)}
    tuned = next(spec for spec in first_runs(plan) if spec.method == "M5")
    flags = edge_flags(tuned, budget_bps=300_000, shape=VideoShape())
    assert [flags[at + 1] for at, flag in enumerate(flags) if flag == "--tune"] == list(tuned.tune)
    (video,) = matched_runs(plan, tuned, {"failed": "", "total_bps": 250_000})
    assert (video.method, video.target.total_bps, video.tune) == ("M0", 250_000, ())
    peer, *_ = first_runs(plan_of("DDS"))
    used = settings(peer, None, budget_bps=300_000, shape=VideoShape(5), named=peer.models)
    assert used["DDS"]["fps"] == 5
    usual = METHODS["M5"].parameters
    assert tuned_methods([f"M5:{name}={value!r}" for name, value in usual.items()]) == {}, "M5 as it is"


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("small_weight=0.7", "METHOD:KEY=VALUE"),
        ("M0:small_weight=0.7", "choose one of M1"),
        ("M5:speed=1", "no parameter 'speed'"),
        ("M5:small_weight", "write KEY=VALUE"),
        ("M5:small_weight=-1", "write a number from 0"),
        ("there-is-none.json", "cannot be read"),
        ("bad.json", "is no result of a search"),
        ("deep.json", "is no result of a search"),
    ],
)
def test_wrong_parameters_are_one_sentence(tmp_path, monkeypatch, word, said):
    """A slip of the pen would be flown for days."""
    monkeypatch.chdir(tmp_path)
    Path("bad.json").write_text('{"method": "M5"}')
    Path("deep.json").write_text("[" * 100_000)
    with pytest.raises(UserError, match=said) as caught:
        tuned_methods([word])
    assert "\n" not in str(caught.value)


def test_short_and_long_are_told_in_a_unit_that_says_something():
    """A fast machine plans a study of a frame, too: 9.9e-05 hours, or 0.0, tell nobody how long it takes."""
    told = [hours_in_words(seconds / 3600) for seconds in (0.36, 40, 600, 3 * 3600 + 60)]
    assert told == ["0.0001 (less than 1 s)", "0.0111 (40 s)", "0.1667 (10 minutes)", "3.0"]


def test_a_dataset_that_is_not_there_is_named_with_its_options(capsys):
    """Its question mark made it an address, and the sentence said that '…?…' does not exist."""
    assert main(["plan", uri := "still:kit?classes=car,truck&labelled=car"]) == 2
    assert f"dataset {uri!r}: folder 'kit' does not exist" in capsys.readouterr().err
