"""``hvt-study run`` from its arguments to its table: real flights of a small scene, and wrong input."""

import json
import shutil
import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from hvt_common.files import locked
from hvt_study.cli import main
from hvt_study.commands import run as command
from hvt_study.matrix.plan import StudyPlan, first_runs, parse_regimes
from hvt_study.report.data.table_file import read_results, write_results
from hvt_study.runs import execute
from hvt_study.runs.methods import chosen_methods
from hvt_study.runs.run_context import open_materials, open_run_context
from hvt_study.runs.spec import COLUMNS, ModelChoice
from hvt_study.runs.video_shape import within
from media.onnx_models import colour_classifier, colour_detector
from studies.layouts import write_visdrone
from studies.small_study import REGIME, SIZE, arguments, detector, entries, flights, table, write_scene

EVERYWHERE = """duration_s total_bps base_bps roi_bps track_bps fps stills map_50 mota hota idf1 top1 top1_all
macro_f1 recall f1 delay_p95_ms id_switches"""
METHODS = ("--methods", "M0,M5,DDS", "--regimes", REGIME)


@pytest.fixture(autouse=True, scope="module")
def _in_this_process():
    """One of the study loads all packages anew; test_compare.py and, at night, test_stop.py fly in such."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hvt_study.commands.arguments.local_pool", ThreadPoolExecutor)
        yield


@pytest.fixture(scope="module")
def done(scene, tmp_path_factory):
    """A finished study with two budgets, of which nothing can be flown at the second."""
    out = tmp_path_factory.mktemp("done") / "new" / "folder"
    regimes = ("--methods", "M0,M5,DDS", "--regimes", "80kbps,9kbps")
    assert main(["run", *arguments(scene, out, *regimes, "--jobs", "1")]) == 0
    return out


def good(rows):
    return [row for row in rows if row["regime"] == REGIME]


def test_a_row_for_every_run(done):
    """A table with holes, or without what its figures were measured with, could not be believed."""
    rows = good(table(done))
    order = [(row["method"], row["matched_to"]) for row in rows]
    assert order == [("M0", ""), ("M5", ""), ("M0", "M5"), ("DDS", ""), ("M0", "DDS")]
    assert {row["labels"] for row in rows} == {"annotations"}
    for row in rows:
        assert not {name for name in EVERYWHERE.split() if row[name] is None}, row["method"]
        config = json.loads(row["config"])
        assert config["run"]["method"] == row["method"]
        assert config["run"]["max_frames"] is None
        assert {"numpy", "av", "motmetrics", "hvt", "code", "provider"} <= json.loads(row["versions"]).keys()
        assert json.loads(row["content"]).keys() == {"clip", "detector", "edge_detector"}
    m5 = next(row for row in rows if row["method"] == "M5")
    stills = {column.name for column in COLUMNS if "still" in column.name}
    assert m5["stills"] > 0
    assert not {name for name in stills if m5[name] is None}
    assert {row["stills"] for row in rows if row["method"] == "M0"} == {0}
    # What a ground says of stills is beside the total; what a server asks is in it.
    assert {row["back_bps"] for row in rows if row["method"] == "M0"} == {0}
    assert 0 < 8 * 85 / 2 < m5["back_bps"] < 15 * 8 * 400
    dds = next(row for row in rows if row["method"] == "DDS")
    assert 0 < dds["back_bps"] == dds["other_bps"]


def test_video_spends_what_the_others_really_spent(done):
    """Compared at other bits, either side could win."""
    rows = good(table(done))
    spent = {row["method"]: row["total_bps"] for row in rows if not row["matched_to"]}
    matching = [row for row in rows if row["matched_to"]]
    assert len(matching) == 2
    for row in matching:
        assert row["matched"], row["failed"]
        assert row["target_bps"] == spent[row["matched_to"]]
        assert within(row["total_bps"], row["target_bps"])
    for row in rows:
        parts = row["base_bps"] + row["roi_bps"] + row["track_bps"]
        # The rest is status, and what DDS asks.
        assert 0 <= row["total_bps"] - parts < 0.05 * row["total_bps"]
        # Thirty of thirty images at 15 a second: the clip is as long as the processed span.
        assert row["total_bps_pilot"] == row["total_bps"]


def test_a_run_that_cannot_be_flown_is_in_no_average(done):
    """One budget too many would end the study, or count as a bad result."""
    rows = [row for row in table(done) if row["regime"] == "9kbps"]
    assert [row["method"] for row in rows] == ["M0", "M5", "DDS"]
    for row in rows:
        assert not row["matched"]
        assert "budget" in row["failed"]
        assert row["total_bps"] is row["f1"] is None
        assert json.loads(row["config"])["run"]["budget_bps"] == 9000
    report = (done / "report.md").read_text()
    assert "9kbps" in report.partition("Runs that do not count")[2]


def test_a_second_run_does_nothing_anew(scene, done, monkeypatch):
    """A study of days would begin from nothing after every change of its report; a damaged entry would end it."""
    monkeypatch.setattr(command, "write_report", lambda *_, **__: None)
    cache = done / "cache"
    clocks = (done / "results.parquet").read_bytes()
    before = entries(cache)
    again = ["run", *arguments(scene, done, "--methods", "M0,M5,DDS", "--regimes", "80kbps,9kbps")]
    assert main([*again, "--jobs", "1"]) == 0
    assert entries(cache) == before
    assert (done / "results.parquet").read_bytes() == clocks  # to the byte: what was timed is remembered too


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
def test_an_interrupted_study_keeps_what_was_there(scene, done, tmp_path, monkeypatch, how):
    """Started again and stopped after a minute, a study of a thousand rows would be a study of three."""
    out = tmp_path / "out"
    out.mkdir()
    shutil.copy(done / "results.parquet", out)
    before = table(out)

    def interrupted(*_, on_row, **__):
        on_row(before[0], 1, len(before))
        signal.raise_signal(how)

    monkeypatch.setattr(command, "run_all", interrupted)
    words = arguments(scene, out, "--methods", "M0,M5,DDS", "--regimes", "80kbps,9kbps", "--jobs", "1")
    kept = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        assert main(["run", *words]) == 128 + how
    finally:
        signal.signal(signal.SIGTERM, kept)
    assert {row["key"] for row in table(out)} == {row["key"] for row in before}
    assert len(table(out)) == len(before)


def test_a_study_beside_another_in_one_folder_keeps_its_rows(scene, done, tmp_path, monkeypatch, capsys):
    """Who starts the second half in another window would find the rows of one of them alone, or no report."""
    own, other = table(done)[:1], table(done)[1:2]

    def flown(*_, **__):
        write_results(other, tmp_path / "results.parquet")  # ended in the meantime
        return own

    def alone(write):
        def written(*given, **more):
            with pytest.raises(ZeroDivisionError), locked(tmp_path / ".lock", lambda: 1 / 0):
                pass  # from reading to writing nobody else is here
            write(*given, **more)

        return written

    monkeypatch.setattr(command, "run_all", flown)
    monkeypatch.setattr(command, "new_example", lambda *_: "example")
    monkeypatch.setattr(command, "save_example", alone(lambda *_: None))
    for name in ("write_results", "write_report"):
        monkeypatch.setattr(command, name, alone(getattr(command, name)))
    monkeypatch.setattr("hvt_study.commands.report.write_report", alone(lambda *_, **__: None))
    words = arguments(scene, tmp_path, "--methods", "M0", "--regimes", REGIME, "--jobs", "1")
    assert main(["run", *words]) == 0
    assert {row["key"] for row in table(tmp_path)} == {row["key"] for row in (*own, *other)}
    assert main(["report", str(tmp_path)]) == 0
    (tmp_path / "results.parquet").unlink()
    tuned = json.loads(own[0]["config"])
    tuned["run"]["tune"] = ["value=2"]  # no report takes both
    other[0] = {**own[0], "config": json.dumps(tuned)}
    assert main(["run", *words]) == 2
    assert "the runs of this study are in" in capsys.readouterr().err
    tables = table(tmp_path), read_results(tmp_path / "results-2.parquet")
    assert [row["config"] for (row,) in tables] == [row["config"] for row in (*other, *own)]


@pytest.mark.nightly
def test_a_method_that_is_added_stands_beside_the_others(scene, done, tmp_path, capsys):
    """The table of a finished study would be gone without a word."""
    out = tmp_path / "out"
    out.mkdir()
    shutil.copy(done / "results.parquet", out)
    words = ("--methods", "tracks", "--regimes", "9kbps", "--jobs", "1", "--cache", str(done / "cache"))
    assert main(["run", *arguments(scene, out, *words)]) == 2  # nothing can be flown at so little
    assert "every run failed" in capsys.readouterr().err
    new, *earlier = table(out)
    assert (new["method"], new["regime"]) == ("tracks", "9kbps")
    assert earlier == table(done)
    (out / "results.parquet").write_bytes(b"something else")
    assert main(["run", *arguments(scene, out, *words)]) == 2
    assert "cannot be read as Parquet" in capsys.readouterr().out
    assert (out / "earlier-results.parquet").read_bytes() == b"something else"
    assert table(out) == [new]


def plan_of(scene, cache, *, labels="annotations", classifier="detector"):
    return StudyPlan(
        sequences=((scene, "street"),),
        methods=chosen_methods("M0"),
        regimes=parse_regimes(REGIME),
        still_codecs=("jpeg",),
        models=(ModelChoice(detector(scene), detector(scene), classifier=str(classifier)),),
        labels=labels,
        cache=cache,
        size=SIZE,
    )


def test_an_error_in_one_flight_is_one_row(scene, tmp_path, monkeypatch, caplog):
    """One picture in a thousand that a library stumbles over would end the study, each time it is started."""
    plan = plan_of(scene, tmp_path / "cache")
    (spec,) = first_runs(plan)

    def stumbles(*_, **__):
        raise AssertionError("the base frame 3 cannot be decoded\nand more")

    with monkeypatch.context() as broken:
        broken.setattr(execute, "flown", stumbles)
        row = execute.run_spec(spec, cache=plan.cache)
    assert row["failed"] == "AssertionError: the base frame 3 cannot be decoded"
    assert (row["matched"], row["total_bps"], row["method"]) == (False, None, "M0")
    assert "Traceback" in caplog.text
    assert not flights(plan.cache)  # the next start tries again
    with monkeypatch.context() as full:
        full.setattr(execute, "flown", lambda *_, **__: (_ for _ in ()).throw(MemoryError))
        with pytest.raises(MemoryError):
            execute.run_spec(spec, cache=plan.cache)


def test_files_that_change_in_a_study_or_after_it_are_read_anew(tmp_path, monkeypatch, caplog):
    """Labels are mended, weights trained again: runs of the new would be of the old, and kept under its name."""
    uri = write_scene(tmp_path / "scene", "street")
    (spec,) = first_runs(plan_of(uri, tmp_path / "cache"))
    monkeypatch.setattr(execute, "flown", lambda *_, **__: {}["none"])
    found = []
    labels, weights = tmp_path / "scene" / "annotations" / "street.txt", Path(detector(uri))
    more = b"\x72\x07\x0a\x01a\x12\x02bc"
    changes = [(labels, b""), (labels, b"1,99,0,0,9,9,1,4,0,0\n"), (weights, more)]

    def write(path, more):
        path.write_bytes(path.read_bytes() + more)

    for path, added in changes:
        row = execute.run_spec(spec, cache=tmp_path / "cache", study="one")
        found.append(json.loads(row["content"]))
        write(path, added)
    found.append(json.loads(execute.run_spec(spec, cache=tmp_path / "cache", study="one")["content"]))
    assert found[0] == found[1]
    assert found[2]["clip"] != found[1]["clip"]
    assert found[3]["clip"] == found[2]["clip"]
    assert found[3]["detector"] != found[2]["detector"] == found[0]["detector"]
    assert f"{weights} was written while the study runs" in caplog.text
    clips = []
    for _ in range(3):  # of cached flights, which open no pictures
        clips.append(open_materials(spec, cache=tmp_path / "cache").content["clip"])
        write(labels, b"2,99,0,0,9,9,1,4,0,0\n")
    assert len({*clips}) == 3
    with monkeypatch.context() as late:
        late.setattr(
            execute, "open_run_context", lambda *a, **k: write(weights, more) or open_run_context(*a, **k)
        )
        row = execute.run_spec(spec, cache=tmp_path / "cache", study="one")
    assert "were written meanwhile" in row["failed"]
    open_before = open_materials(spec, cache=tmp_path / "cache").detector
    execute.run_spec(spec, cache=tmp_path / "cache", study="two")
    assert open_materials(spec, cache=tmp_path / "cache").detector is not open_before


def test_a_classifier_names_the_reference_labels(scene, tmp_path):
    """Labels would be the detector's word where the study says that they are the classifier's."""
    names = ("minivan", "beach wagon", "pickup")
    metadata = {"names": str(dict(enumerate(names)))}
    reader = colour_classifier(tmp_path / "reader.onnx", metadata=metadata)
    plan = plan_of(scene, tmp_path / "cache", labels="reference", classifier=reader)
    (spec,) = first_runs(plan)
    found = open_materials(spec, cache=plan.cache)
    assert found.classes.word("minivan") == found.classes.word("car") == "car"
    assert found.classes.word("pickup") == found.classes.word("truck") != "car"
    first = open_run_context(spec, cache=plan.cache)
    assert first.classifier is found.classifier
    said = {name for one in first.labels for name in one.class_names}
    assert said
    assert said <= set(names)
    shutil.rmtree(plan.cache / "detections")  # labels are remembered as they are
    other = plan_of(scene, tmp_path / "other")  # the last context alone stays open
    open_run_context(*first_runs(other), cache=other.cache)
    again = open_run_context(spec, cache=plan.cache)
    assert not (plan.cache / "detections").exists()
    for one, other in zip(first.labels, again.labels, strict=True):
        assert np.array_equal(one.boxes_xyxy_px, other.boxes_xyxy_px)
        assert one.class_names == other.class_names
    plain = plan_of(scene, plan.cache, labels="annotations", classifier=reader)
    assert open_materials(*first_runs(plain), cache=plan.cache).classes.word("minivan") == "car"


def test_wrong_input_is_one_sentence(scene, tmp_path, capsys):
    """A traceback after an hour, in place of what is wrong before the first flight."""
    write_visdrone(tmp_path / "bare", "one")
    (tmp_path / "bare" / "annotations" / "one.txt").unlink()
    names = {"names": "{0: 'cat', 1: 'dog', 2: 'cow'}"}
    other = colour_detector(tmp_path / "other.onnx", "yolox", metadata=names)
    (tmp_path / "file").write_text("")
    (tmp_path / "locked" / ".lock").mkdir(parents=True)
    for words, wanted, *place in (
        ((f"visdrone:{tmp_path}/bare",), "has no annotations"),
        ((f"visdrone:{tmp_path}/bare?labels=none",), "add --labels reference"),
        ((scene, "--detector", str(other)), "nothing in common"),
        ((scene, "--detector", "motion"), "give a detection network"),
        ((scene, "--jobs", "0"), "--jobs 0 is not accepted"),
        ((scene, "--jobs", "2", "--dask", "tcp://127.0.0.1:1"), "has no effect with --dask"),
        ((scene, "--regimes", "lots"), "--regimes 'lots'"),
        ((scene, "--regimes", "9kbps", "--methods", "M0", "--jobs", "1"), "every run failed"),
        ((scene, "--max-frames", "3"), "--max-frames 3 is too few"),
        ((scene, "--detect-every", "0"), "--detect-every 0"),
        ((scene, *METHODS), "--out", "file"),
        ((scene, *METHODS), "locked cannot be written", "locked"),
    ):
        assert main(["run", *arguments(words[0], tmp_path / (place or ["out"])[0], *words[1:])]) == 2
        sentence = capsys.readouterr().err
        assert wanted in sentence, sentence
        assert sentence.rstrip("\n").splitlines()[-1].startswith("hvt-study: ")


GPUU, CACHE = "--provider=gpuu", "--cache=a-file"


@pytest.mark.parametrize(
    ("words", "reads"),
    [
        *((("run", "demo:0-1", one), "arguments.open_datasets") for one in (GPUU, CACHE)),
        *((("tune", "demo:0-1", "--method", "M5", one), "arguments.open_datasets") for one in (GPUU, CACHE)),
        (("compare", "demo", "--detector", "aerial-nano", GPUU), "compare._plan"),
        (("read", "demo:codes", GPUU), "read._plan"),
    ],
)
def test_means_that_cannot_be_are_refused_before_a_file_is_read(words, reads, tmp_path, monkeypatch, capsys):
    """It took until a process had opened data and networks: a quarter of a minute for a slip of the pen."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a-file").touch()
    monkeypatch.setattr(f"hvt_study.commands.{reads}", None)
    assert main([*words, "--out", "out"]) == 2
    assert words[-1].partition("=")[2] in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
