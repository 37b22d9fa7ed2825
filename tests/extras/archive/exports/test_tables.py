"""The tables of tracks and stills, for people and programs that come after."""

import csv
import errno
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from hvt_archive.exports.tables import StillFiles, TrackTable
from hvt_common.errors import UserError
from rigs.examples import overlay, refinement
from rigs.messages import PLAIN

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
    header=replace(PLAIN, frame_index=9),
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
    (tmp_path / "stills").mkdir()
    sink = StillFiles(tmp_path / "stills" / "uav.csv")
    (tmp_path / "stills").rename(tmp_path / "elsewhere")
    with closing(sink), pytest.raises(UserError, match="000004"):
        sink.log(STILL)


def test_a_disk_without_room_leaves_no_half_of_a_picture(tmp_path, monkeypatch):
    """It would lie beside the table, in which it is not, and open in no program."""

    def full(path: Path, data: bytes) -> int:
        with path.open("wb") as file:
            file.write(data[:9])
        raise OSError(errno.ENOSPC, "No space left on device")

    sink = StillFiles(tmp_path / "uav.csv")
    monkeypatch.setattr(Path, "write_bytes", full)
    with closing(sink), pytest.raises(UserError, match="000004"):
        sink.log(STILL)
    assert [one.name for one in tmp_path.iterdir()] == ["uav.csv"]


@pytest.mark.parametrize(("origins", "expected"), [((), ["base", "base"]), (("edge+base", "still"),) * 2])
def test_each_line_says_who_knows_of_the_track(tmp_path, origins, expected):
    """A program could not leave out what only the edge reports, or count what it brings."""
    path = tmp_path / "tracks.csv"
    table = TrackTable(path)
    one = overlay(
        4,
        [[1, 2, 11, 22], [5, 5, 6, 7]],
        capture_ns=1_700_000_000_123_456_789,
        track_ids=np.array([3, 9]),
        base_classes=("car", "van"),
        classes=("car", "bus"),
        confidences=np.array([0.5, 0.75], np.float32),
        refined=np.array([False, True]),
        origins=origins,
    )
    table.log(one)
    table.log(replace(one, frame_index=2, stored=True))  # of an outage, behind its time
    table.close()
    every = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
    assert {row["capture_utc"] for row in every} == {"2023-11-14T22:13:20.123Z"}
    assert [(row["frame_index"], row["late"]) for row in every] == [("4", "0")] * 2 + [("2", "1")] * 2
    rows = every[:2]
    assert [row["origin"] for row in rows] == list(expected)
    seen = [[row[name] for name in ("id", "class", "refined")] for row in rows]
    assert seen == [["3", "car", "0"], ["9", "bus", "1"]]


@pytest.mark.parametrize(
    ("name", "cell"),
    [
        ('=HYPERLINK("x")', '\'=HYPERLINK("x")'),
        ("@SUM(1)", "'@SUM(1)"),
        ("-1+1", "'-1+1"),
        ("+-x", "'+-x"),
        (" \uff1d1+1", "' \uff1d1+1"),
    ],
)
def test_a_class_that_a_spreadsheet_would_compute_is_text(tmp_path, name, cell):
    """Names come from the wire: who opens the table would run what somebody on the link wrote."""
    path = tmp_path / "tracks.csv"
    table = TrackTable(path)
    table.log(overlay(4, [[-9, 2, 11, 22]], base_classes=(name,), classes=("car - old",)))
    table.close()
    (row,) = csv.DictReader(path.read_text(encoding="utf-8").splitlines())
    assert (row["x"], row["base_class"], row["class"]) == ("-9.0", cell, "car - old")
