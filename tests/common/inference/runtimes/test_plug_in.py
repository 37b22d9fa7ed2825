"""Detectors that other packages install: found by name, checked, and what is wrong with one is said in a sentence."""

import json
from functools import partial

import cv2
import numpy as np
import pytest

from hvt_common.errors import UserError
from hvt_common.inference.detect import open_detector, warm_up
from hvt_common.inference.labels import uncalibrated
from hvt_common.inference.tiles import tiled
from hvt_models.command import main as models
from hvt_study.cli import main as study
from media.third_party import BLOBS

MADE = """
import numpy as np
from hvt_common.values import Detections

class Made:
    class_names = {names}
    def detect(self, image_bgr):
        return {answer}
"""
GOOD = "Detections(np.array([[-5, 2, 900, 9], [3, 3, 8, 8]], 'f4'), np.array([0.3, 0.6], 'f4'), np.array([0, 1]))"


@pytest.fixture
def installed(packages):
    return partial(packages, group="hvt.detectors")


@pytest.fixture
def blobs(installed):
    installed({"acme-blobs": "BlobDetector"}, module="acme_blobs", source=BLOBS)


def picture():
    """Two bright squares, 20 and 40 pixels wide, on grey."""
    image = np.full((120, 200, 3), 60, np.uint8)
    image[10:30, 10:30] = image[50:90, 100:140] = 250
    return image


@pytest.mark.usefixtures("blobs")
def test_another_runtime_finds_what_is_there(tmp_path):
    """Whoever has an accelerator of his own could not use it; or labels or tiles would change nothing."""
    detector = open_detector("acme-blobs", confidence=0.5)
    warm_up(detector, (64, 64))
    found = detector.detect(picture())
    assert [detector.class_names[kind] for kind in found.class_ids] == ["person", "vehicle"]
    assert np.array_equal(found.boxes_xyxy_px, np.array([[10, 10, 30, 30], [100, 50, 140, 90]], np.float32))
    assert len(open_detector("acme-blobs", confidence=0.9).detect(picture())) == 0
    assert open_detector("acme-blobs:small,large").class_names == ("small", "large")
    assert tiled(detector, "auto") is detector
    with pytest.raises(
        UserError, match="tiles 2x2 need an ONNX network; motion, plug-ins and ensembles take"
    ):
        tiled(detector, "2x2")
    with pytest.raises(UserError, match="has no effect: 'acme-blobs' is no network of one file"):
        open_detector("acme-blobs", labels=tmp_path / "names.txt")
    engine = "acme-blobs:/opt/one.engine"
    assert f"detector {engine} has no" in uncalibrated("detector", engine)


def test_answers_are_clipped_sorted_and_those_below_the_confidence_left_out(installed):
    """A box beside the picture would reach the tracker, the cropper and the wire."""
    installed({"acme": "Made"}, module="acme_made", source=MADE.format(names=("a", "b"), answer=GOOD))
    found = open_detector("acme", confidence=0.1).detect(np.zeros((40, 50, 3), np.uint8))
    assert found.boxes_xyxy_px.tolist() == [[3, 3, 8, 8], [0, 2, 50, 9]]
    assert found.confidences.tolist() == pytest.approx([0.6, 0.3])
    assert found.class_ids.dtype == np.int32
    assert len(open_detector("acme", confidence=0.5).detect(np.zeros((40, 50, 3), np.uint8))) == 1


@pytest.mark.parametrize(
    ("names", "answer", "says"),
    [
        ("('a',)", "1 / 0", "does not work: ZeroDivisionError"),
        ("None", GOOD, "its class_names are None, and have to be words"),
        ("['a\\ud800']", GOOD, "and have to be words"),
        ("('a',)", "[]", "detect gave list, and has to give Detections"),
        ("('a',)", GOOD, "class ids that are no whole numbers from 0 to 0"),
        ("('a', 'b')", GOOD.replace("0.3", "3"), "confidences outside 0…1"),
        ("('a', 'b')", GOOD.replace("-5", "np.nan"), "boxes that are not finite"),
        ("('a', 'b')", GOOD.replace("[0.3, 0.6]", "[0.3]"), r"arrays of \(2, 4\), \(1,\) and \(2,\)"),
    ],
)
def test_a_broken_plug_in_is_named(installed, names, answer, says):
    """A wrong build of a runtime would fail in flight, in a traceback of somebody else."""
    installed({"acme": "Made"}, module="acme_made", source=MADE.format(names=names, answer=answer))
    with pytest.raises(UserError, match=rf"detector 'acme' of package acme_made .*{says}"):
        open_detector("acme")


def test_a_name_that_is_built_in_is_refused(installed):
    """What --detector aerial-nano is would depend on what else is installed."""
    installed({"aerial-nano": "BlobDetector"}, module="acme_blobs", source=BLOBS)
    with pytest.raises(
        UserError, match=r"'aerial-nano' is built in, and package acme_blobs .* brings another"
    ):
        open_detector("aerial-nano")


@pytest.mark.usefixtures("blobs")
def test_it_is_listed_and_scored(tmp_path, capsys):
    """Nobody could say how good the runtime's network is on his pictures, nor see that HVT has found it."""
    assert models(["list"]) == 0
    assert "acme-blobs" in capsys.readouterr().out
    (tmp_path / "set" / "images").mkdir(parents=True)
    (tmp_path / "set" / "labels").mkdir()
    cv2.imwrite(str(tmp_path / "set/images/0.png"), picture())
    (tmp_path / "set/labels/0.txt").write_text("0 0.1 0.16666667 0.1 0.16666667\n")
    (tmp_path / "set/classes.txt").write_text("person\nvehicle\n")
    run = [
        *("detect", str(tmp_path / "set"), "--detector", "acme-blobs", "--size", "200x120"),
        *("--provider", "cpu"),
    ]
    assert study([*run, "--out", str(tmp_path / "out")]) == 0
    score = json.loads((tmp_path / "out/score.json").read_text())
    assert score["by_class"]["person"]["recall"] == score["by_class"]["person"]["precision"] == 1
    assert score["by_class"]["vehicle"]["labels"] == 0


@pytest.mark.usefixtures("blobs")
def test_a_study_says_that_it_takes_files_alone(tmp_path, capsys):
    """Results of one build of a runtime would be taken from the cache for another's."""
    assert study(["run", "demo:0", "--detector", "acme-blobs", "--out", str(tmp_path / "out")]) == 2
    assert "detector 'acme-blobs' is a plug-in" in capsys.readouterr().err
