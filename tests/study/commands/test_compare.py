"""``hvt-study compare`` as a user runs it."""

import json
import shutil
from concurrent.futures import Executor, Future
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from hvt_common.config import load
from hvt_common.errors import UserError
from hvt_edge.config import EdgeConfig
from hvt_edge.config import check as check_edge
from hvt_scene import Scene
from hvt_study.cli import main
from hvt_study.commands.compare import command_of
from hvt_study.matrix.compare import COMPARED, ComparePlan, CompareResult, Missing, compare, opened
from hvt_study.report.figures.drawing import plot, style_of
from hvt_study.runs.methods import DDS, METHODS
from hvt_study.runs.spec import ModelChoice
from media.onnx_models import colour_detector
from studies.layouts import write_mot

FIRST_COLUMNS = [
    *("clip", "rate_kbps", "method", "half", "named_f1", "false_per_frame", "f1", "class_agreement"),
    *("total_bps", "base_bps", "roi_bps", "track_bps", "max_frame_bytes", "delay_p95_ms", "edge_cpu_ms"),
]
CARS = {"names": "{0: 'truck', 1: 'bus', 2: 'car'}"}
CHEAP = ("--size", "320x180", "--max-frames", "30", "--jobs", "1")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("no-such.mp4",), "no-such.mp4"),
        (("x" * 300,), "(File name too long): name another"),
        (("still:no-such.jpg",), "no-such.jpg"),
        (("demo", "--rates", "200,fast"), "'fast'"),
        (("demo", "--rates", "-5"), "-5"),
        (("demo", "--rates", "1"), "'1'"),
        (("demo", "--rates", "nan"), "'nan'"),
        (("demo", "--methods", "M0,M9"), "'M9'"),
        (("demo", "--methods", ""), "--methods"),
        (("demo", "--jobs", "0"), "--jobs 0"),
        (("demo", "--max-frames", "3"), "--max-frames 3"),
        (("demo", "--size", "13x7"), "13x7"),
        (("demo", "--detector", "no-such.onnx"), "no-such.onnx"),
        (("demo", "--labelled", "vehicle"), "--labelled vehicle"),
        (("demo", "--classes", "car"), "--classes car"),
    ],
)
def test_what_cannot_be_flown_is_one_sentence(tmp_path, capsys, arguments, said):
    """Nobody waits for minutes to learn of a slip of the pen."""
    given = ["compare", arguments[0], "--detector", "aerial-nano", "--out", str(tmp_path), *CHEAP]
    assert main([*given, *(word.replace("--rates=", "") for word in arguments[1:])]) == 2
    text = capsys.readouterr().err
    assert said in text
    assert "Traceback" not in text
    assert len([line for line in text.strip().splitlines() if not line.startswith("runs: ")]) == 1


def plan_of(clip, **more):
    return ComparePlan(str(clip), ModelChoice("aerial-nano", "aerial-nano"), (), clip.parent, **more)


def test_labels_of_a_clip_are_found_in_any_case(tmp_path, monkeypatch):
    """A sequence of a system that writes GT was judged by what the detector says, not by its labels."""
    clip = tmp_path / "a"
    write_mot(clip)
    for name, other in (("gt", "GT"), ("GT/gt.txt", "GT/gt.TXT"), ("img1", "IMG1")):
        (clip / name).rename(clip / other)
    plan = plan_of(clip, labels="exact")
    assert opened(plan)[1].labels is not None
    row = {"rate_kbps": 300, "method": "M0", "base_width": 160, "base_height": 96, "set_fps": None}
    assert f" --source {clip / 'IMG1'} --budget 300kbps " in command_of(plan, row)
    with pytest.raises(UserError, match=r"clip .*A' does not exist: give a video"):
        opened(plan_of(tmp_path / "A"))
    shutil.rmtree(clip / "GT")
    monkeypatch.setattr(Path, "iterdir", Mock(side_effect=PermissionError(13, "Permission denied")))
    with pytest.raises(UserError, match=r"source folder .*a' cannot be read .Permission denied"):
        opened(plan_of(clip))


class InTurn(Executor):
    """Does nothing but remember what it is given."""

    def __init__(self):
        self.specs = []

    def submit(self, _run, spec, /):
        self.specs.append(spec)
        future = Future()
        future.set_result({"digest": "", "failed": "none of it was flown"})
        return future


def test_runs_of_most_flights_go_first_and_say_nothing_of_the_time_of_others(tmp_path):
    """One process would fly the longest at the end, alone; and minutes of it be told as hours for all."""
    pool, said = InTurn(), []
    plan = replace(plan_of(tmp_path / "a"), clip="demo", rates_bps=(150_000, 800_000))
    found = compare(plan, pool=pool, on_run=lambda *words: said.append(words))
    methods = [spec.method for spec in pool.specs]
    assert methods[:4] == ["M0-best"] * 2 + ["M0-fps"] * 2
    assert len(found.missing) == len(methods) == 2 * len(COMPARED)
    assert [(done, of) for done, of, _ in said] == [(done, 18) for done in range(19)]
    assert sum(not alike for *_, alike in said) == 4


