"""``hvt-study read`` as a user runs it."""

import json

import cv2
import pytest

from hvt_study.cli import main
from programs.refusal import checked

CHEAP = ("--size", "640x360", "--max-frames", "30")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("clip.mp4",), "'clip.mp4' is unknown"),
        (("demo:0",), "demo:0 has nothing to read"),
        (("demo:0,letters",), "'0,letters'"),
        (("demo:codes", "--rates", "fast"), "'fast'"),
        (("demo:codes", "--methods", "M0,M9"), "'M9'"),
        (("demo:codes", "--max-frames", "3"), "--max-frames 3"),
        (("demo:codes", "--size", "13x7"), "13x7"),
        (("demo:codes", "--detector", "no-such.onnx"), "no-such.onnx"),
    ],
)
def test_what_cannot_be_read_is_one_sentence(tmp_path, capsys, arguments, said):
    """Nobody waits for minutes to learn of a slip of the pen."""
    assert main(["read", arguments[0], "--out", str(tmp_path), *CHEAP, *arguments[1:]]) == 2
    assert said in checked(capsys.readouterr().err, program="hvt-study", left=[*tmp_path.iterdir()])


@pytest.mark.nightly
def test_reading_end_to_end(tmp_path, capsys):
    """What is a still for? The answer must be the same twice and at equal bits, and no still may hide the base."""
    pytest.importorskip("rapidocr", reason="rapidocr is not installed: hvt[reading]")
    arguments = ["read", "demo:codes", "--methods", "source,M0,M5-jpeg", "--rates", "300"]
    assert main([*arguments, "--out", str(tmp_path / "first"), *CHEAP]) == 0
    rows = json.loads((tmp_path / "first" / "read.json").read_text())
    assert [row["method"] for row in rows] == ["source", "M0", "M5-jpeg"]
    source, video, hybrid = rows
    assert source["base"]["read"] > 0.9
    assert abs(video["total_bps"] / hybrid["total_bps"] - 1) <= 0.01
    assert (video["roi_bps"], video["stills"]["read"]) == (0, 0.0)
    assert hybrid["roi_bps"] > 0
    assert hybrid["codes"] == len(hybrid["scenes"][0]["codes"]) > 20
    for row in rows[1:]:
        least = max(row["base"]["read"], row["stills"]["read"])
        assert least <= row["composite"]["read"] < source["base"]["read"]
    known = {code["object"]: code["text"] for code in source["scenes"][0]["codes"]}
    for code in hybrid["scenes"][0]["codes"]:
        for channel in ("base", "stills", "composite"):
            reading = code[channel]
            if reading and reading["read_s"] is not None:
                assert reading["text"] == known[code["object"]]
                assert reading["read_s"] > 0
    assert cv2.imread(str(tmp_path / "first" / "read.png")).shape[1] > 800
    assert "codes, read by rapidocr" in capsys.readouterr().out
    # Again, out of the cache and with nothing in it.
    assert main([*arguments, "--out", str(tmp_path / "first"), *CHEAP]) == 0
    assert json.loads((tmp_path / "first" / "read.json").read_text()) == rows
    again = ["read", "demo:codes", "--methods", "M5-jpeg", "--rates", "300"]
    assert main([*again, "--out", str(tmp_path / "second"), *CHEAP]) == 0
    assert json.loads((tmp_path / "second" / "read.json").read_text()) == [hybrid]
