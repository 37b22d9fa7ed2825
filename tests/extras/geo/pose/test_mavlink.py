"""Poses from an autopilot, over a real socket."""

import math
import random
import socket
import time

import pytest

pytest.importorskip("pymavlink")


@pytest.mark.parametrize("version", [1, 2])
def test_place_and_attitude_come_from_the_autopilot(source, send, autopilot, wait_for, version):
    """A drone's own position would have to be written down by hand."""
    assert source.at(0, capture_ns=0) is None
    assert "no position" in source.trouble
    one = autopilot(version=version)
    send(one.place(), one.attitude())
    pose = wait_for(source, has="platform")
    assert (pose.latitude_deg, pose.longitude_deg) == pytest.approx((47.1, 8.5))
    assert (pose.height_m, pose.altitude_m, pose.hfov_deg, pose.capture_ns) == (120.0, 550.0, 65.0, 11)
    assert (pose.platform.yaw_deg, pose.platform.pitch_deg, pose.platform.roll_deg) == pytest.approx(
        (80, -2, 3), abs=1e-3
    )
    assert pose.camera is None  # nobody said where it points
    assert source.trouble == ""


@pytest.mark.parametrize(
    ("fixes", "altitude_m", "error_m"),
    [(((3, 700),), 550.0, 0.7), (((2, 9000),), None, 9.0), (((0, 900_000), (4, 500)), 550.0, 0.5)],
)
def test_the_best_receiver_says_how_sure_the_place_is(
    source, send, autopilot, wait_for, fixes, altitude_m, error_m
):
    """One without a fix made places of the other unsure by a kilometre; of two dimensions the altitude is unknown."""
    one = autopilot()
    for (kind, error), name in zip(fixes, ("gps_raw_int", "gps2_raw"), strict=False):
        between = (0,) if name == "gps_raw_int" else (0, 0, 0, 0)
        send(one.say(name, 0, kind, 0, 0, 0, *([65535] * 4), 9, *between, error, error))
    send(one.place())
    pose = wait_for(source)
    assert (pose.altitude_m, pose.height_m, pose.position_error_m) == (altitude_m, 120.0, error_m)


@pytest.mark.parametrize(
    ("flags", "yaw"),
    [
        (64, 90.0),  # yaw in the earth's frame
        (64 | 16, 90.0),
        (16, 90.0),  # a gimbal of before the two frames: locked means the earth's
        (32, 140.0),  # in the vehicle's
        (32 | 16, 140.0),
        (0, 140.0),
    ],
)
def test_the_gimbal_says_which_way_its_yaw_counts(source, send, autopilot, wait_for, flags, yaw):
    """Everything would be placed beside where it is, by the angle at which the drone flies."""
    one = autopilot()
    send(one.place(), one.attitude(50), one.gimbal(90, -30, flags=flags))
    pose = wait_for(source, has="camera")
    assert (pose.camera.yaw_deg, pose.camera.pitch_deg) == pytest.approx((yaw, -30), abs=0.01)


@pytest.mark.parametrize("gimbals", [0, 1])
def test_the_mount_speaks_where_no_gimbal_knows_better(source, send, autopilot, wait_for, gimbals):
    """A gimbal writes NaN before it has found north, and the camera would be taken to look where the drone flies."""
    one = autopilot()
    unsure = [one.gimbal(math.nan, -30, flags=32)] * gimbals
    send(one.place(), one.attitude(50), *unsure, one.mount())
    pose = wait_for(source, has="camera")
    assert (pose.camera.yaw_deg, pose.camera.pitch_deg) == pytest.approx((60, -60), abs=0.01)


def test_an_old_device_that_speaks_first_hides_nothing(source, send, autopilot, wait_for, monkeypatch):
    """One part that speaks MAVLink 1 would take the gimbal away, whose message only MAVLink 2 has."""
    monkeypatch.delenv("MAVLINK20", raising=False)
    send(autopilot(system=255, version=1).heartbeat())
    one = autopilot()
    pose = wait_for(
        source, has="camera", say=lambda: send(one.place(), one.attitude(), one.gimbal(90, -30, flags=64))
    )
    assert pose.camera.yaw_deg == pytest.approx(90, abs=0.01)


def test_a_second_vehicle_on_the_port_is_not_mixed_in(source, send, autopilot, wait_for):
    """The camera would jump between two drones."""
    first, second = autopilot(), autopilot(system=2)
    send(first.place())
    wait_for(source)
    for _ in range(10):
        send(second.place(-10.0), first.place())
        time.sleep(0.01)
    assert wait_for(source).latitude_deg == pytest.approx(47.1)


def test_noise_on_the_port_harms_nothing(source, send, autopilot, wait_for):
    """Anybody who reaches the port could end the flight."""
    noise = random.Random(1)
    for _ in range(300):
        head = noise.choice([b"", b"\xfd", b"\xfe", b"\xfd\x1c\x00\x00"])
        send(head + noise.randbytes(noise.randrange(1, 300)))
    pose = wait_for(source, say=lambda: send(autopilot().place()))
    assert pose.latitude_deg == pytest.approx(47.1)


def test_a_flood_leaves_no_queue_behind(source, send, autopilot, wait_for):
    """A stranger would fill the memory, and the position would be that of minutes ago."""
    flood = autopilot(system=9).heartbeat() * 2800
    for _ in range(300):
        send(flood)
        time.sleep(0.003)
    assert wait_for(source, say=lambda: send(autopilot().place())).latitude_deg == pytest.approx(47.1)


def test_it_sends_the_autopilot_nothing(source, port, autopilot, wait_for):
    """What is only to watch would take part in the control of a vehicle."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        one.sendto(autopilot().heartbeat() + autopilot().place(), ("127.0.0.1", port))
        wait_for(source)
        source.close()
        one.settimeout(0.2)
        with pytest.raises(TimeoutError):
            one.recv(1)


def test_what_an_autopilot_said_long_ago_is_no_pose(source, now, send, autopilot, wait_for):
    """A lost autopilot would leave the camera hanging where it was."""
    send(autopilot().place())
    wait_for(source)
    now[0] += 3
    assert source.at(0, capture_ns=0) is None
    assert "3 s old" in source.trouble
