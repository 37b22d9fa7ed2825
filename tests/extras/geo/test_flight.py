"""A flight with a pose: budget, map and places as the drawn scene has them."""

import csv

import numpy as np
import pytest

from programs.processes import Link
from programs.rrd import Recording
from rigs.drawn_flight import FPS, fly, off_m

pytestmark = pytest.mark.integration


def test_the_pose_is_part_of_the_budget_and_of_both_accounts(drawn):
    """It would be bytes that nobody counts, and a thin link would overflow."""
    edge, ground = drawn.edge, drawn.ground
    assert edge["meta_bytes"] == ground["meta_bytes"]
    assert edge["worst_window_bps"] == ground["worst_window_bps"]
    assert edge["worst_window_bps"]["total"] <= 800_000


def test_tracks_are_placed_where_the_scene_has_them(drawn):
    """The map would be nonsense, and everything else green."""
    rows = [row for row in drawn.tracks() if int(row["frame_index"]) >= FPS]
    each = {*sorted({row["frame_index"] for row in rows}, key=int)[::3]}
    found = [
        (off, off <= float(row["error_m"]))
        for row in rows
        if row["frame_index"] in each and row["latitude"] and (off := off_m(row)) is not None
    ]
    assert len(found) > 150
    assert np.percentile([off for off, _ in found], 95) < 3.0
    assert np.mean([inside for _, inside in found]) >= 0.95


def test_the_recording_shows_camera_and_tracks_on_a_map(drawn):
    """Who opens it would have numbers in a table and no picture."""
    recording = Recording(drawn.folder / "flight.rrd")
    assert len(recording.rows("/map/camera", "GeoPoints:positions")) >= 2
    assert recording.rows("/map/tracks", "GeoPoints:positions")


@pytest.mark.nightly
def test_a_pose_that_ends_is_said_to_be_stale_and_places_nothing_more(tmp_path):
    """Tracks would be put where the camera was ten seconds ago."""
    (tmp_path / "short.csv").write_text(
        "time_s,latitude_deg,longitude_deg,height_m,camera_yaw_deg,camera_pitch_deg,hfov_deg\n"
        "0,52,13,150,0,-90,45\n0.5,52,13,150,0,-90,45\n",
        encoding="utf-8",
    )
    settings = ("--pose", "short.csv", "--max-frames", "195", "--size", "320x180", "--pace", "lockstep")
    with Link(tmp_path) as link:
        edge, *_ = fly(link, edge=settings)
    (part,) = edge["failed"]
    assert part["part"] == "pose"
    events = [text for _, _, text in Recording(tmp_path / "flight.rrd").events()]
    assert any("the pose is stale" in text for text in events)
    with (tmp_path / "flight.csv").open(encoding="utf-8") as file:
        placed = {int(row["frame_index"]) for row in csv.DictReader(file) if row["latitude"]}
    assert min(placed) >= 0
    assert max(placed) < 12 * FPS
