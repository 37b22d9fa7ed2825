"""From where a detector's scores count, and whether they are probabilities, stands in its file."""

from __future__ import annotations

import pytest

from hvt_common.errors import UserError
from hvt_common.inference.labels import default_confidence, is_calibrated, uncalibrated
from media.onnx_models import colour_detector


def test_a_detector_brings_its_own_threshold(tmp_path):
    """Every user would have to know that these weights want .4."""
    path = colour_detector(tmp_path / "d.onnx", "yolox", metadata={"hvt.confidence": "0.4"})
    assert default_confidence(str(path)) == 0.4
    assert default_confidence(str(colour_detector(tmp_path / "e.onnx", "yolox"))) == 0.25
    assert default_confidence("motion") == 0.25


@pytest.mark.parametrize("text", ["high", "0", "1.5", "nan", ""])
def test_a_threshold_that_makes_no_sense_is_refused(tmp_path, text):
    """Everything, or nothing, would be an object."""
    path = colour_detector(tmp_path / "d.onnx", "yolox", metadata={"hvt.confidence": text})
    with pytest.raises(
        UserError, match=r"d\.onnx has hvt\.confidence .* a number from 0\.01 to 1 is accepted"
    ):
        default_confidence(str(path))


def test_a_model_says_whether_its_scores_are_probabilities(tmp_path):
    """A check mark would stand for nothing."""
    plain = colour_detector(tmp_path / "d.onnx", "yolox")
    fitted = colour_detector(tmp_path / "e.onnx", "yolox", metadata={"hvt.calibration": "1.6 0.3"})
    assert not is_calibrated(str(plain), role="detector")
    assert is_calibrated(str(fitted), role="detector")
    assert is_calibrated("aerial-nano", role="detector")
    assert not is_calibrated("motion", role="detector")
    assert "detector d.onnx has no calibration" in uncalibrated("detector", str(plain))
