"""``hvt-study tune``: a real search, small, and what it says of sequences that it has not seen."""

import json
from concurrent.futures import Executor, Future
from pathlib import Path

import pytest

from hvt_common.errors import UserError
from hvt_study.cache.results import ResultCache
from hvt_study.cli import main
from hvt_study.commands.tune import split, tunable, tune
from hvt_study.matrix.plan import StudyPlan, parse_regimes
from hvt_study.matrix.tuning import tuned_methods
from hvt_study.runs.spec import ModelChoice
from studies.small_study import arguments, write_scene

NAMES = ("north", "east", "west")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scene"), *NAMES)


@pytest.mark.nightly
def test_a_search_is_judged_on_what_it_has_not_seen(scene, tmp_path, capsys):
    """Weights that fit the sequences they were found on would be sold as better ones."""
    chosen = list(tunable("M5"))[:2]
    words = ("--method", "M5", "--parameters", ",".join(chosen), "--trials", "2", "--held-out", "0.34")
    asked = ["tune", *arguments(scene, tmp_path / "out", *words, "--regimes", "300kbps", "--jobs", "2")]
    assert main(asked) == 0
    told = capsys.readouterr().out
    found = json.loads((tmp_path / "out" / "tune.json").read_text())
    train, held_out = split([(scene, name) for name in NAMES], held_out=0.34)
    assert [(one["dataset"], one["sequence"]) for one in found["held_out"]] == held_out
    assert len(train) == 2
    (row,) = found["held_out"]
    assert 0 < row["default"] <= 1
    assert all(100_000 < row[name] <= 300_000 for name in ("default_bps", "tuned_bps"))
    assert found["held_out_gain"] == pytest.approx(row["tuned"] - row["default"])
    assert found["train_tuned"] >= found["train_default"] > 0
    assert (found["trials"], list(found["parameters"])) == (2, chosen)
    if found["train_tuned"] == found["train_default"]:
        assert found["parameters"] == {name: tunable("M5")[name] for name in chosen}
    assert held_out[0][1] in told
    changed = found["train_tuned"] > found["train_default"]
    assert bool(tuned_methods([str(tmp_path / "out" / "tune.json")])) == changed, "run takes it as it is"
    assert not any(name in told for _, name in train)
    flown = list((tmp_path / "out" / "cache" / "flights").rglob("*.json"))
    cache = ResultCache(tmp_path / "out" / "cache" / "flights")
    tunes = [tuple(cache.get(path.stem)["settings"]["edge"]["tune"]) for path in flown]
    assert tunes.count(()) == 3  # as it is, on all three
    assert len(set(tunes) - {()}) == 2  # two proposals
    assert len(tunes) == 3 + 2 * 2 + (found["train_tuned"] > found["train_default"])


def test_of_one_target_recall_is_searched_for():
    """Named F1 cannot be said of it: every trial would be worth nothing, and the defaults win by that."""
    sequences, models = (("mot:a", "one"), ("mot:a", "two")), (ModelChoice("aerial-nano", "aerial-nano"),)
    regimes = parse_regimes("300kbps")
    plan = StudyPlan(sequences, (), regimes, ("jpeg",), models, "annotations", Path("nowhere"))

    class Flown(Executor):
        def submit(self, _, spec):
            recall = None if spec.sequence == "empty" else 0.5 + 0.1 * bool(spec.tune)
            row = {"named_f1": None, "recall": recall, "failed": "", "total_bps": 1}
            done = Future()
            run = {"dataset": spec.dataset, "sequence": spec.sequence, "regime": spec.regime}
            done.set_result(run | row)
            return done

    train, held_out = plan.sequences[:1], plan.sequences[1:]
    own = {"method": "M5", "parameters": tunable("M5"), "train": train, "held_out": held_out, "trials": 1}
    found = tune(plan, **own, pool=Flown())
    assert (found["train_default"], found["held_out_gain"]) == (0.5, pytest.approx(0.1))
    with pytest.raises(UserError, match="empty has no object that counts, to tune for: leave it out"):
        tune(plan, **own | {"train": [("mot:a", "empty")]}, pool=Flown())


def test_the_help_says_a_default_once_and_none_where_there_is_none(capsys):
    """A user would read "(default: all) (default: )", and "(default: [])" of a list."""
    with pytest.raises(SystemExit):
        main(["tune", "--help"])
    out = " ".join(capsys.readouterr().out.split())
    assert "(default: all)" in out
    assert "(default: 40)" in out
    for empty in ("(default: )", "(default: None)", "(default: [])"):
        assert empty not in out


def test_what_cannot_be_tuned_is_told(scene, tmp_path, capsys):
    """Hours of flights that all are the same."""
    for words, wanted in (
        (("--method", "M0"), "--method M0 has nothing to tune"),
        (("--method", "M5", "--parameters", "speed"), "--parameters 'speed' is not one of M5"),
        (("--method", "M5", "--trials", "0"), "--trials 0"),
        (("--method", "M5", "--seed", "-1"), "--seed -1 is not accepted"),
        (("--method", "M5", "--still-codecs", "jpeg,residual"), "--still-codecs jpeg,residual are several"),
        (("--method", "M5", "--only", "north"), "1 sequences"),
    ):
        assert main(["tune", *arguments(scene, tmp_path / "out", *words)]) == 2
        assert wanted in capsys.readouterr().err
    with pytest.raises(UserError, match="M5, M6"):
        tunable("permissive")


def test_a_sequence_stays_on_its_side():
    """A sequence that was searched on today would be held out tomorrow, when the set has grown."""
    names = [("set", f"s{number}") for number in range(40)]
    train, held_out = split(names, held_out=0.25)
    assert (len(train), len(held_out)) == (30, 10)
    assert not set(train) & set(held_out)
    assert split(names, held_out=0.25) == (train, held_out)
    assert set(split(list(reversed(names)), held_out=0.25)[1]) == set(held_out)
    # Four ways of the camera over each of ten pictures, and scenes with codes or without: what was searched on is not
    # said to be new.
    for dataset, ends in (("still:air?seeds=0-3", "0123"), ("demo:0-9", ["", "codes", "4k", "codes-4k"])):
        names = [(dataset, f"demo-{picture}-{end}") for picture in range(10) for end in ends]
        train, held_out = ({names.index(one) // 4 for one in side} for side in split(names, held_out=0.2))
        assert (len(train), len(held_out), train & held_out) == (8, 2, set())
        with pytest.raises(UserError, match="4 sequences of 1 pictures with --held-out"):
            split(names[:4], held_out=0.2)
