"""Who speaks MAVLink on one port: autopilots, gimbals, serial bridges, vehicles that come and go."""

import time

import pytest

pytest.importorskip("pymavlink")

from hvt_geo.pose.angles import euler_deg
from hvt_geo.pose.mavlink_transport import FrameParser


def test_a_gimbals_own_attitude_is_not_the_aircrafts(source, send, wait_for, autopilot):
    """The heading of the aircraft on every map would be that of its camera."""
    own, gimbal = autopilot(), autopilot(component=154)

    def say():
        send(own.place(), own.attitude(50.0), gimbal.attitude(110.0))
        send(own.say("mount_orientation", 1000, 0.0, -45.0, 30.0, 0.0))

    wait_for(source, has="camera", say=say)
    for _ in range(5):
        say()
        time.sleep(0.05)
        pose = source.at(0, capture_ns=0)
        assert (pose.platform.yaw_deg, pose.camera.yaw_deg) == pytest.approx((50, 80), abs=0.01)


def test_there_is_no_place_before_the_fix(source, send, wait_for, autopilot):
    """Every object would be placed in the Gulf of Guinea."""
    one = autopilot()
    send(one.fix(1), one.place(1.0, 1.0))
    said = lambda _: "no GPS fix" in source.trouble  # noqa: E731
    assert wait_for(source, accept=said, say=lambda: send(one.fix(1), one.place(1.0, 1.0))) is None
    assert wait_for(source, say=lambda: send(one.fix(3), one.place())).latitude_deg == pytest.approx(47.1)


@pytest.mark.parametrize("q", [(0.0, 0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0), (float("nan"),) * 4])
def test_a_turn_that_is_none_says_nothing(q):
    """A gimbal that has not found its level yet would point the camera straight ahead."""
    assert euler_deg(*q) is None


def test_a_place_beyond_the_earth_is_none(source, send, wait_for, autopilot):
    """An autopilot that knows none says the largest number there is."""
    one = autopilot()
    nowhere = one.say("global_position_int", 1000, 2**31 - 1, 2**31 - 1, 0, 0, *(0, 0, 0, 0))
    assert (
        wait_for(source, accept=lambda _: "no GPS fix" in source.trouble, say=lambda: send(nowhere)) is None
    )


@pytest.mark.parametrize("attitude", ["angles", "quaternion"])
def test_an_old_mount_points_the_camera_by_any_attitude(source, send, wait_for, autopilot, attitude):
    """Nothing would be placed, and nobody said why."""
    one, half = autopilot(), 0.5**0.5
    turned = one.say("attitude_quaternion", 1000, half, 0.0, 0.0, half, 0, 0, 0)
    own = one.attitude(90.0) if attitude == "angles" else turned
    pose = wait_for(source, has="camera", say=lambda: send(one.place(), own, one.old_mount()))
    assert (pose.camera.yaw_deg, pose.camera.pitch_deg) == pytest.approx((120, -45), abs=0.01)


def test_a_place_near_0_0_is_none_where_nobody_says_a_fix(source, send, wait_for, autopilot):
    """An autopilot that drifts from 0, 0 would be believed."""
    one = autopilot()
    with pytest.raises(AssertionError):
        wait_for(source, limit_s=1.0, say=lambda: send(one.place(0.0000353, -0.0000129)))


def test_the_vehicle_that_says_where_it_is_follows_one_that_never_did(source, send, wait_for, autopilot):
    """An autopilot that is given its number after the start would be ignored for ever."""
    early, late = autopilot(system=7), autopilot(system=1)
    send(early.place(0.0, 0.0), early.attitude())
    say = lambda: send(early.place(0.0, 0.0), late.place())  # noqa: E731
    assert wait_for(source, say=say).latitude_deg == pytest.approx(47.1)


def test_another_vehicle_counts_once_the_first_is_gone(source, send, wait_for, now, autopilot):
    """A drone that takes over would not be on the map."""
    first, second = autopilot(system=1), autopilot(system=2)
    wait_for(source, say=lambda: send(first.place()))
    send(second.place(48.0))
    assert source.at(0, capture_ns=0).latitude_deg == pytest.approx(47.1)

    def goes_on() -> None:
        now[0] += 0.1  # what the first said may be read only now
        send(second.place(48.0))

    there = lambda pose: pose is not None and pose.latitude_deg == pytest.approx(48.0)  # noqa: E731
    wait_for(source, accept=there, say=goes_on)


def test_that_nobody_says_where_the_camera_points_is_told_of_once(
    source, send, wait_for, now, caplog, autopilot
):
    """The map would stay empty without a word."""
    one = autopilot()
    for _ in range(3):
        wait_for(source, say=lambda: send(one.place()))
        now[0] += 11
    wait_for(source, say=lambda: send(one.place()))
    assert caplog.text.count("nobody where the camera points") == 1


@pytest.mark.parametrize("size", [7, 40, 100])
def test_datagrams_that_a_bridge_has_cut_lose_nothing(size, autopilot):
    """Half of the telemetry radios would give no position at all."""
    one = autopilot()
    frames = [one.place(), one.attitude(), one.fix(3)] * 50
    data = b"".join(frames)
    parser = FrameParser(is_stream=False)
    found = [
        message.get_type()
        for at in range(0, len(data), size)
        for message in parser.messages(data[at : at + size])
    ]
    assert len(found) == len(frames)


def test_noise_between_whole_datagrams_takes_none_of_them(autopilot):
    """Text from a bridge would hide the position after it."""
    one, parser = autopilot(), FrameParser(is_stream=False)
    noise = [b"\xfd\x10", b"$GNGGA,,,,*00\r\n", b"\xfe\xff\x00", b"\xfd\xff\x00\x00\x01\x01\x01"]
    found = [
        message.get_type()
        for turn in range(40)
        for data in (noise[turn % 4], one.place())
        for message in parser.messages(data)
    ]
    assert found == ["GLOBAL_POSITION_INT"] * 40
