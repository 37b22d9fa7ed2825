"""Models and labels that are not what their flag wants, on both sides."""

from pathlib import Path

import pytest

from media.onnx_models import colour_classifier, colour_detector


@pytest.fixture
def program(refused, pictures, free_port):
    """Refuse settings of either program, on top of a run that would otherwise work."""
    common = {
        "hvt-edge": ["--source", pictures, "--size", "96x64", "--connect", f"tcp/127.0.0.1:{free_port}"],
        "hvt-ground": ["--listen", f"tcp/127.0.0.1:{free_port}", "--once", "--wait", "60s"],
    }

    def program(name, *settings):
        return refused(name, *common[name], *settings)

    return program


@pytest.mark.parametrize(
    ("name", "model", "labels"),
    [
        ("hvt-edge", "detector", "labels"),
        ("hvt-ground", "detector", "detector-labels"),
        ("hvt-ground", "classifier", "labels"),
    ],
)
def test_labels_that_do_not_fit(program, here, name, model, labels):
    """Cars would be called kites: every name off by some."""
    path = Path("m.onnx")
    file = colour_classifier(path) if model == "classifier" else colour_detector(path, "yolox")
    Path("two.txt").write_text("car\nbus\n")
    assert "two.txt has 2 class names" in program(name, f"--{model}", str(file), f"--{labels}", "two.txt")


def test_a_classifier_or_labels_that_need_another_setting(program, here):
    """Names would be taken and never used; stills be judged by a detector that is not there."""
    Path("names.txt").write_text("car\n")
    sentence = program("hvt-ground", "--labels", "names.txt")
    assert "--labels names.txt names a classifier's classes" in sentence
    assert "--classifier" in sentence
    sentence = program("hvt-ground", "--detector", "motion", "--classifier", "detector")
    assert "--classifier detector" in sentence
    assert "--detector" in sentence
