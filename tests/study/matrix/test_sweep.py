"""``hvt-study sweep``: the pilot's selector table."""

import csv
from pathlib import Path

import pytest

from hvt_study.cli import main
from hvt_study.commands.sweep import read_csv

# 640x480 frames: 0.015 of the area is 4608 px², 0.020 is 6144.
DETECTIONS = """frame,x1,y1,x2,y2,conf,class
0,0,0,50,50,0.90,car
0,100,100,150,150,0.45,truck
0,200,200,205,205,0.80,car
0,300,300,400,400,0.30,dog
5,0,0,75,75,0.60,bus
10,0,0,10,40,0.26,person
"""
POLICIES = ("permissive", "conf_size_top1", "strict_small_only", "balanced_top2")


def rows_of(folder: Path) -> dict[str, dict[str, str]]:
    with (folder / "sweep.csv").open() as file:
        reader = csv.DictReader(file)
        assert reader.fieldnames == ["policy", "selected", "ratio", "frame_coverage"]
        return {row["policy"]: row for row in reader}


def test_known_answer(tmp_path, capsys):
    """The paper's selector table must come out of detections that are not ours."""
    source = tmp_path / "detections.csv"
    source.write_text(DETECTIONS)
    assert main(["sweep", str(source), "--size", "640x480", "--out", str(tmp_path / "out")]) == 0
    rows = rows_of(tmp_path / "out")
    # permissive: 3 of frame 0, one each of 5 and 10. Top 1: the 5 px box and the person are too small in a side.
    # strict: the car of 0 (small), and on frame 5 the bus, which is small below 0.020.
    selected = {name: int(row["selected"]) for name, row in rows.items()}
    assert selected == dict(zip(POLICIES, (5, 2, 2, 3), strict=True))
    assert float(rows["permissive"]["ratio"]) == pytest.approx(5 / 6)
    assert float(rows["permissive"]["frame_coverage"]) == 1.0
    assert float(rows["balanced_top2"]["frame_coverage"]) == pytest.approx(2 / 3)
    assert "6 raw detections on 3 frames" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("frame,x1,y1\n0,1,2\n", "has no column x2, y2, conf, class"),
        (DETECTIONS.partition("\n")[0], "has no raw detections"),
        *((DETECTIONS + f"7,0,0,{x},9,0.5,car\n", "not below 1e+09") for x in ("nan", "1e300")),
        (DETECTIONS + "7,0,0,x,9,0.5,car\n", "line 8"),
        (DETECTIONS + "7,0,0,9,9,50,car\n", "line 8 has corners that are exchanged, or a conf that is not"),
        (DETECTIONS + "7,9,0,0,9,0.5,car\n", "line 8 has corners that are exchanged"),
        (DETECTIONS + "7,0,0,9,9,0.5,2\n", "or no name of a class"),
        (DETECTIONS.partition("\n")[0] + "\n0,.1,.1,.2,.2,.5,car\n", "has boxes of 0 to 1"),
        (
            DETECTIONS + "7,700,0,900,9,.5,car\n",
            "1 of 7 boxes outside its pictures of 640x480: say their size",
        ),
        (DETECTIONS + "7,0\n", "line 8"),
        (DETECTIONS + f"7,0,0,9,9,0.5,{'x' * 200_000}\n", "cannot be read (field larger than field limit"),
    ],
)
def test_a_wrong_file_is_one_sentence(tmp_path, capsys, text, said):
    """A table that was exported wrongly must be named with its line."""
    source = tmp_path / "detections.csv"
    source.write_text(text)
    assert main(["sweep", str(source), "--size", "640x480"]) == 2
    assert said in capsys.readouterr().err
    assert main(["sweep", str(source)]) == 2
    assert "--size is missing" in capsys.readouterr().err


def test_numbers_stay_as_they_are_written(tmp_path):
    """A side of 11.999999999999998 is below the limit of 12 in every other program; the selectors must agree."""
    source = tmp_path / "detections.csv"
    head = DETECTIONS.partition("\n")[0]
    source.write_text(f"{head}\n0,8.4,8.4,20.4,20.4,0.9,car\n1,100,100,112,112,0.9,car\n")
    assert 20.4 - 8.4 < 12
    assert main(["sweep", str(source), "--size", "1280x720", "--out", str(tmp_path)]) == 0
    assert [int(row["selected"]) for row in rows_of(tmp_path).values()] == [2, 1, 1, 1]


def test_a_table_of_a_spreadsheet_keeps_its_order(tmp_path):
    """Some write a byte order mark before the first name; ties are broken by the order of the file."""
    source = tmp_path / "detections.csv"
    source.write_text(DETECTIONS, encoding="utf-8-sig")
    found = read_csv(source, (640, 480))
    assert (len(found), found[0].class_names) == (3, ("car", "truck", "car", "dog"))


@pytest.mark.parametrize(
    "words",
    [("--confidence", "0.5"), ("--nms-iou", "0.5"), ("--detect-every", "5"), ("--detector", "aerial-nano")],
)
def test_what_has_no_say_is_refused(tmp_path, capsys, words):
    """Who asks for confident detections alone must not get a table of all."""
    source = tmp_path / "detections.csv"
    source.write_text(DETECTIONS)
    assert main(["sweep", str(source), "--size", "640x480", *words]) == 2
    assert f"{words[0]} has no effect on {source}" in capsys.readouterr().err
    assert main(["sweep", str(tmp_path / "a.mp4"), "--detector", "aerial-nano", "--size", "640x480"]) == 2
    assert "--size has no effect" in capsys.readouterr().err


@pytest.mark.realdata
def test_a_clip_through_a_detector(data, tmp_path):
    """The researcher's first command on a clip of their own."""
    clip, model = data / "clips" / "drone_carpark.mp4", data / "models" / "yolov5su_visdrone_640.onnx"
    arguments = [
        "sweep",
        str(clip),
        "--detector",
        str(model),
        "--detect-every",
        "120",
        "--out",
        str(tmp_path),
    ]
    assert main(arguments) == 0
    rows = rows_of(tmp_path)
    assert int(rows["permissive"]["selected"]) == 3 * 3  # 351 frames, every 120th, full of cars
    assert all(float(row["frame_coverage"]) == 1.0 for row in rows.values())
    assert main([*arguments[:2], "--out", str(tmp_path)]) == 2
