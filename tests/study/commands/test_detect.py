"""``hvt-study detect``: files, figures and sheets of a detector over labelled pictures."""

import csv
import json
from collections import Counter
from functools import cache
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from hvt_common.values import Image
from hvt_scene import Scene
from hvt_scene.truth import Truth
from hvt_study.cli import main
from hvt_study.commands.detect import print_score
from hvt_study.datasets.label_files import read_image
from hvt_study.metrics.picture_score import along_line, calibration_error, chance_error, fitted_line
from programs.small_disk import files_at_most

CLASSES = "car,van,truck,bus,motor,pedestrian,other"


@cache
def scene() -> Scene:
    """To paint it takes seconds."""
    return Scene(5, size=(1280, 720))


@cache
def moment(t_s: float) -> tuple[Image, Truth]:
    return scene().image(t_s), scene().truth(t_s)


def draw(folder: Path, *, moments: int = 2) -> Path:
    """A YOLO folder of drawn pictures, 1280x720, with the truth of what is at least half visible."""
    (folder / "images").mkdir(parents=True)
    (folder / "labels").mkdir()
    for number in range(moments):
        picture, truth = moment(1.0 + number)
        cv2.imwrite(str(folder / f"images/{number}.png"), picture)
        boxes = truth.boxes_source_px.clip(0, (1280, 720, 1280, 720)) / (1280, 720, 1280, 720)
        rows = [
            f"{kind} {(x1 + x2) / 2:.6f} {(y1 + y2) / 2:.6f} {x2 - x1:.6f} {y2 - y1:.6f}\n"
            for kind, (x1, y1, x2, y2), seen in zip(truth.class_ids, boxes, truth.visible, strict=True)
            if seen >= 0.5 and x2 > x1 and y2 > y1
        ]
        (folder / f"labels/{number}.txt").write_text("".join(rows))
    (folder / "classes.txt").write_text("\n".join(Scene.class_names) + "\n")
    return folder


def sentence(capsys, *arguments):
    """The last line on stderr of a call that must end with exit code 2."""
    assert main(["detect", *map(str, arguments), "--provider", "cpu"]) == 2
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err
    return captured.err.splitlines()[-1]


