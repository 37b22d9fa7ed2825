"""Poses from files as people have them, and what is said of those that cannot be read."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.errors import UserError
from hvt_edge.config import EdgeConfig
from hvt_edge.loop.pose import open_pose
from hvt_edge.world import World
from hvt_geo.pose.angles import compass_deg, euler_deg
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


def read(tmp_path, name, text):
    """The table, and its pose of the first moment."""
    file = tmp_path / name
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    table = read_poses(file, hfov_deg=70.0)
    return table, table.at(0, capture_ns=7)


def blocks(make, count=4):
    """Subtitles of a block a second."""
    return "".join(
        f"{n + 1}\n00:00:{n:02d},000 --> 00:00:{n + 1:02d},000\n{make(n)}\n\n" for n in range(count)
    )


POINT = '<trkpt lat="47.{:05d}" lon="9.7"><ele>{}</ele>{}</trkpt>'


def track(seconds, *, elevation="512.4"):
    """A GPS track; a second of None has no time."""
    points = "".join(
        POINT.format(50_000 + n, elevation, "" if at is None else f"<time>2026-05-01T10:00:{at:02d}Z</time>")
        for n, at in enumerate(seconds)
    )
    return f'<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{points}</trkseg></trk></gpx>'


COPIED = track([0, 1, 2, 3]).replace("</gpx>", track([0, 1, 2]).partition(">")[2])
TWO_TRACKS = COPIED.replace("47.50000", "48.50000", 1)
ERRORS = f"{PLACE},position_error_m,height_error_m,angle_error_deg\n0,1,2,0.01,0.02,0.05\n"
COLUMNS = (
    "utc,latitude_deg,longitude_deg,height_m,yaw_deg,pitch_deg,camera_yaw_deg,camera_pitch_deg,hfov_deg,angle_error_deg\n"
    "2024-05-01T10:00:00Z,1,2,50,10,0,370,-90,60,0.5\n2024-05-01T12:00:02+02:00,1,2,60,20,0,10,-90,60,0.5\n"
)
ONE_LINE = (
    "F/5.6, SS 400, ISO 100, EV 0, GPS (-3.700000, 40.400000, 15), HOME (-3.7001, 40.4001, 650.00m), D 98.70m, "
    "H 85.80m, H.S 0.00m/s, V.S 0.00m/s, F.PRY (2.7°, -7.0°, 110.1°), G.PRY (-60.0°, 0.0°, 110.4°)"
)
WINDOWS = '"Time_s" , "Latitude_deg", "Longitude_deg",yaw_deg,pitch_deg\r\n0,47,8,655.35,0\r\n'
"""In UTF-16, with quotes, spaces and capitals; 655.35 is how MAVLink says that no heading is known."""
FEET = (
    "[latitude: 47.5] [longitude: 9.7] [rel_alt: 100.0{} abs_alt: 1000{}]",
    "GPS (9.7, 47.5, 15), D 10.0ft, H 100.0ft",
)


@pytest.mark.parametrize(
    ("name", "text", "seconds", "says"),
    [
        # subtitles of a drone: the yaw half way from -12.5 to 7.5
        (
            "D.SRT",
            MINI,
            0.5,
            {"capture_ns": 7, "latitude_deg": 47.37695, "longitude_deg": 8.5418, "platform": None},
        ),
        ("D.SRT", MINI, 0.5, {"height_m": 81.1, "altitude_m": 521.3, "camera": (357.5, -46, 0)}),
        # of the first models longitude comes first: the drone would be on another continent
        ("old.srt", PHANTOM, 1, {"latitude_deg": 47.3769, "longitude_deg": 8.5417, "height_m": 80.1}),
        ("old.srt", PHANTOM, 1, {"camera": None, "hfov_deg": 70}),
        (
            "a.srt",
            blocks(lambda _: ONE_LINE),
            0,
            {"latitude_deg": 40.4, "longitude_deg": -3.7, "height_m": 85.8},
        ),
        ("a.srt", blocks(lambda _: ONE_LINE), 0, {"camera": (110.4, -60, 0), "platform": (110.1, 2.7, -7)}),
        ("a.srt", blocks(lambda _: FEET[0].format("ft", " ft")), 0, {"height_m": 30.48}),
        ("a.srt", blocks(lambda _: FEET[0].format("", "")), 0, {"height_m": 100.0}),
        ("a.srt", blocks(lambda _: FEET[1]), 0, {"height_m": 30.48}),
        # a track counts from its first point; nobody knows where the ground is
        ("way.gpx", GPX, 5, {"latitude_deg": 47.3774, "altitude_m": 525.5, "height_m": None}),
        ("way.gpx", track(range(4), elevation="68,000"), 0, {"altitude_m": 68.0}),
        ("way.gpx", track(range(4), elevation="NaN"), 0, {"altitude_m": None}),
        ("way.gpx", COPIED, 0, {"latitude_deg": 47.5}),
        ("rtk.csv", ERRORS, 0, {"position_error_m": 0.01, "height_error_m": 0.02, "angle_error_deg": 0.05}),
        ("own.csv", COLUMNS, 1, {"height_m": 55, "hfov_deg": 60, "angle_error_deg": 0.5}),
        ("own.csv", COLUMNS, 1, {"platform": (15, 0, 0), "camera": (10, -90, 0)}),
        ("win.csv", WINDOWS.encode("utf-16"), 0, {"latitude_deg": 47, "longitude_deg": 8, "platform": None}),
    ],
)
def test_each_file_says_where_the_camera_was_and_looked(tmp_path, name, text, seconds, says):
    """The file beside most clips, or one's own log, would have to be turned into a table of somebody else first."""
    table, _ = read(tmp_path, name, text)
    pose = table.at(round(seconds * SECOND_NS), capture_ns=7)
    for field, value in says.items():
        found = getattr(pose, field)
        if isinstance(value, tuple):
            found = found.yaw_deg, found.pitch_deg, found.roll_deg
        assert found == (None if value is None else pytest.approx(value)), field


