"""A detector whose model fails in flight."""

from __future__ import annotations

import logging

import numpy as np

from hvt_common.inference.detect import open_detector
from hvt_common.inference.retried import RetriedDetector
from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS
from media.onnx_models import failing_in_the_light

DARK, BRIGHT = np.full((192, 320, 3), 20, np.uint8), np.full((192, 320, 3), 250, np.uint8)


def test_a_model_whose_run_raises_is_opened_again_with_growing_pauses(tmp_path, caplog):
    """The flight would end with the model; or each frame wait for it to be opened in vain."""
    path = failing_in_the_light(tmp_path / "model.onnx")
    opened, now_ns = [], [0]
    failures = Failures(lambda: now_ns[0])

    def open_one():
        opened.append(now_ns[0] // SECOND_NS)
        return open_detector(str(path))

    detector = RetriedDetector(open_one, "detector", failures, clock=lambda: now_ns[0])
    assert detector.detect(DARK) is not None
    for second in range(1, 21):
        now_ns[0] = second * SECOND_NS
        assert detector.detect(BRIGHT) is None
    assert opened == [0, 2, 4, 8, 16]
    (failed,) = failures.parts
    assert failed.part == "detector"
    assert failed.count == 5
    assert not failed.working
    now_ns[0] = 40 * SECOND_NS
    assert detector.detect(DARK) is not None
    assert failures.parts[0].working
    said = [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(said) <= 2, "said once"
    assert detector.detect(BRIGHT) is None
    path.unlink()
    now_ns[0] = 80 * SECOND_NS
    assert detector.detect(DARK) is None
    assert "model.onnx" in failures.parts[0].reason, "it cannot be opened either"


def test_a_file_with_other_classes_is_not_taken_in_flight(tmp_path):
    """Put in place of one that failed, it gave its numbers the names that the flight had begun with."""
    path, now_ns = failing_in_the_light(tmp_path / "model.onnx"), [0]
    failures = Failures(lambda: now_ns[0])
    (tmp_path / "names.txt").write_text("red\ngreen\nblue\n")

    def open_one():
        return open_detector(str(path), labels=tmp_path / "names.txt")

    detector = RetriedDetector(open_one, "detector", failures, clock=lambda: now_ns[0])
    assert detector.detect(BRIGHT) is None
    (tmp_path / "names.txt").write_text("blue\ngreen\nred\n")
    now_ns[0] = 10 * SECOND_NS
    assert detector.detect(DARK) is None
    assert (
        failures.parts[0].reason
        == "the detector is another now, with other class names: a new start takes it"
    )
    assert detector.class_names == ("red", "green", "blue")
    (tmp_path / "names.txt").write_text("red\ngreen\nblue\n")
    now_ns[0] = 100 * SECOND_NS
    assert detector.detect(DARK) is not None
