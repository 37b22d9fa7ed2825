"""Stills as files, for people and programs that come after."""

from __future__ import annotations

import csv
from dataclasses import replace

import cv2
import numpy as np
import pytest

from hvt_common.errors import UserError
from hvt_ground.sinks.still_files import StillFiles
from rigs.examples import refinement

PIXELS = np.arange(12 * 20 * 3, dtype=np.uint8).reshape(12, 20, 3)
STILL = refinement(
    frame_index=11,
    still_sequence=4,
    track_id=7,
    box_base_px=(10, 10, 20, 16),
    media_type="application/x-residual",
    class_after="van",
    still_bgr=PIXELS,
    crop_base_px=(8.0, 9.0, 28.0, 21.0),
    shown_index=9,
)


def test_a_still_is_written_as_it_arrived_with_the_place_it_shows(tmp_path):
    """Whoever reads it later could not say what it is of, or would read the traces of another coding."""
    sink = StillFiles(tmp_path / "uav.csv")
    sink.log(STILL)
    sink.log(replace(STILL, track_id=None, class_after="bus"))  # it shows two objects
    sink.log(replace(STILL, still_sequence=5, still_bgr=None))  # nothing could decode it
    sink.close()
    rows = list(csv.DictReader((tmp_path / "uav.csv").read_text(encoding="utf-8").splitlines()))
    assert [(row["track"], row["class_after"]) for row in rows] == [("7", "van"), ("", "bus")]
    assert {row["file"] for row in rows} == {"uav-000004.png"}
    assert (rows[0]["frame_index"], rows[0]["known_frame_index"]) == ("9", "11")
    assert [float(rows[0][name]) for name in "xywh"] == [8, 9, 20, 12]
    assert np.array_equal(cv2.imread(str(tmp_path / "uav-000004.png")), PIXELS)
    assert len(list(tmp_path.iterdir())) == 2


def test_a_folder_that_is_gone_is_said(tmp_path):
    """The ground would end in a traceback, or write nowhere."""
    folder = tmp_path / "stills"
    folder.mkdir()
    sink = StillFiles(folder / "uav.csv")
    folder.rename(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="000004"):
        sink.log(STILL)
    sink.close()