@pytest.mark.parametrize(
    ("written", "instead", "pitch", "focal_mm"),
    [
        *(("-45.0", said, means, 24) for said, means in (("-90.4", -90), ("-92.0", -90), ("90.1", 90))),
        ("[iso: 100]", "a" * 300_000, -45, 24),
        *(("24.00", said, -45, mm) for said, mm in (("240] [dzoom_ratio: 10000", 24), ("480.00", 480))),
    ],
)
def test_subtitles_say_what_the_camera_sees(tmp_path, written, instead, pitch, focal_mm):
    """The noise of a frame had a flight refused, a long word held it up, a long lens saw ten times as wide."""
    (tmp_path / "a.SRT").write_text(MINI.replace(written, instead), encoding="utf-8")
    table = read_poses(tmp_path / "a.SRT", hfov_deg=None)
    pose = table.at(0, capture_ns=7)
    assert (pose.camera.pitch_deg, table.notes) == (pitch, ())
    assert pose.hfov_deg == pytest.approx(2 * math.degrees(math.atan(18 / focal_mm)))


def test_beyond_its_ends_and_in_a_gap_a_file_says_nothing(tmp_path):
    """A camera would be shown where it was a minute ago."""
    table, first = read(tmp_path, "gap.csv", f"{PLACE}\n1,1,2\n2,1,2\n40,1,2\n")
    assert first is not None
    assert table.at(20 * SECOND_NS, capture_ns=0) is None
    assert "20 s" in table.trouble
    assert table.at(42 * SECOND_NS, capture_ns=0) is None
    assert table.at(40 * SECOND_NS, capture_ns=0) is not None


