"""What a moment is said to be: read back by klvdata, to the step of each item."""

import math
from dataclasses import replace

import klvdata.common
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.geodesy import metres_per_degree
from hvt_common.units import SECOND_NS
from hvt_common.values import Orientation, Pose, View
from hvt_gateways.transport_stream.uas import (
    MOST_BYTES,
    Platform,
    ber_length,
    ber_oid,
    imapb,
    item,
    packet,
    sensor_angles,
    signed,
    uas_local_set,
    unsigned,
    whole,
)
from hvt_geo.camera import SurfaceLocator
from hvt_ground.events import Overlay, Places
from media.klv_reader import KlvPacket, packets_of
from rigs import examples

NOW_NS = 1_790_000_000 * SECOND_NS + 123_456_789
SIZE = (1280, 720)
VIEW = View.fitted((1920, 1080), SIZE, fit="letterbox")
PLATFORM = Platform("uav-1", "00000000000000ff", VIEW, SurfaceLocator())
POSE = Pose(
    NOW_NS,
    -33.5,
    151.25,
    height_m=100.0,
    altitude_m=180.0,
    camera=Orientation(30.0, -60.0, 0.0),
    platform=Orientation(20.0, 4.0, -10.0),
    hfov_deg=60.0,
)
WITHOUT_POSE = {1, 2, 3, 10, 65}


def said(pose: Pose | None, overlay: Overlay | None = None, *, view: View = VIEW) -> KlvPacket:
    platform = replace(PLATFORM, view=view)
    (found,) = packets_of(uas_local_set(platform, capture_ns=NOW_NS, pose=pose, overlay=overlay))
    return found


def overlay(count: int, **changes) -> Overlay:
    """Tracks in a row, each with a place."""
    x = np.linspace(10, 1200, count, dtype=np.float32)
    boxes = np.stack((x, np.full(count, 100.5), x + 40, np.full(count, 131.0)), axis=1).astype(np.float32)
    values = {
        "track_ids": np.arange(200, 200 + count),
        "classes": tuple("Überbus" if row % 2 else "car" for row in range(count)),
        "confidences": np.linspace(0.99, 0.3, count, dtype=np.float32),
        "places": Places(np.tile((-33.499, 151.2512), (count, 1)), np.ones((count, 3))),
    }
    return examples.overlay(70_000, boxes, capture_ns=NOW_NS, **(values | changes))


def test_every_item_of_a_pose_comes_back_within_its_step():
    """A map would show the aircraft, or what it looks at, somewhere else."""
    found = said(POSE).items
    assert found[2].timestamp() == pytest.approx(NOW_NS / SECOND_NS, abs=1e-5)
    assert (found[3], found[10], found[12]) == (PLATFORM.session, "uav-1", "Geodetic WGS84")
    assert found[65] == 16
    for tag, value, step in (
        (5, 20.0, 360 / 65_535),
        (6, 4.0, 20 / 32_767),
        (7, -10.0, 50 / 32_767),
        (13, -33.5, 1e-7),
        (14, 151.25, 1e-7),
        (15, 180.0, 19_900 / 65_535),
        (16, 60.0, 180 / 65_535),
        (17, 2 * math.degrees(math.atan(math.tan(math.radians(30)) * 9 / 16)), 180 / 65_535),
    ):
        assert found[tag] == pytest.approx(value, abs=step), tag


def test_the_footprint_is_what_geometry_says():
    """The picture would lie in the next street, turned or mirrored."""
    found = said(POSE).items
    north_m, east_m = metres_per_degree(-33.5)
    away_m = 100 / math.tan(math.radians(60))
    assert found[21] == pytest.approx(100 / math.sin(math.radians(60)), abs=0.01)
    middle = (away_m * math.cos(math.radians(30)), away_m * math.sin(math.radians(30)))
    assert (found[23] + 33.5) * north_m == pytest.approx(middle[0], abs=0.05)
    assert (found[24] - 151.25) * east_m == pytest.approx(middle[1], abs=0.05)
    assert found[25] == pytest.approx(80.0, abs=0.31)
    corners = np.array([[found[26 + 2 * k] * north_m, found[27 + 2 * k] * east_m] for k in range(4)])
    heading = np.array((math.cos(math.radians(30)), math.sin(math.radians(30))))
    right = np.array((-heading[1], heading[0]))
    ahead, across = corners @ heading, corners @ right
    assert (ahead > 0).tolist() == [True, True, False, False], "1 and 2 are the upper ones"
    assert (across > 0).tolist() == [False, True, True, False], "2 and 3 are the right ones"
    assert ahead[0] == pytest.approx(ahead[1], abs=0.5)
    assert across[0] == pytest.approx(-across[1], abs=0.5)
    upper_deg = 60 - math.degrees(math.atan(math.tan(math.radians(30)) * 9 / 16))
    assert ahead[0] + away_m == pytest.approx(100 / math.tan(math.radians(upper_deg)), abs=0.5)


