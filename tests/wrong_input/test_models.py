"""Models and labels that are not what their flag wants, on both sides."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def program(refused, pictures, free_port):
    """Refuse settings of either program, on top of a run that would otherwise work."""
    common = {
        "hvt-edge": ["--source", pictures, "--size", "96x64", "--connect", f"tcp/127.0.0.1:{free_port}"],
        "hvt-ground": ["--listen", f"tcp/127.0.0.1:{free_port}", "--once", "--wait", "1s"],
    }

    def program(name: str, *settings: str) -> str:
        return refused(name, *common[name], *settings)

    return program


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "flag"), [("hvt-edge", "detector"), ("hvt-ground", "detector"), ("hvt-ground", "classifier")]
)
@pytest.mark.parametrize("file", ["missing.onnx", "garbage.onnx", "cut.onnx", "empty.onnx", "folder.onnx"])
def test_a_file_that_is_no_model(program, data, here, name, flag, file):
    """The network runtime's own error says nothing that a user can mend."""
    whole = (data / "models/yolox_nano.onnx").read_bytes()
    Path("garbage.onnx").write_bytes(b"\xff\x00garbage" * 500)
    Path("cut.onnx").write_bytes(whole[: len(whole) // 2])
    Path("empty.onnx").touch()
    Path("folder.onnx").mkdir()
    assert file in program(name, f"--{flag}", file)


@pytest.mark.realdata
@pytest.mark.parametrize("name", ["hvt-edge", "hvt-ground"])
def test_a_classifier_for_a_detector(program, data, name):
    """It would run, and find nothing, for the whole flight."""
    sentence = program(name, "--detector", str(data / "models/mobilenet_v2_imagenet.onnx"))
    assert "mobilenet_v2_imagenet.onnx is not a detector" in sentence
    assert "accepted" in sentence


@pytest.mark.realdata
def test_a_detector_for_a_classifier(program, data):
    """It would run, and give every track a class of nonsense."""
    sentence = program("hvt-ground", "--classifier", str(data / "models/yolox_nano.onnx"))
    assert "yolox_nano.onnx is not a classifier" in sentence
    assert "accepted" in sentence


@pytest.mark.realdata
@pytest.mark.parametrize(
    "file", ["missing.txt", "binary.txt", "empty.txt", "three.txt", "gap.txt", "folder.txt"]
)
@pytest.mark.parametrize(
    ("name", "model_flag", "model", "flag"),
    [
        ("hvt-edge", "--detector", "yolox_nano", "--labels"),
        ("hvt-ground", "--detector", "yolox_nano", "--detector-labels"),
        ("hvt-ground", "--classifier", "mobilenet_v2_imagenet", "--labels"),
    ],
)
def test_labels_that_do_not_fit(program, data, here, name, model_flag, model, flag, file):
    """Cars would be called kites: every name off by some."""
    Path("binary.txt").write_bytes(bytes(range(128, 256)))
    Path("empty.txt").touch()
    Path("three.txt").write_text("car\nbus\nvan\n")
    Path("gap.txt").write_text("car\n\nvan\n")
    Path("folder.txt").mkdir()
    sentence = program(name, model_flag, str(data / f"models/{model}.onnx"), flag, file)
    assert file in sentence
    assert "class" in sentence or "name" in sentence


def test_labels_without_a_classifier(program, here):
    """The names would silently not count."""
    Path("names.txt").write_text("car\n")
    sentence = program("hvt-ground", "--labels", "names.txt")
    assert "--labels names.txt names a classifier's classes" in sentence
    assert "--classifier" in sentence


def test_redetection_without_a_detector(program):
    """No track would ever be refined."""
    sentence = program("hvt-ground", "--detector", "motion", "--classifier", "detector")
    assert "--classifier detector" in sentence
    assert "--detector" in sentence
