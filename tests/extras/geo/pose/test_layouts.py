"""Pose files as models, phones and spreadsheets write them."""

from __future__ import annotations

import pytest

from hvt_common.errors import UserError
from hvt_geo.pose.files import read_poses

SECOND_NS = 1_000_000_000


def read(tmp_path, name, text):
    """The table, and its pose of the first moment."""
    file = tmp_path / name
    file.write_text(text, encoding="utf-8")
    table = read_poses(file, hfov_deg=60.0)
    return table, table.at(0, capture_ns=0)


def blocks(make, count=4):
    """Subtitles of a block a second."""
    return "".join(
        f"{n + 1}\n00:00:{n:02d},000 --> 00:00:{n + 1:02d},000\n{make(n)}\n\n" for n in range(count)
    )


@pytest.mark.parametrize(
    ("line", "place", "says"),
    [
        ("GPS(36.9000,-5.3000,0.0M) BAROMETER:20.3M", (36.9, -5.3, 20.3), "latitude, longitude, height"),
        ("GPS(40.1,116.2,69.800) BAROMETER(91.2) HOME(40.1,116.2)", (40.1, 116.2, 91.2), ""),
        ("GPS(116.2,40.1,69.800) BAROMETER(91.2)", (40.1, 116.2, 91.2), ""),
        ("GPS(36.9,-5.3,120)", (36.9, -5.3, None), "latitude, longitude, height"),
        ("GPS(8.2,47.4,16) BAROMETER:1.9", (47.4, 8.2, 1.9), "longitude, latitude, satellites"),
        ("GPS(11,5000,48,1000,16) BAROMETER:50,5", (48.1, 11.5, 50.5), "longitude, latitude, satellites"),
        ("GPS (11,5000, 48,1000, 16)", (48.1, 11.5, None), "longitude, latitude, satellites"),
        ("GPS(48,1000,11,5000,20,5M)", (48.1, 11.5, None), "latitude, longitude, height"),
        ("[latitude: 48,1000] [longitude: 11,5000] [rel_alt: 50,5 abs_alt: 570,2]", (48.1, 11.5, 50.5), ""),
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


def test_subtitles_of_one_line_have_height_and_gimbal(tmp_path):
    """Nothing would be placed, though all is there."""
    line = (
        "F/5.6, SS 400, ISO 100, EV 0, GPS (-3.700000, 40.400000, 15), HOME (-3.7001, 40.4001, 650.00m), D 98.70m, "
        "H 85.80m, H.S 0.00m/s, V.S 0.00m/s, F.PRY (2.7°, -7.0°, 110.1°), G.PRY (-60.0°, 0.0°, 110.4°)"
    )
    _, pose = read(tmp_path, "a.srt", blocks(lambda _: line))
    assert (pose.latitude_deg, pose.longitude_deg, pose.height_m) == pytest.approx((40.4, -3.7, 85.8))
    assert (pose.camera.yaw_deg, pose.camera.pitch_deg, pose.camera.roll_deg) == pytest.approx(
        (110.4, -60.0, 0.0)
    )
    assert (pose.platform.yaw_deg, pose.platform.pitch_deg, pose.platform.roll_deg) == pytest.approx(
        (110.1, 2.7, -7.0)
    )


def test_a_bad_block_is_left_out_and_counted(tmp_path, caplog):
    """One block that a camera has damaged would take the map of the whole flight."""
    table, _ = read(
        tmp_path, "a.srt", blocks(lambda n: f"[latitude: {95 if n == 2 else 47.5}] [longitude: 9.7]", count=6)
    )
    assert table.at(1 * SECOND_NS, capture_ns=0) is not None
    assert "1 of 6 rows are left out: " in caplog.text
    assert "latitude_deg is 95" in caplog.text


def test_a_file_that_is_half_wrong_is_refused(tmp_path):
    """A table of something else would be flown with the few rows that look like a place."""
    with pytest.raises(
        UserError, match=r"latitude_deg is 116\.2, .*: are latitude and longitude exchanged\?"
    ):
        read(tmp_path, "a.csv", "time_s,latitude_deg,longitude_deg\n0,116.2,40.1\n1,116.2,40.1\n")


POINT = '<trkpt lat="47.{:05d}" lon="9.7"><ele>{}</ele>{}</trkpt>'


def track(seconds, *, elevation="512.4"):
    """A GPS track; a second of None has no time."""
    points = "".join(
        POINT.format(50_000 + n, elevation, "" if at is None else f"<time>2026-05-01T10:00:{at:02d}Z</time>")
        for n, at in enumerate(seconds)
    )
    return f'<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{points}</trkseg></trk></gpx>'


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


def test_a_track_has_decimal_commas_in_its_heights(tmp_path):
    """The height would be a thousand times what it is, or the file be refused."""
    assert read(tmp_path, "a.gpx", track(range(4), elevation="68,000"))[1].altitude_m == 68.0


@pytest.mark.parametrize(
    "text",
    [
        "\ufefftime_s;latitude_deg;longitude_deg;height_m\r\n0,0;47,5;9,7;50,5\r\n1,0;47,5;9,7;50,5\r\n",
        "time_s;latitude_deg;longitude_deg;height_m\n0.0;47.5;9.7;50.5\n1.0;47.5;9.7;50.5\n",
        "time_s\tlatitude_deg\tlongitude_deg\theight_m\n0\t47.5\t9.7\t50.5\n",
        'time_s,latitude_deg,longitude_deg,height_m\n"0,0","47,5","9,7","50,5"\n',
        "\ufeffheight_m, longitude_deg, latitude_deg, time_s\r\n50.5, 9.7, 47.5, 0\r\n",
    ],
)
def test_a_table_is_read_as_a_spreadsheet_writes_it(tmp_path, text):
    """Half of Europe would have to convert each table by hand."""
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
    file = tmp_path / "a.srt"
    file.write_bytes(text.encode("utf-16" if change == "utf-16" else "utf-8"))
    table = read_poses(file, hfov_deg=60.0)
    poses = [table.at(n * SECOND_NS, capture_ns=0) for n in range(4)]
    assert [one.latitude_deg for one in poses] == pytest.approx([47.0, 47.1, 47.2, 47.3])
    assert {one.height_m for one in poses} == {30.0}


@pytest.mark.parametrize("sign", ["", "-"])
def test_autels_letters_say_which_number_is_which(tmp_path, sign):
    """They are written longitude first, with or without a sign."""
    line = (
        f"HOME(W: 70.4, S: 33.1) 2020-01-01\nGPS(W: {sign}70.5, S: 33.25, 30.5m)\nG.PRY (-90.0°, 0.0°, 3.0°)"
    )
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


def test_a_table_of_windows_is_read(tmp_path):
    """In UTF-16, with quotes, spaces, and names in capitals; 655.35 is how MAVLink says that no heading is known."""
    text = '"Time_s" , "Latitude_deg", "Longitude_deg",yaw_deg,pitch_deg\r\n0,47,8,655.35,0\r\n'
    file = tmp_path / "a.csv"
    file.write_bytes(text.encode("utf-16"))
    pose = read_poses(file, hfov_deg=60.0).at(0, capture_ns=0)
    assert (pose.latitude_deg, pose.longitude_deg, pose.platform) == (47.0, 8.0, None)


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


@pytest.mark.parametrize(
    ("line", "metres"),
    [
        ("[latitude: 47.5] [longitude: 9.7] [rel_alt: 100.0ft abs_alt: 1000 ft]", 30.48),
        ("GPS (9.7, 47.5, 15), D 10.0ft, H 100.0ft", 30.48),
        ("[latitude: 47.5] [longitude: 9.7] [rel_alt: 100.0 abs_alt: 1000]", 100.0),
    ],
)
def test_feet_are_feet(tmp_path, line, metres):
    """Everything on the map would be three times as far away."""
    _, pose = read(tmp_path, "a.srt", blocks(lambda _: line))
    assert pose.height_m == pytest.approx(metres)


def test_subtitles_of_the_web_count_minutes(tmp_path):
    """WebVTT leaves the hours out: there would be no block in it."""
    text = (
        blocks(lambda _: "[latitude: 47.5] [longitude: 9.7]").replace("00:00:", "00:").replace(",000", ".000")
    )
    table, _ = read(tmp_path, "a.srt", f"WEBVTT\n\n{text}")
    assert table.at(3 * SECOND_NS, capture_ns=0).latitude_deg == 47.5


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
    with pytest.raises(UserError, match="has the column 'latitude_deg' twice"):
        read(tmp_path, "b.csv", "time_s,latitude_deg,longitude_deg,latitude_deg\n0,47.5,9.7,48\n")


def test_a_table_in_another_unit_of_time_is_doubted(tmp_path):
    """Of milliseconds no pose would be known but the first, without a word."""
    rows = "".join(f"{1000 * n},47.5,9.7\n" for n in range(5))
    table, _ = read(tmp_path, "a.csv", f"time_s,latitude_deg,longitude_deg\n{rows}")
    assert "its poses are 1000 s apart" in " ".join(table.notes)
