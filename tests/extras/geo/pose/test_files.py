"""Poses from files as people have them, and what is said of those that cannot be read."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.errors import UserError
from hvt_edge.loop.pose import open_pose
from hvt_geo.pose.files import read_poses

SECOND_NS = 1_000_000_000
MINI = """1
00:00:00,000 --> 00:00:00,033
<font size="28">FrameCnt: 1, DiffTime: 33ms
2024-05-01 10:00:00.000
[iso: 100] [shutter: 1/1000.0] [fnum: 1.7] [ev: 0] [color_md: default] [focal_len: 24.00] \
[latitude: 47.376900] [longitude: 8.541700] [rel_alt: 80.100 abs_alt: 520.300] \
[gb_yaw: -12.5 gb_pitch: -45.0 gb_roll: 0.0]</font>

2
00:00:01,000 --> 00:00:01,033
[focal_len: 24.00] [latitude: 47.377000] [longitude: 8.541900] \
[rel_alt: 82.100 abs_alt: 522.300] [gb_yaw: 7.5 gb_pitch: -47.0 gb_roll: 0.0]
"""
PHANTOM = """1
00:00:01,000 --> 00:00:02,000
HOME(8.5400,47.3700) 2017.05.01 10:00:00
GPS(8.5417,47.3769,16) BAROMETER:80.1
ISO:100 Shutter:1000
"""
TABLE = "time_s,latitude_deg,longitude_deg,height_m\n0,1,2,3\n1,1,2,3\n"
PLACE = "time_s,latitude_deg,longitude_deg"
GPX = """<?xml version="1.0"?>
<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>
<trkpt lat="47.3769" lon="8.5417"><ele>520.5</ele><time>2024-05-01T10:00:00Z</time></trkpt>
<trkpt lat="47.3779" lon="8.5417"><ele>530.5</ele><time>2024-05-01T10:00:10Z</time></trkpt>
</trkseg></trk></gpx>
"""


def at(path: Path, seconds: float, *, hfov_deg: float | None = None):
    """The pose of this moment of the clip."""
    return read_poses(path, hfov_deg=hfov_deg).at(round(seconds * SECOND_NS), capture_ns=7)


def test_subtitles_of_a_drone_give_place_height_gimbal_and_zoom(tmp_path):
    """The file beside most drone clips would have to be turned into a table first."""
    file = tmp_path / "DJI_0001.SRT"
    file.write_text(MINI, encoding="utf-8")
    pose = at(file, 0.5)
    assert pose.capture_ns == 7
    assert (pose.latitude_deg, pose.longitude_deg) == pytest.approx((47.37695, 8.5418))
    assert (pose.height_m, pose.altitude_m) == pytest.approx((81.1, 521.3))
    assert pose.camera.yaw_deg == pytest.approx(357.5)  # half way from -12.5 to 7.5
    assert pose.camera.pitch_deg == pytest.approx(-46)
    assert pose.hfov_deg == pytest.approx(2 * math.degrees(math.atan(18 / 24)))
    assert pose.platform is None


@pytest.mark.parametrize(("said", "means"), [("-90.4", -90), ("-92.0", -90), ("90.1", 90)])
def test_a_gimbal_a_little_beyond_straight_down_points_straight_down(tmp_path, said, means):
    """The noise of one frame would have the whole flight refused."""
    file = tmp_path / "DJI_0001.SRT"
    file.write_text(MINI.replace("gb_pitch: -45.0", f"gb_pitch: {said}"), encoding="utf-8")
    assert at(file, 0.0).camera.pitch_deg == means


def test_subtitles_with_a_long_word_are_read_as_any_others(tmp_path):
    """A damaged file would hold the start for hours."""
    file = tmp_path / "DJI_0001.SRT"
    file.write_text(MINI.replace("[iso: 100]", "a" * 300_000), encoding="utf-8")
    assert at(file, 0.0).latitude_deg == 47.3769


def test_a_yaw_a_hair_below_north_is_north(tmp_path):
    """The ground would refuse a report of 360 degrees."""
    file = tmp_path / "north.csv"
    file.write_text(
        f"{PLACE},camera_yaw_deg,camera_pitch_deg,yaw_deg,pitch_deg\n0,1,2,-1e-17,-90,-1e-17,0\n",
        encoding="utf-8",
    )
    pose = at(file, 0.0)
    assert (pose.camera.yaw_deg, pose.platform.yaw_deg) == (0.0, 0.0)


def test_errors_of_a_centimetre_are_taken(tmp_path):
    """A receiver that is as good as that would count for no more than any other."""
    file = tmp_path / "rtk.csv"
    file.write_text(
        f"{PLACE},position_error_m,height_error_m,angle_error_deg\n0,1,2,0.01,0.02,0.05\n", encoding="utf-8"
    )
    pose = at(file, 0.0)
    assert (pose.position_error_m, pose.height_error_m, pose.angle_error_deg) == (0.01, 0.02, 0.05)


def test_subtitles_of_the_first_models_give_the_place_alone(tmp_path):
    """Longitude comes first there: the drone would be on another continent."""
    file = tmp_path / "old.srt"
    file.write_text(PHANTOM, encoding="utf-8")
    pose = at(file, 1.0, hfov_deg=70)
    assert (pose.latitude_deg, pose.longitude_deg, pose.height_m) == (47.3769, 8.5417, 80.1)
    assert pose.camera is None
    assert pose.hfov_deg == 70


def test_a_gps_track_counts_from_its_first_point(tmp_path):
    """A logger's file would be of another day than the clip."""
    file = tmp_path / "way.gpx"
    file.write_text(GPX, encoding="utf-8")
    pose = at(file, 5.0)
    assert (pose.latitude_deg, pose.altitude_m) == pytest.approx((47.3774, 525.5))
    assert pose.height_m is None  # nobody knows where the ground is


