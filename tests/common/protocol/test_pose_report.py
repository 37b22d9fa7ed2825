"""Poses on the wire: small, and never another than was sent."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.protocol.messages import PoseDecoder, PoseEncoder, PoseReport, WireError
from hvt_common.protocol.messages.bits import BitReader, BitWriter
from hvt_common.values import Orientation, Pose

START_NS = 1_790_000_000_000_000_000
SECOND_NS = 1_000_000_000
SESSION = 2**63 + 5


def flight(count, *, seed=0):
    """A vehicle at 15 m/s in wide turns, a gimbal that tracks something, and noisy sensors."""
    noise = np.random.default_rng(seed)
    poses = []
    north = east = 0.0
    for number in range(count):
        heading = 40 * math.sin(number / 20)
        north += 15 * math.cos(math.radians(heading))
        east += 15 * math.sin(math.radians(heading))
        poses.append(
            Pose(
                START_NS + number * SECOND_NS,
                52.0 + (north + noise.normal(0, 0.3)) / 111_267,
                13.0 + (east + noise.normal(0, 0.3)) / 68_678,
                height_m=100 + 10 * math.sin(number / 30),
                altitude_m=140 + 10 * math.sin(number / 30),
                camera=Orientation((heading + 20) % 360, -40 + noise.normal(0, 0.1), noise.normal(0, 0.1)),
                platform=Orientation(heading % 360, 2 + noise.normal(0, 0.5), noise.normal(0, 1.0)),
                hfov_deg=62.0,
                position_error_m=1.5,
                height_error_m=2.5,
                angle_error_deg=1.0,
            )
        )
    return poses


def test_a_flight_takes_300_bits_a_second_and_comes_as_it_was_sent():
    """Poses would take from the video, or put an object into another field; a fixed camera takes less."""
    encoder, decoder = PoseEncoder(session_id=SESSION), PoseDecoder()
    sizes = []
    for pose in flight(300):
        data = encoder.encode(pose)(pose.capture_ns + 5_000_000).pack()
        sizes.append(len(data))
        come = decoder.decode(PoseReport.parse(data))
        assert come.capture_ns == pose.capture_ns
        place = (pose.latitude_deg, pose.longitude_deg)
        assert (come.latitude_deg, come.longitude_deg) == pytest.approx(place, abs=0.51e-7)
        tenths = (pose.height_m, pose.camera.pitch_deg)
        assert (come.height_m, come.camera.pitch_deg) == pytest.approx(tenths, abs=0.051)
        assert abs((come.camera.yaw_deg - pose.camera.yaw_deg + 180) % 360 - 180) <= 0.051
        assert pose.position_error_m <= come.position_error_m <= pose.position_error_m * 1.42
    assert 8 * np.mean(sizes) <= 300
    assert max(sizes) <= PoseReport.MAX_BYTES
    encoder = PoseEncoder(session_id=SESSION)
    fixed = Pose(START_NS, 52.0, 13.0, height_m=12, camera=Orientation(90, -30, 0), hfov_deg=70)
    poses = [replace(fixed, capture_ns=START_NS + n * SECOND_NS) for n in range(60)]
    assert 8 * np.mean([len(encoder.encode(one)(START_NS).pack()) for one in poses]) <= 250


def test_after_a_loss_nothing_is_shown_before_a_report_stands_by_itself():
    """Changes would be added to the wrong place, and the camera be somewhere else for good."""
    encoder, decoder = PoseEncoder(session_id=SESSION), PoseDecoder()
    reports = [encoder.encode(pose)(pose.capture_ns) for pose in flight(30)]
    poses = [decoder.decode(report) for number, report in enumerate(reports) if number != 3]
    lost = [number for number, pose in enumerate(poses) if pose is None]
    assert lost == list(range(3, 9))  # the next that stands by itself is the one of the tenth second
    assert poses[-1] is not None


@pytest.mark.parametrize("lost", [16, 26, 32])
def test_after_an_outage_no_report_builds_on_one_of_before_it_that_has_the_number(lost):
    """The camera would be where it never was, at a time of the outage."""
    encoder, decoder = PoseEncoder(session_id=SESSION), PoseDecoder()
    for number, pose in enumerate(flight(100)):
        report = encoder.encode(pose)(pose.capture_ns)
        come = None if 35 <= number < 35 + lost else decoder.decode(report)
        assert come is None or come.capture_ns == pose.capture_ns


def test_what_is_not_known_is_not_sent():
    """A height of 0 m would be shown of a camera without an altimeter."""
    encoder, decoder = PoseEncoder(session_id=SESSION), PoseDecoder()
    bare = Pose(START_NS, -33.5, 151.2)
    come = decoder.decode(encoder.encode(bare)(START_NS))
    assert (come.height_m, come.altitude_m, come.camera, come.platform, come.hfov_deg) == (None,) * 5
    known = replace(bare, capture_ns=START_NS + SECOND_NS, height_m=50.0)
    assert decoder.decode(encoder.encode(known)(START_NS)).height_m == 50.0


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"latitude_deg": 91.0}, "latitude"),
        ({"height_m": 2e6}, "height"),
        ({"hfov_deg": 180.0}, "field of view"),
        ({"latitude_deg": math.nan}, "NaN"),
    ],
)
def test_what_no_place_on_earth_has_is_refused(wrong, says):
    """A bad sensor would send something that grounds refuse, or read as another place."""
    encoder = PoseEncoder(session_id=SESSION)
    with pytest.raises(ValueError, match=says):
        encoder.encode(replace(Pose(START_NS, 1.0, 2.0), **wrong))
    assert PoseDecoder().decode(encoder.encode(Pose(START_NS, 1.0, 2.0))(0)) is not None


@settings(max_examples=300, deadline=None)
@given(st.lists(st.binary(max_size=48), min_size=1, max_size=6))
def test_any_bytes_are_a_pose_or_refused(messages):
    """Bytes of a stranger would end the ground."""
    decoder = PoseDecoder()
    for coded in messages:
        try:
            pose = decoder.decode(PoseReport(session=1, send_ns=0, coded=coded))
        except WireError:
            continue
        assert pose is None or (abs(pose.latitude_deg) <= 90 and abs(pose.longitude_deg) <= 180)


@given(st.lists(st.tuples(st.integers(-(2**36), 2**36), st.integers(0, 8))), st.integers(0, 2**12 - 1))
def test_numbers_come_back(numbers, plain):
    """A pose would be another one; readers in other languages follow the standard's codes."""
    out = BitWriter()
    out.u(plain, 12)
    for value, order in numbers:
        out.se(value, order)
    bits = BitReader(out.ended(stop=""))
    assert bits.u(12) == plain
    assert [bits.se(order) for _, order in numbers] == [value for value, _ in numbers]
    bits.finish()
    for value, code in {
        0: "1",
        1: "010",
        -1: "011",
        2: "00100",
        -2: "00101",
        3: "00110",
        -3: "00111",
    }.items():
        coded = BitWriter().se(value).ended(stop="")
        assert f"{int.from_bytes(coded, 'big'):08b}" == code.ljust(8, "0")
