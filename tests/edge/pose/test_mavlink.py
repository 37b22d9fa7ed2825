"""Poses from an autopilot, over a real socket."""

from __future__ import annotations

import math
import os
import random
import socket
import time

import pytest

os.environ.setdefault("MAVLINK20", "1")
mavutil = pytest.importorskip("pymavlink.mavutil")

from hvt_edge.pose.opening import open_pose  # noqa: E402 - MAVLink's version is a variable of the environment


@pytest.fixture
def port():
    """A free one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


@pytest.fixture
def source(port):
    """What listens."""
    opened = open_pose(f"mavlink:udpin:127.0.0.1:{port}", hfov_deg=65.0, clock=time.time_ns)
    yield opened
    opened.close()


@pytest.fixture
def vehicle():
    """Makes autopilots that send to a port."""
    made = []

    def make(port: int, *, system: int = 1):
        made.append(
            mavutil.mavlink_connection(f"udpout:127.0.0.1:{port}", source_system=system, source_component=1)
        )
        return made[-1]

    yield make
    for one in made:
        one.close()


def send(one, *, latitude: float = 47.1, gimbal: str = "") -> None:
    """One round of what an autopilot sends several times a second."""
    one.mav.global_position_int_send(
        1000, round(latitude * 1e7), round(8.5 * 1e7), 550_000, 120_000, 0, 0, 0, 9000
    )
    one.mav.attitude_send(1000, math.radians(3), math.radians(-2), math.radians(80), 0, 0, 0)
    if gimbal == "mount":
        one.mav.mount_orientation_send(1000, 0.0, -60.0, 10.0, 0.0)
    elif gimbal == "device":  # 90 degrees to the right of north and 30 down, in the frame of the earth
        yaw, pitch = math.radians(90) / 2, math.radians(-30) / 2
        q = (
            math.cos(yaw) * math.cos(pitch),
            -math.sin(yaw) * math.sin(pitch),
            math.cos(yaw) * math.sin(pitch),
            math.sin(yaw) * math.cos(pitch),
        )
        one.mav.gimbal_device_attitude_status_send(0, 0, 1000, 64, q, 0, 0, 0, 0)


def wait_for(source, *, accept=lambda pose: pose is not None, limit_s: float = 5.0):
    """The pose, once it is as wanted."""
    until = time.monotonic() + limit_s
    while time.monotonic() < until:
        pose = source.at(0, capture_ns=11)
        if accept(pose):
            return pose
        time.sleep(0.02)
    raise AssertionError("no such pose came")


def test_place_and_attitude_come_from_the_autopilot(source, port, vehicle):
    """A drone's own position would have to be written down by hand."""
    assert source.at(0, capture_ns=0) is None
    assert "no position" in source.trouble
    one = vehicle(port)
    send(one)
    pose = wait_for(source, accept=lambda pose: pose is not None and pose.platform is not None)
    assert (pose.latitude_deg, pose.longitude_deg) == pytest.approx((47.1, 8.5))
    assert (pose.height_m, pose.altitude_m, pose.hfov_deg, pose.capture_ns) == (120.0, 550.0, 65.0, 11)
    assert (pose.platform.yaw_deg, pose.platform.pitch_deg, pose.platform.roll_deg) == pytest.approx(
        (80, -2, 3), abs=1e-3
    )
    assert pose.camera is None  # nobody said where it points
    assert source.trouble == ""


@pytest.mark.parametrize(("gimbal", "yaw", "pitch"), [("mount", 90.0, -60.0), ("device", 90.0, -30.0)])
def test_the_gimbal_says_where_the_camera_points(source, port, vehicle, gimbal, yaw, pitch):
    """Places would be computed as if the camera looked where the drone flies."""
    one = vehicle(port)
    send(one, gimbal=gimbal)
    pose = wait_for(source, accept=lambda pose: pose is not None and pose.camera is not None)
    assert (pose.camera.yaw_deg, pose.camera.pitch_deg) == pytest.approx((yaw, pitch), abs=0.01)


def test_a_second_vehicle_on_the_port_is_not_mixed_in(source, port, vehicle):
    """The camera would jump between two drones."""
    first, second = vehicle(port), vehicle(port, system=2)
    send(first)
    wait_for(source)
    for _ in range(10):
        send(second, latitude=-10.0)
        send(first)
        time.sleep(0.01)
    assert wait_for(source).latitude_deg == pytest.approx(47.1)


def test_noise_on_the_port_harms_nothing(source, port, vehicle):
    """Anybody who reaches the port could end the flight."""
    noise = random.Random(1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for _ in range(300):
            head = noise.choice([b"", b"\xfd", b"\xfe", b"\xfd\x1c\x00\x00"])
            stranger.sendto(head + noise.randbytes(noise.randrange(1, 300)), ("127.0.0.1", port))
    one = vehicle(port)
    until = time.monotonic() + 5
    while source.at(0, capture_ns=0) is None and time.monotonic() < until:
        send(one)
        time.sleep(0.05)
    assert wait_for(source).latitude_deg == pytest.approx(47.1)


def test_what_an_autopilot_said_long_ago_is_no_pose(vehicle):
    """A lost autopilot would leave the camera hanging where it was."""
    now = [time.time_ns()]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        free = one.getsockname()[1]
    source = open_pose(f"mavlink:udpin:127.0.0.1:{free}", hfov_deg=None, clock=lambda: now[0])
    try:
        send(vehicle(free))
        wait_for(source)
        now[0] += 3_000_000_000
        assert source.at(0, capture_ns=0) is None
        assert "3 s old" in source.trouble
    finally:
        source.close()