@pytest.mark.parametrize(("frames", "says"), [(300, "they end at 300 s, the clip at 30 s"), (2900, "")])
def test_poses_that_go_on_after_the_clip_are_told_of(tmp_path, frames, says):
    """A whole flight's, or another's, put each object of a clip from its midst at a wrong place without a word."""
    path = tmp_path / "a.csv"
    path.write_text(f"{PLACE}\n" + "".join(f"{second},47,8\n" for second in range(0, 301, 5)))
    config = EdgeConfig(source="a.mp4", pose=str(path))
    source: Any = SimpleNamespace(frame_count=frames, fps=10.0)
    poses = World().open_pose(config, source)
    assert poses is not None
    assert says in " ".join(poses.notes)
    assert bool(poses.notes) == bool(says)


FIRST = MINI.split("2\n00:", maxsplit=1)[0]
UNREAD = "1 of its 1 blocks have a place that is not understood"


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.csv", "time_s,latitude_deg,longitude\n1,2,3\n", "column 'longitude'"),
        ("a.csv", "time_s,latitude_deg\n1,2\n", "lacks the column longitude_deg"),
        ("a.csv", "latitude_deg,longitude_deg\n1,2\n", "lacks the column time_s"),
        ("a.csv", f"{PLACE},latitude_deg\n0,47.5,9.7,48\n", "has the column 'latitude_deg' twice"),
        ("a.csv", f"{PLACE}\n0,north,2\n", "'north', not a number"),
        ("a.csv", f"{PLACE}\n0,1,2\n0,1,2\n", "do not rise"),
        ("a.csv", f"{PLACE}\n0,95,2\n", "latitude_deg is 95"),
        ("a.csv", f"{PLACE}\n0,0,47,5,9,7\n", "row 1 has more values than there are columns"),
        ("a.csv", f"{PLACE},height_m,yaw_deg\n0,47,5,9,7,,\n", "row 1 has more values"),
        ("a.csv", f"{PLACE},height_m,yaw_deg\n0,47,5,9,,\n", "row 1 has more values"),
        ("a.csv", "utc,latitude_deg,longitude_deg\n1701010112345,1,2\n", "'1701010112345' is not ISO 8601"),
        ("a.csv", "utc,latitude_deg,longitude_deg\n2026-11-23,1,2\n", "'2026-11-23' is not ISO 8601"),
        ("a.csv", "utc,latitude_deg,longitude_deg\n2026-W48-1,1,2\n", "'2026-W48-1' is not ISO 8601"),
        (
            "a.csv",
            f"{PLACE}\n0,116.2,40.1\n1,116.2,40.1\n",
            r"latitude_deg is 116\.2, .*: are latitude and longitude exch",
        ),
        ("a.csv", "utc,latitude_deg,longitude_deg\nnoon,1,2\n", "'noon' is not ISO 8601"),
        ("a.csv", "", "lacks the column"),
        ("a.srt", "nothing", "no row with a time"),
        ("a.gpx", "<gpx>", "no GPX"),
        ("a.gpx", "<!DOCTYPE x [<!ENTITY a 'b'>]><gpx/>", "document type"),
        ("a.gpx", TWO_TRACKS, "has 2 tracks or segments of the same time: keep the camera's alone"),
        ("a.gpx", TWO_TRACKS.replace("</trk><trk>", ""), "has 2 tracks or segments of the same time"),
        ("a.kml", "<kml/>", "none of .csv"),
        ("a.csv", TABLE + f"2,1,2,{'3' * 200_000}\n", "is no table: field larger than"),
        ("a.csv", f"{'n' * 200_000},latitude_deg\n", "is no table: field larger than"),
        ("a.csv", f"{PLACE},position_error_m\n0,1,2,-5\n", "position_error_m is -5, accepted is 0.001 to"),
        ("a.csv", f"{PLACE},height_error_m\n0,1,2,0\n", "height_error_m is 0, accepted is 0.001 to"),
        ("a.csv", f"{PLACE},angle_error_deg\n0,1,2,-0.1\n", "angle_error_deg is -0.1, accepted is 0.001 to"),
        ("a.srt", FIRST.replace("00:00:00,000 -->", f"{'9' * 400}:00:00,000 -->", 1), "no row"),
        ("a.srt", FIRST.replace("00:00:00,000 -->", f"{'9' * 5000}:00:00,000 -->", 1), "no row"),
        ("a.srt", "00:00:00,000 -->\nGPS(47°06'01\"N, 8°30'00\"E, 50m)\n", UNREAD),
        ("a.srt", "00:00:00,000 -->\n[latitude: 47:06:01] [longitude: 8.5]\n", UNREAD),
        ("a.srt", "00:00:00,000 -->\nGPS(n/a,n/a,0)\n", "no place, as before there is a fix"),
        ("a.srt", "00:00:00,000 -->\nGPS(47 06.5N, 8 30.1E, 50m)\n", UNREAD),
        ("a.srt", "00:00:00,000 -->\n[latitude: 47 06.5] [longitude: 8.5]\n", UNREAD),
        ("a.srt", "00:00:00,000 -->\n[latitude: 47.06.01] [longitude: 8.5]\n", UNREAD),
        ("a.srt", "00:00:00,000 -->\nGPS(33.25 Süd, 70.5 Ouest, 50)\n", UNREAD),
        ("a.srt", "00:00:00,000 -->\n[latitude: 33.25 Süd] [longitude: 70.5]\n", UNREAD),
        ("a.srt", "00:00:00,000 -->\nlatitude: 33.25°\nlongitude: 70.5 West wind\n", UNREAD),
        ("a.srt", "00:00:00,000 -->\nlatitude: 33.25 deg Süd longitude: 70.5\n\n2\n", UNREAD),
        ("a.srt", "00:00:00,000 -->\nlatitude: 33.25\nlongitude: 70.5° Ouest\n\n2\n", UNREAD),
        ("a.srt", MINI.replace("00:00:01,000 -->", "9999:00:01,000 -->"), "time_s is 3.59964e"),
        ("a.srt", MINI.replace("pitch: -45.0", "pitch: -95.0"), "camera_pitch_deg is -95, accepted is -92"),
    ],
)
def test_a_wrong_file_is_named_with_what_is_wrong(tmp_path, name, text, says):
    """Somebody in a field would search a log for why there is no map."""
    with pytest.raises(UserError, match=says) as refused:
        read(tmp_path, name, text)
    assert str(tmp_path / name) in str(refused.value)


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
        ("mavlink:/dev/null", "cannot be opened: Inappropriate ioctl"),
        ("mavlink:/dev/ttyACM0,fast", "has the baud rate 'fast', accepted is 50 to 4000000"),
        ("mavlink:/dev/ttyACM0," + "9" * 5000, "accepted is 50 to 4000000"),
    ],
)
def test_what_is_no_pose_is_refused_in_a_sentence(spec, says):
    """A flight would begin, and its map stay empty."""
    with pytest.raises(UserError, match=says) as refused:
        open_pose(spec, hfov_deg=None, clock=lambda: 0)
    assert len(str(refused.value)) < 600


