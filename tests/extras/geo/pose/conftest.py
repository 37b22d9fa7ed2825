"""An autopilot that sends over real sockets."""

import math
import socket
import time
from collections.abc import Iterator

import pytest

from hvt_edge.loop.pose import open_pose
from programs.processes import PATIENT_S


class Autopilot:
    """Packs what an autopilot says several times a second, as MAVLink 2 unless it is asked for 1."""

    def __init__(self, *, system: int = 1, component: int = 1, version: int = 2) -> None:
        from pymavlink.dialects.v20 import ardupilotmega

        self._mav = ardupilotmega.MAVLink(None, srcSystem=system, srcComponent=component)
        self._is_old = version == 1

    def say(self, kind: str, *values) -> bytes:
        message = getattr(self._mav, f"{kind}_encode")(*values)
        return bytes(message.pack(self._mav, force_mavlink1=self._is_old))

    def heartbeat(self) -> bytes:
        return self.say("heartbeat", 6, 8, 0, 0, 0)

    def place(self, latitude: float = 47.1, longitude: float = 8.5) -> bytes:
        at = (round(latitude * 1e7), round(longitude * 1e7))
        return self.say("global_position_int", 1000, *at, 550_000, 120_000, 0, 0, 0, 9000)

    def attitude(self, yaw_deg: float = 80.0) -> bytes:
        turn = (math.radians(3), math.radians(-2), math.radians(yaw_deg))
        return self.say("attitude", 1000, *turn, 0, 0, 0)

    def fix(self, kind: int) -> bytes:
        return self.say("gps_raw_int", 0, kind, 0, 0, 0, *([65535] * 4), 0, 0, 0, 0)

    def mount(self) -> bytes:
        """Where the camera points, 10 degrees to the right of the nose."""
        return self.say("mount_orientation", 1000, 0.0, -60.0, 10.0, 0.0)

    def old_mount(self) -> bytes:
        """30 degrees to the right, in hundredths of a degree."""
        return self.say("mount_status", 0, 0, -4500, 0, 3000)

    def gimbal(self, yaw_deg: float, pitch_deg: float, *, flags: int) -> bytes:
        yaw, pitch = math.radians(yaw_deg) / 2, math.radians(pitch_deg) / 2
        q = (
            math.cos(yaw) * math.cos(pitch),
            -math.sin(yaw) * math.sin(pitch),
            math.cos(yaw) * math.sin(pitch),
            math.sin(yaw) * math.cos(pitch),
        )
        return self.say("gimbal_device_attitude_status", 0, 0, 1000, flags, q, 0, 0, 0, 0, 0, 0, 0)


@pytest.fixture
def autopilot():
    pytest.importorskip("pymavlink")
    return Autopilot


@pytest.fixture
def now() -> list[float]:
    """The clock, in seconds; it stands: what was said once is not old, however long this machine takes to look."""
    return [1000.0]


@pytest.fixture
def source(port: int, now: list[float]) -> Iterator:
    clock = lambda: round(now[0] * 1_000_000_000)  # noqa: E731
    opened = open_pose(f"mavlink:udpin:127.0.0.1:{port}", hfov_deg=65.0, clock=clock)
    yield opened
    opened.close()


@pytest.fixture
def port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@pytest.fixture
def send(port: int) -> Iterator:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:

        def send(*datagrams: bytes) -> None:
            for data in datagrams:
                one.sendto(data, ("127.0.0.1", port))

        yield send


@pytest.fixture
def wait_for():
    """Wait for the pose to be as wanted, repeating what is to be said meanwhile."""

    def wait_for(source, *, has="latitude_deg", accept=None, say=lambda: None, limit_s: float = PATIENT_S):
        until = time.monotonic() + limit_s
        while time.monotonic() < until:
            say()
            pose = source.at(0, capture_ns=11)
            if getattr(pose, has, None) is not None if accept is None else accept(pose):
                return pose
            time.sleep(0.02)
        raise AssertionError(f"no such pose came: {source.trouble}")

    return wait_for
