"""Poses on the wire: small, and never another than was sent."""

import math
from dataclasses import replace

import numpy as np
import pytest

from hvt_common.protocol.messages import PoseDecoder, PoseEncoder, PoseReport
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