def test_a_fixed_camera_is_where_it_was_put():
    """North and height would be mixed up."""
    pose = open_pose("fixed:52.5,13.4,12,-90,-30", hfov_deg=80, clock=lambda: 0).at(0, capture_ns=5)
    assert pose is not None
    assert (pose.latitude_deg, pose.longitude_deg, pose.height_m, pose.hfov_deg) == (52.5, 13.4, 12, 80)
    assert (pose.camera.yaw_deg, pose.camera.pitch_deg, pose.capture_ns) == (270, -30, 5)


@pytest.mark.parametrize(
    ("line", "place", "says"),
    [
        ("GPS(36.9000,-5.3000,0.0M) BAROMETER:20.3M", (36.9, -5.3, 20.3), "latitude, longitude, height"),
        ("GPS(40.1,116.2,69.800) BAROMETER(91.2) HOME(40.1,116.2)", (40.1, 116.2, 91.2), ""),
        ("GPS(116.2,40.1,69.800) BAROMETER(91.2)", (40.1, 116.2, 91.2), ""),
        ("GPS(36.9,-5.3,120)", (36.9, -5.3, None), "latitude, longitude, height"),
        ("GPS(8.2,47.4,16) BAROMETER:1.9", (47.4, 8.2, 1.9), "longitude, latitude, satellites"),
        ("GPS(8.2,47.4,16) Hb:1.9 Hs:0.0", (47.4, 8.2, 1.9), "longitude, latitude, satellites"),
        ("RTK(50) GPS(8.2,47.4,16) BAROMETER:20 Hb:0.0", (47.4, 8.2, 20), "longitude, latitude, satellites"),
        (
            "RTK (8.2, 47.4, 28), HOME (8.3, 47.5, 103.55m), D 75.3m, H 76.2m",
            (47.4, 8.2, 76.2),
            "longitude, latitude, satellites",
        ),
        ("GPS(8.2,47.4,n/a) BAROMETER:20 2017.01.01", (47.4, 8.2, 20), "longitude, latitude, satellites"),
        ("GPS(8.2,47.4,alt: 16.5)", (47.4, 8.2, None), "longitude, latitude, satellites"),
        ("GPS(8.2,47.4,12 satellites)", (47.4, 8.2, None), "longitude, latitude, satellites"),
        ("GPS(8.2, 47.4,12, 3D)", (47.4, 8.2, None), "longitude, latitude, satellites"),
        ("GPS(36.9,-5.3,15 m AGL)", (36.9, -5.3, None), "latitude, longitude, height"),
        ("GPS(11,5000,48,1000,16) BAROMETER:50,5", (48.1, 11.5, 50.5), "longitude, latitude, satellites"),
        ("GPS (11,5000, 48,1000, 16)", (48.1, 11.5, None), "longitude, latitude, satellites"),
        ("GPS(48,1000,11,5000,20,5M)", (48.1, 11.5, None), "latitude, longitude, height"),
        (
            "[latitude: 51.4779] [longitude: -1.5e-05] [rel_alt: 50.5 abs_alt: 9]",
            (51.4779, -1.5e-5, 50.5),
            "",
        ),
        ("latitude: 47.1 longitude: 8.5 S: 12", (47.1, 8.5, None), ""),
        ("[latitude: 47.1 W] [longitude: 8.5 W: 12] [longitude: 8.5 S]", (47.1, 8.5, None), ""),
        ("[latitude: 48,1000] [longitude: 11,5000] [rel_alt: 50,5 abs_alt: 570,2]", (48.1, 11.5, 50.5), ""),
        *(
            (f"latitude: 47.1{more} longitude: 8.5{more.replace('N', 'E')}{last}", (47.1, 8.5, None), "")
            for more, last in (
                ("", " rel_alt = 30"),
                (" deg", " iso=100"),
                ("deg", " F/2.8"),
                (" degrees", ""),
                (" degrees N", " alt 30 m"),
                (" N", " altitude 120 m"),
            )
        ),
        ("latitude: 47.1 longitude: 8.5 H 30m", (47.1, 8.5, 30), ""),
        ("latitude: 47.1 North longitude: 8.5 East\n\n2", (47.1, 8.5, None), ""),
        (
            "[latitude : -34.5] [longtitude : -58.5] [altitude: 74.7]",
            (-34.5, -58.5, None),
            "'altitude' is left out",
        ),
    ],
)
def test_each_layout_of_subtitles_is_recognised(tmp_path, line, place, says):
    """The flight would be over another continent, or two hundred metres from where it was, and nothing be said."""
    table, pose = read(tmp_path, "a.srt", blocks(lambda _: line))
    assert (pose.latitude_deg, pose.longitude_deg, pose.height_m) == pytest.approx(place)
    assert says in " ".join(table.notes)
    assert bool(says) is bool(table.notes)


