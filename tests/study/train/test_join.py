"""The two networks of the embedded detector in one file."""

from __future__ import annotations

import numpy as np
import pytest

from hvt_common.inference.heads.choose import anchor_count
from hvt_common.inference.runtimes.model import open_model
from hvt_common.inference.store import EMBEDDED_CLASSIFIER, EMBEDDED_DETECTOR, embedded_models
from hvt_train.__main__ import main

DETECTOR, CLASSIFIER = (embedded_models()[name] for name in (EMBEDDED_DETECTOR, EMBEDDED_CLASSIFIER))


@pytest.mark.realdata
def test_the_embedded_file_is_made_of_its_parts(data, tmp_path):
    """Who trains the aerial part again could not make the file that is embedded."""
    out = tmp_path / "joined.onnx"
    assert main(["join", str(DETECTOR), str(data / "models" / "yolox_nano.onnx"), "--out", str(out)]) == 0
    assert out.read_bytes() == DETECTOR.read_bytes()
    assert [one.name for one in tmp_path.iterdir()] == ["joined.onnx"]


@pytest.mark.parametrize("size", [(32, 32), (64, 96), (416, 416), (672, 384)])
def test_both_parts_give_one_row_a_cell_for_every_size(size):
    """A row too few, and boxes of the second part would stand in the wrong places."""
    ours, theirs = anchor_count(size, (8, 16, 32)), anchor_count(size, (12, 24, 48))
    rows = _rows(np.random.default_rng(1).integers(0, 255, (1, 3, *size[::-1])))
    assert rows.shape == (ours + theirs, 12)
    assert np.isfinite(rows).all()


def test_the_second_part_is_silent_without_colour():
    """In thermal pictures it sees people who are not there."""
    colour = np.random.default_rng(1).integers(0, 255, (1, 3, 96, 96))
    grey = np.repeat(colour[:, :1], 3, axis=1)
    first = anchor_count((96, 96), (8, 16, 32))
    assert _rows(colour)[first:, 4].max() > 0
    assert _rows(grey)[first:, 4].max() == 0
    assert _rows(grey)[:first, 4].max() > 0


def test_what_is_no_part_is_refused(tmp_path, capsys):
    """Half an hour later a detector would find nothing, and nobody would know why."""
    out = tmp_path / "out.onnx"
    for aerial, street, sentence in (
        (CLASSIFIER, DETECTOR, "a detector of hvt_train is expected"),
        (DETECTOR, CLASSIFIER, "has 0 levels of box, objectness and classes; YOLOX-nano has 3"),
        (DETECTOR, tmp_path / "none.onnx", "none.onnx"),
    ):
        assert main(["join", str(aerial), str(street), "--out", str(out)]) == 2
        said = capsys.readouterr().err
        assert sentence in said
        assert said.count("\n") == 1
    assert not out.exists()


def _rows(feed):
    return open_model(DETECTOR).run(feed.astype(np.float32))[0][0]