def test_a_picture_that_is_cut_shows_less_of_the_ground():
    """The corners would be those of a picture that nobody sees."""
    cut = View.fitted((1920, 1080), (720, 720), fit="crop")
    found = said(POSE, view=cut).items
    assert found[17] == pytest.approx(said(POSE).items[17], abs=0.01)
    assert found[16] == pytest.approx(found[17], abs=0.01)


def test_what_is_not_known_is_left_out():
    """A made-up north or height is worse than none."""
    bare = Pose(NOW_NS, -33.5, 151.25)
    assert set(said(None).items) == WITHOUT_POSE
    assert set(said(bare).items) == WITHOUT_POSE | {12, 13, 14}
    without = said(replace(POSE, altitude_m=None)).items
    assert not {15, 25} & set(without)
    assert {23, 26} <= set(without)
    assert not {5, 6, 7, 18, 19, 20} & set(said(replace(POSE, platform=None)).items)
    assert not set(range(21, 34)) & set(said(replace(POSE, height_m=None)).items)
    assert not set(range(16, 34)) - {18, 19, 20} & set(said(replace(POSE, hfov_deg=None)).items)


def test_the_sky_has_no_place():
    """Corners above the horizon would lie behind the camera."""
    level = replace(POSE, camera=Orientation(30.0, 5.0, 0.0))
    assert not set(range(21, 34)) & set(said(level).items)
    low = said(replace(POSE, camera=Orientation(30.0, -10.0, 0.0))).items
    assert {21, 23, 24} <= set(low)
    assert not set(range(26, 34)) & set(low), "the upper corners look over the horizon"


def test_far_corners_are_said_in_full():
    """They would be cut off at eight kilometres."""
    found = said(replace(POSE, height_m=9_000.0, altitude_m=9_050.0)).items
    assert not set(range(26, 34)) & set(found)
    assert found[23] + 33.5 > 0.03
    assert found[82] > found[23] > found[86]
    near = said(POSE).items
    assert not set(range(82, 90)) & set(near)


def test_a_drone_that_leans_is_said_in_full():
    """20 degrees are an aeroplane's."""
    found = said(replace(POSE, platform=Orientation(359.9999, -35.0, 60.0))).items
    assert not {6, 7} & set(found)
    assert (found[90], found[91]) == pytest.approx((-35.0, 60.0), abs=1e-6)


def test_a_camera_that_looks_straight_down_points_where_its_aircraft_does():
    """The commonest of all angles is the one at which two of three are one."""
    assert sensor_angles(Orientation(75.0, -90.0, 0.0), Orientation(75.0, 0.0, 0.0)) == pytest.approx(
        (0.0, -90.0, 0.0), abs=1e-6
    )
    azimuth, elevation, roll = sensor_angles(Orientation(120.0, -90.0, 0.0), Orientation(75.0, 0.0, 0.0))
    assert (azimuth, elevation, roll) == pytest.approx((45.0, -90.0, 0.0), abs=1e-6)
    assert sensor_angles(Orientation(100.0, -30.0, 5.0), Orientation(75.0, 0.0, 0.0)) == pytest.approx(
        (25.0, -30.0, 5.0)
    )


