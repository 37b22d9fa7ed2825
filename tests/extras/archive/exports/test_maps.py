"""Exports for maps: they open elsewhere, and say where things were."""

import csv
import json
import math
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import geojson
import numpy as np
import pyarrow.parquet as pq
import pytest
import rasterio
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from mcap.reader import make_reader
from rasterio.transform import from_origin

import hvt_ground.cli
from hvt_common.geodesy import metres_per_degree
from hvt_common.units import SECOND_NS
from hvt_common.values import Orientation, Pose, View
from hvt_gateways.mcap.file import _location
from hvt_geo.camera import places_of_boxes
from hvt_ground.events import Overlay, PoseUpdate, VideoSample
from hvt_ground.sinks.rerun.recorder import Recorder
from media.recorded_feed import START_NS, STEP_NS, coded, drawn_frames, session
from programs import rrd
from programs.rrd import Recording
from rigs import examples

pytestmark = pytest.mark.filterwarnings(
    "ignore:Use `@` matmul:PendingDeprecationWarning"
)  # of rasterio's own

FRAMES, SIZE, TRACKS = 60, (320, 192), 6
VIEW = View.fitted(SIZE, SIZE, fit="letterbox")
KML = "{http://www.opengis.net/kml/2.2}"
GX = "{http://www.google.com/kml/ext/2.2}"


def pose_at(frame: int, *, start_deg: float = 8.5, speed_mps: float = 8.0) -> Pose:
    """Eastwards, 60 m above the ground, looking down."""
    east_deg = start_deg + speed_mps * frame / 15 / metres_per_degree(47.0)[1]
    return Pose(
        START_NS + frame * STEP_NS,
        47.0,
        (east_deg + 180) % 360 - 180,
        height_m=60.0,
        altitude_m=460.0,
        camera=Orientation(0, -90, 0),
        hfov_deg=70.0,
        position_error_m=0.5,
        height_error_m=0.5,
        angle_error_deg=0.2,
    )


def recorded(path: Path, **way: float) -> Path:
    """As the ground writes it, with a pose a second."""
    drawn = drawn_frames(FRAMES, SIZE)
    with Recorder(rrd.settings(path)) as recorder:
        for event, _ in session(drawn, coded(drawn, kbps=300, keyint=20), tracks=TRACKS, total_kbps=500):
            if isinstance(event, Overlay):
                frame = event.frame_index
                places = places_of_boxes(pose_at(frame, **way), event.boxes_base_px, view=VIEW)
                recorder.log(replace(event, places=places))
                if frame % 15 == 0:
                    recorder.log(PoseUpdate(frame, event.capture_ns, pose_at(frame, **way), VIEW))
            else:
                recorder.log(event)
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    """At 8 m/s."""
    return recorded(tmp_path_factory.mktemp("flight") / "flight.rrd")


@pytest.fixture(scope="module")
def crossing(tmp_path_factory) -> Path:
    """The same over the antimeridian, after 2 of 4 seconds."""
    start_deg = 180 - 2 * 8.0 / metres_per_degree(47.0)[1]
    return recorded(tmp_path_factory.mktemp("crossing") / "flight.rrd", start_deg=start_deg + 2e-6)


@pytest.fixture(scope="module")
def hovering(tmp_path_factory) -> Path:
    """There too: the third track trembles from one side to the other, by less than its error."""
    return recorded(tmp_path_factory.mktemp("hovering") / "flight.rrd", start_deg=180.00002, speed_mps=0.0)


@pytest.fixture(scope="module")
def bare(tmp_path_factory) -> Path:
    """A flight without a pose."""
    drawn = drawn_frames(20, SIZE)
    events = session(drawn, coded(drawn, kbps=300), tracks=2, total_kbps=500)
    return rrd.recorded(tmp_path_factory.mktemp("bare") / "flight.rrd", (event for event, _ in events))


def export(recording: Path, out: Path) -> Path:
    assert hvt_ground.cli.main(["export", str(recording), "--out", str(out)]) == 0
    return out


def test_the_recording_has_a_map_and_opens_with_it(recording, bare):
    """A viewer would have a tab that is empty, or none where there is something to show."""
    read = Recording(recording)
    assert len(read.rows("/map/camera", "GeoPoints:positions")) == 4
    points = read.rows("/map/tracks", "GeoPoints:positions")
    assert 3 <= len(points) <= 5
    assert all(len(row[2]) == TRACKS for row in points)
    assert read.rows("/map/tracks", "track_id")[0][2] == list(range(1, TRACKS + 1))
    without = Recording(bare)
    assert without.rows("/map/tracks", "GeoPoints:positions") == []


