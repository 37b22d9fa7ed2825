"""An autopilot that sends over real sockets."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Iterator

import pytest

from programs.processes import PATIENT_S


class Autopilot:
    """Packs what an autopilot says several times a second, as MAVLink 2 unless it is asked for 1."""

    def __init__(self, *, system: int = 1, version: int = 2) -> None:
        from pymavlink.dialects.v20 import ardupilotmega

        self._mav = ardupilotmega.MAVLink(None, srcSystem=system, srcComponent=1)
        self._is_old = version == 1

    def _pack(self, message) -> bytes:
        return bytes(message.pack(self._mav, force_mavlink1=self._is_old))

    def heartbeat(self) -> bytes:
        """It is there."""
        return self._pack(self._mav.heartbeat_encode(6, 8, 0, 0, 0))

    def place(self, latitude: float = 47.1) -> bytes:
        """Where it is."""
        return self._pack(
            self._mav.global_position_int_encode(
                1000, round(latitude * 1e7), round(8.5 * 1e7), 550_000, 120_000, 0, 0, 0, 9000
            )
        )

    def attitude(self, yaw_deg: float = 80.0) -> bytes:
        """Where it flies."""
        return self._pack(
            self._mav.attitude_encode(1000, math.radians(3), math.radians(-2), math.radians(yaw_deg), 0, 0, 0)
        )

    def mount(self) -> bytes:
        """Where the camera points, 10 degrees to the right of the nose."""
        return self._pack(self._mav.mount_orientation_encode(1000, 0.0, -60.0, 10.0, 0.0))

    def gimbal(self, yaw_deg: float, pitch_deg: float, *, flags: int) -> bytes:
        """The same as a quaternion."""
        yaw, pitch = math.radians(yaw_deg) / 2, math.radians(pitch_deg) / 2
        q = (
            math.cos(yaw) * math.cos(pitch),
            -math.sin(yaw) * math.sin(pitch),
            math.cos(yaw) * math.sin(pitch),
            math.sin(yaw) * math.cos(pitch),
        )
        return self._pack(
            self._mav.gimbal_device_attitude_status_encode(0, 0, 1000, flags, q, 0, 0, 0, 0, 0, 0, 0)
        )


@pytest.fixture
def autopilot():
    """Makes autopilots."""
    pytest.importorskip("pymavlink")
    return Autopilot


@pytest.fixture
def port() -> int:
    """Of UDP, a free one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@pytest.fixture
def send(port: int) -> Iterator:
    """Send datagrams to the port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:

        def send(*datagrams: bytes) -> None:
            for data in datagrams:
                one.sendto(data, ("127.0.0.1", port))

        yield send


@pytest.fixture
def wait_for():
    """Wait for the pose to be as wanted, repeating what is to be said meanwhile."""

    def wait_for(
        source, *, accept=lambda pose: pose is not None, say=lambda: None, limit_s: float = PATIENT_S
    ):
        until = time.monotonic() + limit_s
        while time.monotonic() < until:
            say()
            pose = source.at(0, capture_ns=11)
            if accept(pose):
                return pose
            time.sleep(0.02)
        raise AssertionError(f"no such pose came: {source.trouble}")

    return wait_for