@pytest.mark.parametrize("methods", ["M5-jpeg", pytest.param("M0,M5-jpeg", marks=pytest.mark.nightly)])
def test_a_comparison_end_to_end(tmp_path, capsys, methods):
    """The question that a user brings: what do I see at this budget?"""
    picture = np.random.default_rng(0).integers(0, 20, (404, 720, 3), np.uint8)
    for number in range(8):
        x, y = 60 + number % 4 * 160, 90 + number // 4 * 200
        picture[y : y + 32, x : x + 32, 2] = 150 + 10 * number  # a network of colours sees red
    cv2.imwrite(str(tmp_path / "scene.png"), picture)
    network = colour_detector(tmp_path / "red.onnx", "yolox", size=(320, 180), metadata=CARS)
    arguments = ["compare", f"still:{tmp_path / 'scene.png'}", "--detector", str(network)]
    arguments += ["--rates", "300", "--methods", methods]
    assert main([*arguments, "--out", str(tmp_path), *CHEAP]) == 0
    rows = json.loads((tmp_path / "compare.json").read_text())
    halves = [(method, half) for method in methods.split(",") for half in range(3)]
    assert [(row["method"], row["half"]) for row in rows] == halves
    for row in rows:
        assert list(row)[: len(FIRST_COLUMNS)] == FIRST_COLUMNS
        assert row["labels"] == "reference"
        assert 0 < row["named_f1"] <= row["f1"] <= 1
        assert 0.3 * 300_000 < row["total_bps"] < 1.1 * 300_000
        assert row["total_bps"] > row["base_bps"] + row["roi_bps"]
        assert (row["false_per_frame"] >= 0, row["edge_cpu_ms"] > 0) == (True, True)
        assert (row["roi_bps"] > 0) == (row["method"] != "M0")
    assert (tmp_path / "compare.png").read_bytes().startswith(b"\x89PNG")
    said = capsys.readouterr().out
    assert "reference labels" in said
    assert "M5-jpeg" in said


@pytest.mark.nightly
def test_a_picture_with_labels_is_judged_in_what_it_labels(tmp_path):
    """People on a set that labels none would be called false; a detector that finds them would look worse."""
    for folder in ("images", "labels"):
        (tmp_path / folder).mkdir()
    scene = Scene(0)
    cv2.imwrite(str(tmp_path / "images" / "scene.png"), cv2.resize(scene.image(0.0), (720, 404)))
    truth = scene.truth(0.0)
    shares = truth.boxes_source_px / [1920, 1080, 1920, 1080]
    lines = [
        f"{kind} {(x1 + x2) / 2:.6f} {(y1 + y2) / 2:.6f} {x2 - x1:.6f} {y2 - y1:.6f}"
        for kind, (x1, y1, x2, y2) in zip(truth.class_ids.tolist(), shares.tolist(), strict=True)
    ]
    (tmp_path / "labels" / "scene.txt").write_text("\n".join(lines))
    arguments = ["compare", f"still:{tmp_path / 'images' / 'scene.png'}", "--detector", "aerial-nano"]
    arguments += ["--rates", "300", "--methods", "M0", "--classes", ",".join(Scene.class_names)]
    found = []
    for more in ([], ["--labelled", "vehicle"]):
        assert main([*arguments, *more, "--out", str(tmp_path), *CHEAP]) == 0
        found.append(json.loads((tmp_path / "compare.json").read_text())[0])
    assert {row["labels"] for row in found} == {"exact"}
    assert found[0]["total_bps"] == found[1]["total_bps"]
    assert found[0]["recall"] < found[1]["recall"], "small people are missed at this size"


@pytest.mark.parametrize("name", [name for name in METHODS if name != DDS])
def test_every_method_is_settings_that_the_edge_takes(name):
    """A method that the edge refuses would be missing from every table."""
    flags = ["--source", "demo", "--budget", "400kbps", *METHODS[name].flags]
    config, _ = load(EdgeConfig, flags, program="hvt-edge", description="")
    assert check_edge(config).budget_bps == 400_000


def test_names_of_methods():
    """A row of the comparison is a method of the study, and the plot knows how to draw it."""
    pairs = COMPARED.values()
    assert all(name in METHODS and METHODS[name].sends_stills == bool(codec) for name, codec in pairs)
    styles = {(style.colour, style.marker) for style in map(style_of, COMPARED)}
    assert len(styles) == len(COMPARED), "auto was drawn as M0-best"


def test_a_plot_of_what_there_is(tmp_path):
    """A method that is missing at some rates must not take the plot with it."""
    shown = {"named_f1": 0.9, "false_per_frame": None}
    rows = [
        {"clip": "clip", "rate_kbps": rate, "method": method, "half": half, "total_bps": rate * 990, **shown}
        for rate, method in ((150.0, "M0"), (800.0, "M0"), (800.0, "M6"))
        for half in (0, 1, 2)
    ]
    plot(CompareResult(tuple(rows), (Missing(150.0, "M6", "why"),), "exact", "clip"), tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 20_000