def test_geojson_is_read_by_its_library_and_places_are_right(recording, tmp_path):
    """QGIS would show nothing, or things in the sea: longitude comes first."""
    found = geojson.loads(export(recording, tmp_path / "map.geojson").read_text(encoding="utf-8"))
    assert found.is_valid, found.errors()
    camera, *tracks = found["features"]
    assert camera["properties"]["kind"] == "camera"
    assert camera["geometry"]["type"] == "LineString"
    assert camera["geometry"]["coordinates"][0] == pytest.approx([8.5, 47.0])
    assert camera["properties"]["height_m"] == [60.0] * 4
    assert sorted(one["properties"]["id"] for one in tracks) == list(range(1, TRACKS + 1))
    for one in tracks:
        spots = one["geometry"]["coordinates"]
        assert one["geometry"]["type"] == "LineString"  # 8 m/s is more than their error
        assert spots[0] == pytest.approx([8.5, 47.0], abs=2e-3)
        assert 0 < one["properties"]["error_minor_m"] <= one["properties"]["error_m"] < 20
    utc = camera["properties"]["utc"][0]
    assert utc.startswith("2026-09-21T")


def test_kml_is_placemarks_with_times_and_ellipses(recording, tmp_path):
    """Google Earth would refuse it, or have no slider."""
    root = ET.fromstring(export(recording, tmp_path / "map.kml").read_text(encoding="utf-8"))
    marks = root.findall(f".//{KML}Placemark")
    assert len(marks) == 1 + TRACKS
    for mark in marks:
        (way,) = mark.findall(f".//{GX}Track")
        assert len(way.findall(f"{KML}when")) == len(way.findall(f"{GX}coord")) >= 3
    ring = marks[1].find(f".//{KML}Polygon//{KML}coordinates")
    assert ring is not None
    corners = np.array([[float(v) for v in one.split(",")] for one in (ring.text or "").split()])
    assert corners[0] == pytest.approx(corners[-1])
    assert (np.ptp(corners, axis=0) > 0).all()


def test_kml_of_what_stands_still_has_its_time_and_the_order_of_the_schema(hovering, tmp_path):
    """The slider would not hide what came later, and a reader that checks the schema refuse the file."""
    root = ET.fromstring(export(hovering, tmp_path / "map.kml").read_text(encoding="utf-8"))
    marks = [one for one in root.findall(f".//{KML}Placemark") if one.find(f".//{KML}Point") is not None]
    assert len(marks) >= 1
    for mark in marks:
        begin, end = (mark.findtext(f"{KML}TimeSpan/{KML}{name}") or "" for name in ("begin", "end"))
        assert begin.startswith("2026-09-21T")
        assert begin < end
        tags = [one.tag.removeprefix(KML) for one in mark]
        assert tags == ["name", "TimeSpan", "Style", "ExtendedData", "MultiGeometry"]
        style = mark.find(f"{KML}Style")
        assert style is not None
        assert [one.tag.removeprefix(KML) for one in style] == ["IconStyle", "LineStyle", "PolyStyle"]


def test_what_stands_still_at_the_antimeridian_did_not_move(hovering, tmp_path):
    """It would be drawn as a way around the earth."""
    _, *tracks = geojson.loads(export(hovering, tmp_path / "m.geojson").read_text(encoding="utf-8"))[
        "features"
    ]
    assert {one["geometry"]["type"] for one in tracks} == {"Point"}
    assert {one["geometry"]["coordinates"][0] > 0 for one in tracks} == {True, False}
    rings = ET.parse(export(hovering, tmp_path / "m.kml")).findall(f".//{KML}LinearRing/{KML}coordinates")
    sides = [{place[0] == "-" for place in (one.text or "").split()} for one in rings]
    assert sides, "none has an outline"
    assert all(len(one) == 1 for one in sides), "one across it, which is drawn around the earth"


def test_ways_over_the_antimeridian_are_in_parts(crossing, tmp_path):
    """QGIS would draw the flight around the earth."""
    text = export(crossing, tmp_path / "m.geojson").read_text(encoding="utf-8")
    found = geojson.loads(text)
    assert found.is_valid, found.errors()
    camera, *tracks = found["features"]
    assert len(camera["geometry"]["coordinates"]) == 2
    west, east = camera["geometry"]["coordinates"]
    assert (west[-1][0], east[0][0]) == (180.0, -180.0)
    assert west[-1][1] == east[0][1] == pytest.approx(47.0)
    assert len(camera["properties"]["utc"]) == len(camera["properties"]["height_m"]) == len(west) + len(east)
    assert camera["properties"]["utc"] == sorted(camera["properties"]["utc"])
    assert {one["geometry"]["type"] for one in tracks} >= {"MultiLineString"}
    for one in (camera, *tracks):
        parts = one["geometry"]["coordinates"]
        for part in parts if one["geometry"]["type"] == "MultiLineString" else [parts]:
            assert np.ptp(np.array(part)[:, 0]) < 1


