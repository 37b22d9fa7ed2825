"""A detector whose model fails in flight."""

import logging

import numpy as np
import pytest

from hvt_common.inference.detect import open_detector
from hvt_common.inference.retried import RetriedDetector
from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS
from media.onnx_models import failing_in_the_light
from rigs.examples import Clock

DARK, BRIGHT = np.full((192, 320, 3), 20, np.uint8), np.full((192, 320, 3), 250, np.uint8)


@pytest.fixture
def retried(tmp_path):
    """A model that fails in the light, its file and its clock: ``retried(opening)`` opens it."""
    path, clock = failing_in_the_light(tmp_path / "model.onnx"), Clock(0)
    failures = Failures(clock)
    return path, clock, failures, lambda opening: RetriedDetector(opening, "detector", failures, clock=clock)


def test_a_model_whose_run_raises_is_opened_again_with_growing_pauses(retried, caplog):
    """One picture that a runtime cannot take would end the flight, or a broken model take the whole processor."""
    path, clock, failures, opened_by = retried
    opened = []

    def open_one():
        opened.append(clock.now_ns // SECOND_NS)
        return open_detector(str(path))

    detector = opened_by(open_one)
    assert detector.detect(DARK) is not None
    for second in range(1, 21):
        clock.now_ns = second * SECOND_NS
        assert detector.detect(BRIGHT) is None
    assert opened == [0, 2, 4, 8, 16]
    (failed,) = failures.parts
    assert (failed.part, failed.count, failed.working) == ("detector", 5, False)
    clock.now_ns = 40 * SECOND_NS
    assert detector.detect(DARK) is not None
    assert failures.parts[0].working
    assert sum(record.levelno >= logging.WARNING for record in caplog.records) <= 2, "said once"
    assert detector.detect(BRIGHT) is None
    path.unlink()
    clock.now_ns = 80 * SECOND_NS
    assert detector.detect(DARK) is None
    assert "model.onnx" in failures.parts[0].reason, "it cannot be opened either"


def test_a_file_with_other_classes_is_not_taken_in_flight(retried, tmp_path):
    """The numbers of one model would be read as the names of another."""
    path, clock, failures, opened_by = retried
    names = tmp_path / "names.txt"
    names.write_text("red\ngreen\nblue\n")
    detector = opened_by(lambda: open_detector(str(path), labels=names))
    assert detector.detect(BRIGHT) is None
    names.write_text("blue\ngreen\nred\n")
    clock.now_ns = 10 * SECOND_NS
    assert detector.detect(DARK) is None
    said = "the detector is another now, with other class names: a new start takes it"
    assert failures.parts[0].reason == said
    assert detector.class_names == ("red", "green", "blue")
    names.write_text("red\ngreen\nblue\n")
    clock.now_ns = 100 * SECOND_NS
    assert detector.detect(DARK) is not None