def test_a_bad_block_is_left_out_and_counted(tmp_path, caplog):
    """One block that a camera has damaged would take the map of the whole flight."""
    table, _ = read(
        tmp_path, "a.srt", blocks(lambda n: f"[latitude: {95 if n == 2 else 47.5}] [longitude: 9.7]", count=6)
    )
    assert table.at(1 * SECOND_NS, capture_ns=0) is not None
    assert "1 of 6 rows are left out: " in caplog.text
    assert "latitude_deg is 95" in caplog.text


@pytest.mark.parametrize(
    ("seconds", "says"),
    [
        ([n // 2 for n in range(16)], "8 of 16 poses have the time of another"),
        ([0, 1, 2, 3, 3, 4, 5], "1 of 7 poses have the time of another"),
        ([0, 1, 2, 3, 4, 3, 4, 5], "not in order of time"),
        ([7, 6, 5, 4, 3, 2, 1, 0], "not in order of time"),
        ([0, None, 2, 3, None], "2 points have no time"),
    ],
)
def test_a_track_is_read_as_a_phone_writes_it(tmp_path, caplog, seconds, says):
    """Two points in one second would refuse the file of the whole flight."""
    table, pose = read(tmp_path, "a.gpx", track(seconds))
    assert pose is not None
    assert table.at(2 * SECOND_NS, capture_ns=0) is not None
    assert says in caplog.text


@pytest.mark.parametrize(
    "text",
    [
        "\ufefftime_s;latitude_deg;longitude_deg;height_m\r\n0,0;47,5;9,7;50,5\r\n1,0;47,5;9,7;50,5\r\n",
        "time_s;latitude_deg;longitude_deg;height_m\n0.0;47.5;9.7;50.5\n1.0;47.5;9.7;50.5\n",
        "time_s\tlatitude_deg\tlongitude_deg\theight_m\n0\t47.5\t9.7\t50.5\n",
        'time_s,latitude_deg,longitude_deg,height_m\n"0,0","47,5","9,7","50,5"\n',
        "\ufeffheight_m, longitude_deg, latitude_deg, time_s\r\n50.5, 9.7, 47.5, 0\r\n",
        ",time_s,latitude_deg,longitude_deg,height_m,\n0,0,47.5,9.7,50.5,\n1,1,47.5,9.7,50.5,\n",
        f"{PLACE},height_m,hfov_deg\n0,47.5,9.7,50.5,NaN\n1,47.5,9.7,50.5,N/A\n2,nan,null,-,None\n3,,,,\n",
        f"{PLACE},height_m,camera_yaw_deg,camera_pitch_deg\n0,47.5,9.7,50.5,0,-90.3\n",
        f"{PLACE},height_m\n0,47.5,9.7,50.5,GPS\n1,47.5,9.7,50.5,\n",
        f"utc,{PLACE},height_m\n2026-01-01T10:00:00Z,,49,9.7,8\n2026-01-01T10:00:01Z,0,47.5,9.7,50.5\n",
    ],
)
def test_a_table_is_read_as_a_spreadsheet_writes_it(tmp_path, text):
    """Half of Europe would have to convert each table by hand, and who has pandas, a gimbal or a gap as well."""
    _, pose = read(tmp_path, "a.csv", text)
    assert (pose.latitude_deg, pose.longitude_deg, pose.height_m) == pytest.approx((47.5, 9.7, 50.5))


@pytest.mark.parametrize("change", ["none", "doubled", "inside", "utf-16"])
def test_subtitles_are_told_apart_by_their_times(tmp_path, change):
    """Tools leave the empty lines out, or double them: one row was left of a flight, or its height was lost."""
    text = blocks(lambda n: f"[latitude: 47.{n}]\n[longitude: 8.5] [rel_alt: 30.0 abs_alt: 500.0]")
    text = {
        "none": text.replace("\n\n", "\n"),
        "doubled": text.replace("\n", "\r\r\n"),
        "inside": text.replace("]\n[", "]\n\n["),
    }.get(change, text)
    table, _ = read(tmp_path, "a.srt", text.encode("utf-16" if change == "utf-16" else "utf-8"))
    poses = [table.at(n * SECOND_NS, capture_ns=0) for n in range(4)]
    assert [one.latitude_deg for one in poses] == pytest.approx([47.0, 47.1, 47.2, 47.3])
    assert {one.height_m for one in poses} == {30.0}


@pytest.mark.parametrize(
    "place",
    [
        "GPS(W: 70.5, S: 33.25, 30.5m)",
        "GPS(W: -70.5, S: 33.25, 30.5m)",
        "GPS(33.25S, 70.5°W, 30)",
        "GPS(33.25 s, -70.5, 30 m, N12)",
        "GPS(33.25S 70.5W)",
        "GPS(W: 70.5, S: 33.25, ASL: 30.5m)",
        "GPS(-70.5, 33.25 S, 30)",
        "GPS(S 33.25, W70.5, 30.5m)",
        "GPS(33.25 South, 70.5 west, 30)",
        "[latitude: 33.25 South] [longitude: 70.5 w]",
        "[latitude: 33.25 S] [longitude: 70.5° W]",
    ],
)
def test_letters_say_which_number_is_which(tmp_path, place):
    """Autel's are written longitude first, with or without a sign; others' stand behind the number."""
    line = f"HOME(W: 70.4, S: 33.1) 2020-01-01\n{place}\nG.PRY (-90.0°, 0.0°, 3.0°)"
    table, pose = read(tmp_path, "a.srt", blocks(lambda _: line))
    assert (pose.latitude_deg, pose.longitude_deg) == (-33.25, -70.5)
    assert not table.notes


@pytest.mark.parametrize("ending", ["csv", "gpx"])
@pytest.mark.parametrize(
    ("first", "begins_s", "said"),
    [
        ("2026-01-01T09:59:58Z,0,0", 2, "1 of 4 rows are at 0, 0"),
        ("1980-01-06T00:00:00Z,47,8", 0, "1 of 4 poses are more than a day from the others"),
        ("2006-05-18T10:00:01Z,47,8", 0, "1 of 4 poses are more than a day from the others"),
    ],
)
def test_a_receiver_without_a_fix_moves_nothing(tmp_path, caplog, ending, first, begins_s, said):
    """Its first rows put the camera into the Gulf of Guinea, or all else 46 years behind the clip's first frame."""
    rows = [first, *(f"2026-01-01T10:00:0{n}Z,47.{n},8.5" for n in range(3))]
    points = [row.split(",") for row in rows]
    text = "utc,latitude_deg,longitude_deg\n" + "\n".join(rows)
    if ending == "gpx":
        track = "".join(f'<trkpt lat="{y}" lon="{x}"><ele/><time>{t}</time></trkpt>' for t, y, x in points)
        text = f"<gpx><trk><trkseg>{track}</trkseg></trk></gpx>"
    table, _ = read(tmp_path, f"a.{ending}", text)
    assert table.at(begins_s * SECOND_NS, capture_ns=0).latitude_deg == 47.0
    assert said in caplog.text


@pytest.mark.parametrize("place", [0, 2, 5])
def test_a_place_that_nothing_can_fly_to_is_left_out(tmp_path, caplog, place):
    """For a second the aircraft would be four thousand kilometres away, and the objects with it."""
    table, _ = read(
        tmp_path,
        "a.srt",
        blocks(lambda n: f"[latitude: {12 if n == place else 47.5}] [longitude: 9.7]", count=6),
    )
    seen = [table.at(n * SECOND_NS, capture_ns=0) for n in range(6)]
    assert {one.latitude_deg for one in seen if one} == {47.5}
    assert "1 of 6 places are far from those around them" in caplog.text


def test_subtitles_of_the_web_count_minutes(tmp_path):
    """WebVTT leaves the hours out: there would be no block in it."""
    text = (
        blocks(lambda _: "[latitude: 47.5] [longitude: 9.7]").replace("00:00:", "00:").replace(",000", ".000")
    )
    table, _ = read(tmp_path, "a.srt", f"WEBVTT\n\n{text}")
    assert table.at(3 * SECOND_NS, capture_ns=0).latitude_deg == 47.5


def test_a_short_segment_within_the_time_of_a_long_one_is_left_out(tmp_path, caplog):
    """Three points of another receiver refused the whole flight."""
    points = [track(range(31)), track(range(31, 60)), track([40, 41, 42]).replace('lat="47', 'lat="48')]
    text = points[0].replace(
        "</gpx>", "".join(one.partition(">")[2].replace("</gpx>", "") for one in points[1:])
    )
    table, _ = read(tmp_path, "a.gpx", f"{text}</gpx>")
    seen = [table.at(n * SECOND_NS, capture_ns=0) for n in range(60)]
    assert max(one.latitude_deg for one in seen) < 48
    assert "3 of 63 rows are left out: " in caplog.text


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("trkpt", "rtept"), ""),
        (("trkpt", "wpt"), ""),
        (("</trkseg></trk></gpx>", "<trkpt la"), "breaks off after 4 points"),
        (("Z<", "z<"), ""),
        (("Z<", " UTC<"), ""),
    ],
)
def test_a_track_of_another_kind_or_half_a_track_is_read(tmp_path, caplog, change, says):
    """What a recorder had not finished when its battery went would be lost."""
    table, pose = read(tmp_path, "a.gpx", track([0, 1, 2, 3]).replace(*change))
    assert pose.latitude_deg == pytest.approx(47.5)
    assert table.at(3 * SECOND_NS, capture_ns=0) is not None
    assert says in caplog.text