def test_a_table_says_what_its_columns_say(tmp_path):
    """A researcher's own log would have to look like somebody else's."""
    file = tmp_path / "flight.csv"
    file.write_text(
        "utc,latitude_deg,longitude_deg,height_m,yaw_deg,pitch_deg,camera_yaw_deg,camera_pitch_deg,hfov_deg,"
        "angle_error_deg\n"
        "2024-05-01T10:00:00Z,1,2,50,10,0,370,-90,60,0.5\n"
        "2024-05-01T12:00:02+02:00,1,2,60,20,0,10,-90,60,0.5\n",
        encoding="utf-8",
    )
    pose = at(file, 1.0)
    assert (pose.height_m, pose.hfov_deg, pose.angle_error_deg) == (55, 60, 0.5)
    assert pose.platform.yaw_deg == pytest.approx(15)
    assert (pose.camera.yaw_deg, pose.camera.pitch_deg) == pytest.approx((10, -90))


def test_beyond_its_ends_and_in_a_gap_a_file_says_nothing(tmp_path):
    """A camera would be shown where it was a minute ago."""
    file = tmp_path / "gap.csv"
    file.write_text("time_s,latitude_deg,longitude_deg\n1,1,2\n2,1,2\n40,1,2\n", encoding="utf-8")
    table = read_poses(file, hfov_deg=None)
    assert table.at(0, capture_ns=0) is not None
    assert table.at(20 * SECOND_NS, capture_ns=0) is None
    assert "20 s" in table.trouble
    assert table.at(42 * SECOND_NS, capture_ns=0) is None
    assert table.at(40 * SECOND_NS, capture_ns=0) is not None


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.csv", "time_s,latitude_deg,longitude\n1,2,3\n", "column 'longitude'"),
        ("a.csv", "time_s,latitude_deg\n1,2\n", "lacks the column longitude_deg"),
        ("a.csv", "latitude_deg,longitude_deg\n1,2\n", "lacks the column time_s"),
        ("a.csv", "time_s,latitude_deg,longitude_deg\n0,north,2\n", "'north', not a number"),
        ("a.csv", "time_s,latitude_deg,longitude_deg\n0,1,2\n0,1,2\n", "do not rise"),
        ("a.csv", "time_s,latitude_deg,longitude_deg\n0,95,2\n", "latitude_deg is 95"),
        ("a.csv", "utc,latitude_deg,longitude_deg\nnoon,1,2\n", "'noon' is not ISO 8601"),
        ("a.csv", "", "lacks the column"),
        ("a.srt", "nothing", "no row with a time"),
        ("a.gpx", "<gpx>", "no GPX"),
        ("a.gpx", "<!DOCTYPE x [<!ENTITY a 'b'>]><gpx/>", "document type"),
        ("a.kml", "<kml/>", "none of .csv"),
        ("a.csv", TABLE + f"2,1,2,{'3' * 200_000}\n", "is no table: field larger than"),
        ("a.csv", f"{'n' * 200_000},latitude_deg\n", "is no table: field larger than"),
        ("a.csv", f"{PLACE},position_error_m\n0,1,2,-5\n", "position_error_m is -5, accepted is 0.001 to"),
        ("a.csv", f"{PLACE},height_error_m\n0,1,2,0\n", "height_error_m is 0, accepted is 0.001 to"),
        ("a.csv", f"{PLACE},angle_error_deg\n0,1,2,-0.1\n", "angle_error_deg is -0.1, accepted is 0.001 to"),
        (
            "a.srt",
            MINI.replace("00:00:00,000 -->", f"{'9' * 400}:00:00,000 -->", 1).split("2\n00:")[0],
            "no row",
        ),
        (
            "a.srt",
            MINI.replace("00:00:00,000 -->", f"{'9' * 5000}:00:00,000 -->", 1).split("2\n00:")[0],
            "no row",
        ),
        ("a.srt", MINI.replace("00:00:01,000 -->", "9999:00:01,000 -->"), "time_s is 3.59964e"),
        (
            "a.srt",
            MINI.replace("gb_pitch: -45.0", "gb_pitch: -95.0"),
            "camera_pitch_deg is -95, accepted is -90",
        ),
    ],
)
def test_a_wrong_file_is_named_with_what_is_wrong(tmp_path, name, text, says):
    """Somebody in a field would search a log for why there is no map."""
    file = tmp_path / name
    file.write_text(text, encoding="utf-8")
    with pytest.raises(UserError, match=says) as refused:
        read_poses(file, hfov_deg=None)
    assert str(file) in str(refused.value)


