"""The table of tracks for programs that come after."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest

from hvt_ground.sinks.tracks_table import TrackTable
from rigs.examples import overlay


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
    assert [(row["frame_index"], row["late"]) for row in every] == [
        ("4", "0"),
        ("4", "0"),
        ("2", "1"),
        ("2", "1"),
    ]
    rows = every[:2]
    assert [row["origin"] for row in rows] == list(expected)
    assert [(row["frame_index"], row["id"], row["class"], row["refined"]) for row in rows] == [
        ("4", "3", "car", "0"),
        ("4", "9", "bus", "1"),
    ]