def test_what_stands_before_the_names_of_a_table_is_passed_over(tmp_path):
    """Spreadsheets and loggers put their own line there; columns between bars are columns."""
    head = "sep=|\n# made by a logger\n\ntime_s|latitude_deg|longitude_deg\n"
    _, pose = read(tmp_path, "a.csv", head + "0|47,5|9,7\n1|47,5|9,7\n")
    assert pose.longitude_deg == pytest.approx(9.7)


def test_a_table_in_another_unit_of_time_is_doubted(tmp_path):
    """Of milliseconds no pose would be known but the first, without a word."""
    rows = "".join(f"{1000 * n},47.5,9.7\n" for n in range(5))
    table, _ = read(tmp_path, "a.csv", f"time_s,latitude_deg,longitude_deg\n{rows}")
    assert "its poses are 1000 s apart" in " ".join(table.notes)


def quaternion(yaw_deg: float, pitch_deg: float, roll_deg: float) -> tuple[float, float, float, float]:
    """Of a turn by yaw, then by pitch, then by roll."""
    yaw, pitch, roll = (math.radians(one) / 2 for one in (yaw_deg, pitch_deg, roll_deg))
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    cr, sr = math.cos(roll), math.sin(roll)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


@pytest.mark.parametrize("pitch", [-90.0, 90.0])
@pytest.mark.parametrize("yaw", [33.0, 90.0, 200.0])
def test_straight_up_and_down_the_yaw_stays(yaw, pitch):
    """A picture from straight above would be turned at random."""
    for sign in (1, -1):  # both are the same direction
        found = euler_deg(*(sign * one for one in quaternion(yaw, pitch, 0)))
        assert compass_deg(found[0]) == pytest.approx(yaw)
        assert found[1:] == (pitch, 0.0)


@given(st.floats(0, 359), st.floats(-89, 89), st.floats(-179, 179))
def test_everywhere_else_it_is_the_turn_that_was_made(yaw, pitch, roll):
    """Places would be off by whatever a sign is."""
    found = euler_deg(*quaternion(yaw, pitch, roll))
    assert compass_deg(found[0] - yaw + 180) == pytest.approx(180, abs=1e-4)
    assert found[1:] == pytest.approx((pitch, roll), abs=1e-4)


@given(st.floats(-1e6, 1e6))
def test_a_course_is_below_360(yaw):
    """The ground would refuse a report of 360 degrees."""
    assert 0.0 <= compass_deg(yaw) < 360.0
    assert [compass_deg(one) for one in (-1e-17, -0.0, 360.0, 720.0, -360.0)] == [0.0] * 5