@pytest.mark.parametrize(
    ("spec", "says"),
    [
        ("nowhere.csv", "nowhere.csv is no file; accepted is"),
        ("fixed:1,2,3", "not five numbers"),
        ("fixed:1,2,x,4,5", "not five numbers"),
        ("fixed:91,2,3,4,5", "latitude 91"),
        ("fixed:1,2,3,4,95", "tilt 95"),
        ("mavlink:nonsense:x", "no address: give mavlink:udpin:HOST:PORT"),
        ("x" * 5000, "xx is no file .File name too long.; accepted is"),
        ("fixed:" + "9" * 5000, "not five numbers"),
        ("mavlink:udpin:14550", "names no HOST:PORT"),
        ("mavlink:udpin:127.0.0.1:99999", "has the port 99999, accepted is 1 to 65535"),
        ("mavlink:udpin:127.0.0.1:0", "has the port 0, accepted is 1 to 65535"),
        ("mavlink:udpin:127.0.0.1:\uff11\uff12", "names no HOST:PORT"),
        (f"mavlink:tcp:{'ä' * 70}:14550", "cannot be opened: this is no name of a host"),
        (f"mavlink:udpin:{'ä' * 70}:14550", "cannot be opened: this is no name of a host"),
        ("mavlink:udpin:a\0b:14550", "names no HOST:PORT"),
        ("mavlink:tcp:127.0.0.1:99999", "has the port 99999, accepted is 1 to 65535"),
        ("mavlink:/dev/null", "cannot be opened"),
        ("mavlink:/dev/ttyACM0,fast", "has the baud rate 'fast', accepted is 50 to 4000000"),
        ("mavlink:/dev/ttyACM0," + "9" * 5000, "accepted is 50 to 4000000"),
    ],
)
def test_what_is_no_pose_is_refused_in_a_sentence(spec, says):
    """A flight would begin, and its map stay empty."""
    with pytest.raises(UserError, match=says):
        open_pose(spec, hfov_deg=None, clock=lambda: 0)


def test_a_fixed_camera_is_where_it_was_put():
    """North and height would be mixed up."""
    north = open_pose("fixed:1,2,3,-1e-17,-30", hfov_deg=80, clock=lambda: 0).at(0, capture_ns=5)
    assert north.camera.yaw_deg == 0.0
    pose = open_pose("fixed:52.5,13.4,12,-90,-30", hfov_deg=80, clock=lambda: 0).at(0, capture_ns=5)
    assert pose is not None
    assert (pose.latitude_deg, pose.longitude_deg, pose.height_m, pose.hfov_deg) == (52.5, 13.4, 12, 80)
    assert (pose.camera.yaw_deg, pose.camera.pitch_deg, pose.capture_ns) == (270, -30, 5)


@settings(max_examples=150, deadline=None)
@given(st.sampled_from([".csv", ".srt", ".gpx"]), st.data())
def test_any_text_is_poses_or_a_sentence(tmp_path_factory, suffix, data):
    """A damaged file would end in a traceback."""
    text = {".csv": TABLE, ".srt": MINI, ".gpx": GPX}[suffix]
    at_char = data.draw(st.integers(0, len(text)))
    length = data.draw(st.integers(0, 12))
    text = text[:at_char] + data.draw(st.text(max_size=12)) + text[at_char + length :]
    file = tmp_path_factory.mktemp("any") / f"any{suffix}"
    file.write_text(text, encoding="utf-8", errors="replace")
    try:
        pose = at(file, 0.5)
    except UserError:
        return
    assert pose is None or abs(pose.latitude_deg) <= 90