def test_figures_files_and_sheets(tmp_path, capsys, monkeypatch):
    """The embedded detector on the scene it knows: found, scored, shown; an unreadable picture costs only itself."""
    folder, out = draw(tmp_path / "set"), tmp_path / "out"
    read = Mock(wraps=read_image)
    monkeypatch.setattr("hvt_study.commands.detect.read_image", read)
    (folder / "images" / "broken.png").write_bytes(b"no picture")
    assert main(["detect", str(folder), "--provider", "cpu", "--vehicles-as-one", "--out", str(out)]) == 0
    said = capsys.readouterr().err
    assert "broken.png cannot be read as a picture; skipped" in said
    assert "1 of 3 pictures skipped" in said
    score = json.loads((out / "score.json").read_text())
    vehicle = score["by_class"]["vehicle"]
    assert score["pictures"] == 2
    assert vehicle["recall"] > 0.8
    assert vehicle["precision"] > 0.7
    assert 0 <= score["calibration_error"] <= 1
    with (out / "detections.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["file", "x1", "y1", "x2", "y2", "confidence", "class"]
    assert sum(Path(row["file"]).name == "0.png" for row in rows) > 5
    assert all(float(row["confidence"]) >= 0.25 and float(row["x2"]) <= 1280 for row in rows)
    assert score["boxes"] == sum(row["class"] in CLASSES.split(",") for row in rows)
    sheets = [
        cv2.imread(str(out / name)) for name in ("false-alarms.png", "misses.png") if (out / name).exists()
    ]
    assert sheets
    assert all(sheet is not None and sheet.shape[1] == 8 * 150 for sheet in sheets)
    assert max(Counter(call.args[0] for call in read.call_args_list).values()) <= 3, (
        "to detect, and for each sheet"
    )


def test_classes_that_a_set_does_not_label_count_neither_way(tmp_path):
    """Minsk and Madison label no people: whoever sees them there is not wrong."""
    folder = draw(tmp_path / "set", moments=1)
    for path in (folder / "labels").glob("*.txt"):
        path.write_text("".join(line for line in path.read_text().splitlines(True) if line[0] in "0123"))
    run = ["detect", str(folder), "--provider", "cpu", "--labelled", "vehicle", "--vehicles-as-one"]
    assert main([*run, "--out", str(tmp_path / "out")]) == 0
    assert list(json.loads((tmp_path / "out/score.json").read_text())["by_class"]) == ["vehicle"]


def test_coco_and_yolo_say_the_same(tmp_path):
    """One set in two formats has one score."""
    folder = draw(tmp_path / "set", moments=1)
    names, wide, high = list(Scene.class_names), 1280, 720
    annotations = []
    for line in (folder / "labels/0.txt").read_text().splitlines():
        kind, cx, cy, w, h = map(float, line.split())
        box = [(cx - w / 2) * wide, (cy - h / 2) * high, w * wide, h * high]
        annotations.append({"image_id": 7, "category_id": int(kind) + 1, "bbox": box})
    kinds = [{"id": number + 1, "name": name} for number, name in enumerate(names)]
    coco = {"images": [{"id": 7, "file_name": "0.png"}], "categories": kinds, "annotations": annotations}
    (folder / "coco.json").write_text(json.dumps(coco))
    scores = []
    for place in (folder, folder / "coco.json"):
        assert main(["detect", str(place), "--provider", "cpu", "--out", str(tmp_path / place.name)]) == 0
        scores.append(json.loads((tmp_path / place.name / "score.json").read_text()))
    assert scores[0] == scores[1]


def write_sequence(folder: Path, *, frames: int, targets: int) -> Path:
    """Write a MOTChallenge sequence of the drawn scene that labels the ``targets`` largest cars, and nothing else."""
    (folder / "img1").mkdir(parents=True)
    (folder / "gt").mkdir()
    chosen, rows = None, []
    for number in range(1, frames + 1):
        picture, truth = moment(1.0 + number / 15)
        cv2.imwrite(str(folder / f"img1/{number:06d}.png"), picture)
        if chosen is None:
            inside = (truth.visible > 0.95) & (truth.class_ids == 0)
            centres = (truth.boxes_source_px[:, :2] + truth.boxes_source_px[:, 2:]) / 2
            middle = np.abs(centres - (640, 360)).max(1)
            chosen = [index for index in np.argsort(middle) if inside[index]][:targets]
            chosen = truth.ids[chosen].tolist()
        for target in chosen:
            x1, y1, x2, y2 = truth.boxes_source_px[truth.ids.tolist().index(target)]
            box = f"{x1 + 1:.1f},{y1 + 1:.1f},{x2 - x1:.1f},{y2 - y1:.1f}"
            rows.append(f"{number},{target + 1},{box},1,1,1\n")
    (folder / "gt/gt.txt").write_text("".join(rows))
    (folder / "gt/labels.txt").write_text("car\n")
    return folder


def test_one_labelled_target_is_found_or_missed_and_no_more(tmp_path, capsys):
    """Whoever sees the other cars of UAV123 is not wrong: its labels name one of them."""
    folder, out = write_sequence(tmp_path / "s", frames=2, targets=1), tmp_path / "out"
    run = ["detect", str(folder), "--provider", "cpu", "--vehicles-as-one", "--out", str(out)]
    assert main(run) == 0
    score = json.loads((out / "score.json").read_text())
    assert score["recall_only"]
    assert (score["labels"], score["recall"]) == (2, 1.0)
    assert (score["precision"], score["f1"], score["ap50"], score["boxes"]) == (None,) * 4
    assert list(score["by_class"]) == ["vehicle"]
    assert not (out / "false-alarms.png").exists()
    assert "recall alone can be said" in capsys.readouterr().out
    blind = (out / "../blind").resolve()
    assert main([*run[:-1], str(blind), "--confidence", "1"]) == 0
    assert json.loads((blind / "score.json").read_text())["recall"] == 0
    assert (blind / "misses.png").exists()
    both = write_sequence(tmp_path / "two", frames=2, targets=2)
    assert main(["detect", str(both), "--provider", "cpu", "--out", str(tmp_path / "o")]) == 0
    assert json.loads((tmp_path / "o/score.json").read_text())["precision"] is not None


def test_what_cannot_be_is_said_before_anything_is_written(tmp_path, capsys):
    """No folder, no pictures, no names."""
    out, there, folder = tmp_path / "out", tmp_path / "there", draw(tmp_path / "set", moments=1)
    (tmp_path / "empty").mkdir()
    (folder / "classes.txt").unlink()
    for name, text in (("bad.json", "[]"), ("deep.json", "[" * 100_000), ("file", "")):
        (tmp_path / name).write_text(text)
    (there / "score.json").mkdir(parents=True)
    for words, said in (
        ((tmp_path / "none",), "does not exist"),
        ((tmp_path / "empty",), "holds no pictures"),
        ((folder,), "no classes.txt, obj.names or data.yaml"),
        ((folder, "--confidence", 2), "--confidence is 2.0, must be from 0.01 to 1"),
        *(((tmp_path / name,), "is not COCO's JSON") for name in ("bad.json", "deep.json")),
        ((folder, "--classes", CLASSES, "--out", tmp_path / "file"), "file cannot be made (File exists)"),
        ((folder, "--classes", CLASSES, "--out", there), "score.json is a folder"),
    ):
        assert said in sentence(capsys, "--out", out, *words)
    assert not out.exists()


def test_a_full_disk_is_one_sentence(tmp_path, capsys):
    """An hour of detections ended in a traceback, or in a sheet that nobody missed."""
    folder, out = draw(tmp_path / "set", moments=1), tmp_path / "out"
    for limit in (10, 20_000):  # of the table, and of the sheets
        with files_at_most(limit):
            said = sentence(capsys, folder, "--out", out)
        assert said == f"hvt-study: --out {out} cannot be written (File too large): name another"
    assert json.loads((out / "score.json").read_text())["pictures"] == 1


def test_a_name_with_brackets_is_shown_as_it_is(capsys):
    """The hour's score ended in a traceback, or under a name that no file has."""
    figures = dict.fromkeys(("labels", "boxes", "precision", "recall", "f1", "ap50", "calibration_error"))
    print_score({**figures, "detector": "[/a] [b].onnx", "confidence": 0.25, "by_class": {"[/c]": figures}})
    said = capsys.readouterr().out
    assert "[/a] [b].onnx at confidence 0.25" in said
    assert "[/c]" in said


def test_calibration_error_of_known_confidences():
    """Hand-made: bins that are right as often as they say have no error."""
    sure = np.array([0.75] * 4 + [0.25] * 4)
    right = np.array([1, 1, 1, 0, 1, 0, 0, 0], bool)
    assert calibration_error(sure, right) == pytest.approx(0)
    assert calibration_error(sure, ~right) == pytest.approx(0.5)
    assert np.isnan(calibration_error(sure[:0], right[:0]))


def test_the_line_of_the_others_is_what_makes_their_scores_true():
    """Whether a calibration holds beyond its own sets could not be told."""
    sure = np.repeat([0.2, 0.5, 0.8], 1000)
    right = np.concatenate([np.arange(1000) < share for share in (59, 500, 941)])  # slope 2: twice as sure
    slope, shift = fitted_line(sure, right)
    assert (slope, shift) == (pytest.approx(2, abs=0.01), pytest.approx(0, abs=0.01))
    assert calibration_error(along_line(sure, (slope, shift)), right) < 0.01 < calibration_error(sure, right)
    assert along_line(sure, fitted_line(sure, sure > 0)).min() > 0.99, "all are right"
    assert chance_error(sure) < 0.02 < chance_error(sure[::100]), "thirty boxes tell little"


def test_of_several_sets_each_is_measured_with_the_line_of_the_others(tmp_path, capsys):
    """A figure of all sets together hides the one that is off."""
    sets = [draw(tmp_path / name, moments=1) for name in "ab"]
    assert main(["detect", *map(str, sets), "--out", str(tmp_path / "out"), "--provider", "cpu"]) == 0
    cells = (line.split() for line in capsys.readouterr().out.splitlines())
    rows = {one[1]: one[3::2] for one in cells if len(one) > 1 and one[1] in "ab"}
    assert rows["a"] == rows["b"], "both hold the same picture"
    assert len(rows["a"]) == 4, "boxes, error, error with the line of the other, error by chance"


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("--threads", "0", "--threads 0 is not accepted: give a whole number from 1"),
        ("--labelled", "dog", "--labelled dog is none of the labels' classes: car, van"),
    ],
)
def test_what_would_count_nothing_is_refused(tmp_path, capsys, option, value, said):
    """A table of dashes would be taken for the detector's."""
    for folder in ("images", "labels"):
        (tmp_path / folder).mkdir()
    cv2.imwrite(str(tmp_path / "images/a.png"), np.zeros((64, 64, 3), np.uint8))
    (tmp_path / "labels/a.txt").write_text("0 .5 .5 .2 .2\n")
    (tmp_path / "classes.txt").write_text("car\nvan\n")
    assert said in sentence(capsys, tmp_path, "--out", tmp_path / "out", option, value)