@pytest.mark.parametrize("set_back_s", [30, 3600])
def test_a_clock_that_was_set_back_breaks_no_way(tmp_path, set_back_s):
    """The camera's way led back from its end to its beginning, and the tracks' ways ended there."""
    path = tmp_path / "flight.rrd"
    with Recorder(rrd.settings(path)) as recorder:
        for frame, (unit, _) in enumerate(coded(drawn_frames(FRAMES, SIZE), kbps=100, keyint=FRAMES)):
            capture_ns = START_NS + frame * STEP_NS - (frame >= 30) * set_back_s * SECOND_NS
            pose = replace(pose_at(frame), capture_ns=capture_ns)
            if frame % 15 == 0:
                recorder.log(PoseUpdate(frame, capture_ns, pose, VIEW))
            recorder.log(VideoSample(frame, capture_ns, unit, keyframe=frame == 0))
            recorder.log(examples.overlay(frame, [9 + frame, 9, 50 + frame, 60], capture_ns=capture_ns))
    camera, track = json.loads(export(path, tmp_path / "m.geojson").read_text(encoding="utf-8"))["features"]
    for one in (camera, track):
        way = [place[0] for place in one["geometry"]["coordinates"]]
        assert (len(way), way) == (4, sorted(way))
    assert track["properties"]["first_utc"] < track["properties"]["last_utc"]


def test_an_export_with_the_wrong_terrain_says_so(recording, tmp_path, caplog):
    """The file would have no tracks, and nobody know why."""
    model = tmp_path / "elsewhere.tif"
    with rasterio.open(
        *(model, "w"),
        driver="GTiff",
        width=50,
        height=50,
        count=1,
        dtype="float32",
        crs="EPSG:4326",
        transform=from_origin(20.0, 10.0, 0.001, 0.001),
    ) as file:
        file.write(np.zeros((50, 50), np.float32), 1)
    out = tmp_path / "m.geojson"
    words = ["export", str(recording), "--out", str(out), "--terrain", str(model)]
    assert hvt_ground.cli.main(words) == 0
    assert [one["properties"]["kind"] for one in geojson.loads(out.read_text())["features"]] == ["camera"]
    assert f"--terrain {model} has no ground below flight.rrd at 47.0" in caplog.text


def test_tables_have_places_between_two_poses(recording, tmp_path):
    """Three rows of four would have no place, or one of another second."""
    with export(recording, tmp_path / "t.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    placed = [row for row in rows if row["latitude"]]
    assert len(placed) == len(rows)
    first = [row for row in rows if row["id"] == "1"]
    for row in first[:45]:
        box = np.array([[float(row[name]) for name in "xywh"]], np.float32)
        box[:, 2:] += box[:, :2]
        truth = places_of_boxes(pose_at(int(row["frame_index"])), box, view=VIEW)
        assert truth is not None
        assert [float(row["latitude"]), float(row["longitude"])] == pytest.approx(
            truth.places_deg[0].tolist(), abs=2e-6
        )
    table = pq.read_table(export(recording, tmp_path / "t.parquet"))
    assert table["latitude"].null_count == 0
    assert table["error_m"].to_pylist()[0] == pytest.approx(float(rows[0]["error_m"]))


def test_mcap_has_the_cameras_place(recording, tmp_path):
    """Foxglove's map panel would stay empty; three metres would be known of a height that nobody says."""
    with export(recording, tmp_path / "f.mcap").open("rb") as file:
        found = [one.data for _, _, one in make_reader(file).iter_messages(topics=["/uav-1/location"])]
    fixes = [LocationFix.FromString(one) for one in found]
    assert [round(one.latitude, 4) for one in fixes] == [47.0] * 4
    assert fixes[0].altitude == pytest.approx(460.0)
    fix = _location(replace(pose_at(0), altitude_m=None))
    known = [math.isfinite(one) for one in (fix.altitude, *fix.position_covariance[::4])]
    assert known == [False, True, True, False]


def test_without_a_pose_it_says_what_is_missing(bare, tmp_path, capsys):
    """An empty map would be taken for an empty field, and a zero be a place in the Gulf of Guinea."""
    for kind in ("geojson", "kml"):
        assert hvt_ground.cli.main(["export", str(bare), "--out", str(tmp_path / f"m.{kind}")]) == 2
        assert "has no pose: give hvt-edge --pose" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    with export(bare, tmp_path / "t.csv").open(encoding="utf-8") as file:
        assert {row["latitude"] for row in csv.DictReader(file)} == {""}
    assert pq.read_table(export(bare, tmp_path / "t.parquet"))["latitude"].null_count > 0
