"""The recipe of the embedded detector, whole: pool, real pictures, training, calibration, export."""

from __future__ import annotations

import json

import pytest

from hvt_common.inference.detect import open_detector
from hvt_common.inference.runtimes.model import open_model
from hvt_scene.drawing.vehicles import CLASS_NAMES
from hvt_train.__main__ import main
from studies.real_sets import write_hit, write_yolo


@pytest.mark.realdata
@pytest.mark.nightly
def test_a_handful_of_steps_ends_in_a_calibrated_file(tmp_path, data):
    """The recipe would fail after hours of training, at its last line."""
    pytest.importorskip("torch")
    pytest.importorskip("onnx")
    real, out = tmp_path / "real", tmp_path / "out"
    cars = [(0, 100, 200, 150, 225), (1, 300, 300, 380, 330)]
    write_yolo(real / "kit_ais", {"MOS155": cars, "MunichStreet02-MOS74": cars})
    write_hit(real / "hit_uav", ["20210114", "20210119", "20210112"])
    write_yolo(real / "cats_madison", {"0_13": [(0, 100, 100, 158, 152)]})
    (real / "street").mkdir()
    start = data / "models" / "yolox_nano.onnx"
    words = ["--scenes", "1", "--places", "1", "--steps", "3", "--batch", "2", "--workers", "1"]
    assert main(["detector", "--out", str(out), "--real", str(real), "--start", str(start), *words]) == 0
    path = out / "aerial-nano.onnx"
    assert open_detector(str(path)).class_names == tuple(CLASS_NAMES)
    metadata = open_model(path).metadata
    slope, shift = map(float, metadata["hvt.calibration"].split())
    assert slope > 0
    assert -10 < shift < 10
    assert 0.1 <= float(metadata["hvt.confidence"]) <= 0.8
    assert "KIT AIS" in metadata["hvt.training_data"]
    rows = [json.loads(line) for line in (out / "aerial-nano.jsonl").read_text().splitlines()]
    assert rows[-1]["validation"] >= 0
