"""A flight with a pose: budget, map and places as the drawn scene has them."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hvt_common.geodesy import metres_per_degree
from hvt_common.values import View, iou
from hvt_scene import Scene
from programs.processes import Link
from programs.rrd import Recording

pytestmark = [pytest.mark.integration, pytest.mark.timeout(180)]

FRAMES, FPS = 75, 15
VIEW = View.fitted((1920, 1080), (1280, 720), fit="letterbox")


def fly(folder: Path, *edge: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Five seconds of the drawn scene."""
    with Link(folder) as link:
        ground = link.ground("--once", "--record", "flight.rrd", "--tracks", "tracks.csv")
        flying = link.edge(
            *("--source", "demo", "--seed", "3", "--max-frames", str(FRAMES), "--pace", "lockstep"),
            *("--budget", "800kbps", "--preset", "ultrafast", "--wait", "60s", *edge),
        )
        return flying.finish(), ground.finish(within_s=40)


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> tuple[Path, dict[str, Any], dict[str, Any]]:
    """With the scene's own pose."""
    folder = tmp_path_factory.mktemp("pose")
    return (folder, *fly(folder, "--pose", "demo"))


def test_the_pose_is_part_of_the_budget_and_of_both_accounts(flight):
    """It would be bytes that nobody counts, and a thin link would overflow."""
    _, edge, ground = flight
    assert edge["meta_bytes"] == ground["meta_bytes"]
    assert edge["worst_window_bps"] == ground["worst_window_bps"]
    assert edge["worst_window_bps"]["total"] <= 800_000


def test_tracks_are_placed_where_the_scene_has_them(flight):
    """The map would be nonsense, and everything else green."""
    folder, _, _ = flight
    scene = Scene(3)
    inside, off_m = [], []
    with (folder / "tracks.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if int(row["frame"]) > 2 * FPS]
    for frame in sorted({int(row["frame"]) for row in rows})[::5]:
        t_s = (frame - 1) / FPS
        truth, middles = scene.truth(t_s), scene.places(t_s)
        real = VIEW.to_base(truth.boxes_source_px)
        mine = [row for row in rows if int(row["frame"]) == frame]
        boxes = np.array([[float(row[name]) for name in "xywh"] for row in mine], np.float32)
        boxes[:, 2:] += boxes[:, :2]
        overlap = iou(boxes, real)
        for number, row in enumerate(mine):
            best = int(overlap[number].argmax())
            if overlap[number, best] < 0.6:
                continue
            at = np.array(scene.geographic(*middles[int(truth.ids[best])]))
            said = np.array([float(row["latitude"]), float(row["longitude"])])
            distance_m = float(np.linalg.norm((said - at) * metres_per_degree(52.0)))
            off_m.append(distance_m)
            inside.append(distance_m <= float(row["error_m"]))
    assert len(off_m) > 200
    assert np.percentile(off_m, 95) < 3.0
    assert np.mean(inside) >= 0.95


def test_the_recording_shows_camera_and_tracks_on_a_map(flight):
    """Who opens it would have numbers in a table and no picture."""
    recording = Recording(flight[0] / "flight.rrd")
    assert len(recording.rows("/map/camera", "GeoPoints:positions")) >= 4
    assert recording.rows("/map/tracks", "GeoPoints:positions")


@pytest.mark.nightly
def test_a_pose_that_ends_is_said_to_be_stale_and_places_nothing_more(tmp_path):
    """Tracks would be put where the camera was ten seconds ago."""
    (tmp_path / "short.csv").write_text(
        "time_s,latitude_deg,longitude_deg,height_m,camera_yaw_deg,camera_pitch_deg,hfov_deg\n"
        "0,52,13,150,0,-90,45\n0.5,52,13,150,0,-90,45\n",
        encoding="utf-8",
    )
    edge, _ = fly(tmp_path, "--pose", "short.csv", "--max-frames", "195", "--size", "320x180")
    (part,) = edge["failed"]
    assert part["part"] == "pose"
    events = [text for _, _, text in Recording(tmp_path / "flight.rrd").events()]
    assert any("the pose is stale" in text for text in events)
    with (tmp_path / "tracks.csv").open(encoding="utf-8") as file:
        placed = {int(row["frame"]) for row in csv.DictReader(file) if row["latitude"]}
    assert min(placed) >= 1
    assert max(placed) <= 12 * FPS