def _turn(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """Three turns one after the other, by their own matrices."""
    y, p, r = map(math.radians, (yaw, pitch, roll))
    about_down = [[math.cos(y), -math.sin(y), 0], [math.sin(y), math.cos(y), 0], [0, 0, 1]]
    about_right = [[math.cos(p), 0, math.sin(p)], [0, 1, 0], [-math.sin(p), 0, math.cos(p)]]
    about_front = [[1, 0, 0], [0, math.cos(r), -math.sin(r)], [0, math.sin(r), math.cos(r)]]
    return np.array(about_down) @ np.array(about_right) @ np.array(about_front)


ANGLES = st.builds(Orientation, st.floats(0, 359), st.floats(-90, 90), st.floats(-180, 179))


@given(ANGLES, ANGLES)
def test_the_aircraft_and_the_sensor_together_are_the_camera(camera, platform):
    """Who draws the line of view from both would draw it elsewhere."""
    azimuth, elevation, roll = sensor_angles(camera, platform)
    both = _turn(platform.yaw_deg, platform.pitch_deg, platform.roll_deg) @ _turn(azimuth, elevation, roll)
    assert np.allclose(both, _turn(camera.yaw_deg, camera.pitch_deg, camera.roll_deg), atol=1e-5)


def test_tracks_come_back_with_id_class_confidence_box_and_place():
    """The very reason for VMTI."""
    found = said(POSE, overlay(3))
    vmti, targets = found.vmti, found.targets
    assert vmti is not None
    numbers = {tag: int.from_bytes(vmti[tag]) for tag in (2, 4, 5, 6, 7, 8, 9)}
    assert numbers == {2: NOW_NS // 1000, 4: 5, 5: 3, 6: 3, 7: 70_000, 8: 1280, 9: 720}
    assert vmti[3] == b"HVT"
    assert [one.track_id for one in targets] == [200, 201, 202]
    assert [one.class_name for one in targets] == ["car", "Überbus", "car"]
    assert [one.number(5) for one in targets] == [99, 64, 30]
    # x 10 … 50, y 100.5 … 131: the pixels at (11, 101) and (50, 131), counted from 1
    assert targets[0].number(2) == 11 + 100 * 1280
    assert targets[0].number(3) == 50 + 130 * 1280
    assert targets[0].number(1) == 31 + 115 * 1280
    offsets = [int.from_bytes(targets[0].items[tag]) * 2.0**-17 - 19.2 for tag in (10, 11)]
    assert found.items[23] + offsets[0] == pytest.approx(-33.499, abs=2e-5)
    assert found.items[24] + offsets[1] == pytest.approx(151.2512, abs=2e-5)


def test_a_track_has_a_place_only_where_there_is_one():
    """At the horizon, or without a pose, none is known; a pixel number beyond the last line is none."""
    places = np.array([[math.nan, math.nan], [-33.499, 151.2512]])
    found = said(POSE, overlay(2, places=Places(places, np.ones((2, 3))))).targets
    assert [{10, 11} <= set(one.items) for one in found] == [False, True]
    assert not any({10, 11} & set(one.items) for one in said(None, overlay(2)).targets)
    boxes = np.array([[0, 0, 1280, 720], [-5, -5, 2000, 2000]], np.float32)
    found = said(None, replace(overlay(2), boxes_base_px=boxes)).targets
    assert [(one.number(2), one.number(3)) for one in found] == [(1, 1280 * 720)] * 2
    across = replace(POSE, longitude_deg=-179.9999)
    date_line = overlay(1, places=Places(np.array([[-33.499, 179.9999]]), np.ones((1, 3))))
    (target,) = said(across, date_line).targets
    assert int.from_bytes(target.items[11]) * 2.0**-17 - 19.2 == pytest.approx(-0.0007, abs=1e-3)


def test_what_stills_doubt_is_counted_and_not_reported():
    """What is known to be nothing would be shown as a target; and no targets not be told from no detector."""
    found = said(POSE, overlay(3, doubted=np.array([False, True, False])))
    assert found.vmti is not None
    assert (found.vmti[5], found.vmti[6]) == (b"\x03", b"\x02")
    assert [one.track_id for one in found.targets] == [200, 202]
    nothing = said(POSE, overlay(0, places=None)).vmti
    assert nothing is not None
    assert (nothing[5], 101 in nothing) == (b"\x00", False)


def test_of_too_many_tracks_the_surest_are_reported():
    """A packet of more than 64 kB does not fit its PES header, and would break the stream."""
    crowd = overlay(3_000, classes=("a very long name of a class" * 10,) * 3_000)
    found = said(POSE, crowd)
    assert found.vmti is not None
    assert len(found.data) < MOST_BYTES + 1024
    assert int.from_bytes(found.vmti[5]) == 3_000
    assert int.from_bytes(found.vmti[6]) == len(found.targets) > 200
    assert [one.track_id for one in found.targets] == list(range(200, 200 + len(found.targets)))


@pytest.mark.parametrize("capture_ns", [-1, 0, (1 << 63) - 1, 1 << 80])
def test_any_time_can_be_said(capture_ns):
    """Times come from the wire: one that no field holds would end the stream."""
    assert uas_local_set(PLATFORM, capture_ns=capture_ns, pose=None, overlay=overlay(1))


LENGTHS = {0: "00", 127: "7f", 128: "8180", 256: "820100", 65_536: "83010000"}
IDENTIFIERS = {0: "00", 127: "7f", 128: "8100", 16_384: "818000"}
WHOLE = {0: "00", 255: "ff", 256: "0100", 1 << 40: "010000000000"}


@pytest.mark.parametrize(
    ("data", "code"),
    [  # the examples of ST 0601, by item
        ("71c2", unsigned(159.974364843976, 0, 360, size=2)),  # 5
        ("fd3d", signed(-0.431531724, 20, size=2)),  # 6
        ("08b8", signed(3.405865659, 50, size=2)),  # 7
        ("5595b66d", signed(60.176822966978335, 90, size=4)),  # 13
        ("5b5360c4", signed(128.42675904204452, 180, size=4)),  # 14
        ("c221", unsigned(14190.7195, -900, 19_000, size=2)),  # 15
        ("cd9c", unsigned(144.5713, 0, 180, size=2)),  # 16
        ("724a0a20", unsigned(160.71921147439643, 0, 360, size=4)),  # 18
        ("03830926", unsigned(68590.98329874477, 0, 5_000_000, size=4)),  # 21
        ("f101a229", signed(-10.542388633146132, 90, size=4)),  # 23
        ("2a94", imapb(10_000, -900, 19_000, size=2)),  # ST 0903, VTarget item 12
        ("3a6667", imapb(10, -19.2, 19.2, size=3)),  # VTarget item 10
        *((code, ber_length(size)) for size, code in LENGTHS.items()),
        *((code, ber_oid(number)) for number, code in IDENTIFIERS.items()),
        *((code, whole(number)) for number, code in WHOLE.items()),
    ],
)
def test_the_examples_of_the_standards(data, code):
    """Every reader would see other numbers than were meant."""
    assert code.hex() == data


@given(st.floats(-90, 90))
def test_a_signed_value_comes_back_within_a_step(value):
    """A place would be off."""
    code = signed(value, 90, size=4)
    assert klvdata.common.bytes_to_float(code, (-(2**31 - 1), 2**31 - 1), (-90, 90)) == pytest.approx(
        value, abs=90 / 2**31
    )


@given(st.floats(-900, 19_000))
def test_an_unsigned_value_comes_back_within_a_step(value):
    """An altitude would be off."""
    code = unsigned(value, -900, 19_000, size=2)
    assert klvdata.common.bytes_to_float(code, (0, 65_535), (-900, 19_000)) == pytest.approx(value, abs=0.153)


@given(st.floats(-19.2, 19.2))
def test_an_imapb_value_comes_back_within_a_step(value):
    """ST 1201, the way back: a target would be a street away."""
    step = 2.0**-17
    offset = -19.2 / step - math.floor(-19.2 / step)
    back = step * (int.from_bytes(imapb(value, -19.2, 19.2, size=3)) - offset) - 19.2
    assert abs(back - value) <= step


@pytest.mark.parametrize("value", [20.001, -20.001, math.inf, math.nan])
def test_what_is_out_of_range_is_not_another_number(value):
    """An aircraft on its back would fly level."""
    assert signed(value, 20, size=2) == b"\x80\x00", "the standard's word for it"
    assert unsigned(value + 380, 0, 360, size=2) in (b"", unsigned(359.999, 0, 360, size=2))
    assert unsigned(math.nan, 0, 360, size=2) == b""
    assert imapb(value, -19.2, 19.2, size=3) == b""


@given(st.binary(max_size=40))
def test_the_checksum_is_the_readers(value):
    """Readers drop a packet whose checksum is wrong, without a word."""
    data = packet(bytes(16), [item(3, value)])
    assert klvdata.common.packet_checksum(data) == data[-2:]
