"""Poses from an autopilot by MAVLink: listens only, and sends it nothing.

Place and height come from GLOBAL_POSITION_INT, the platform's angles from ATTITUDE, the camera's from
GIMBAL_DEVICE_ATTITUDE_STATUS or MOUNT_ORIENTATION, its field of view from CAMERA_FOV_STATUS, the accuracy of the fix
from GPS_RAW_INT. A value that is older than two seconds is not known any more.
"""

from __future__ import annotations

import math
import re
import threading
import time
from collections.abc import Callable
from typing import Any

from pymavlink import mavutil

from hvt_common.errors import UserError
from hvt_common.units import SECOND_NS
from hvt_common.values import Orientation, Pose

__all__ = ["MavlinkPose"]

_OLD_NS = 2 * SECOND_NS
_MESSAGES = (
    "GLOBAL_POSITION_INT",
    "ATTITUDE",
    "MOUNT_ORIENTATION",
    "GIMBAL_DEVICE_ATTITUDE_STATUS",
    "CAMERA_FOV_STATUS",
    "GPS_RAW_INT",
)
_YAW_IN_VEHICLE_FRAME, _YAW_IN_EARTH_FRAME = 32, 64
_KINDS = ("udpin", "tcp")
_HOST_PORT = re.compile(r"[^:]+:\d{1,5}")
_ACCEPTED = "give mavlink:udpin:HOST:PORT, mavlink:tcp:HOST:PORT or mavlink:/dev/DEVICE[,BAUD]"
_POLL_S = 0.2


class MavlinkPose:
    """Reads in a thread of its own from a pymavlink address, such as ``udpin:127.0.0.1:14550``.

    Of several vehicles the first that says where it is counts. Raises `UserError` where it cannot be opened.
    """

    def __init__(self, address: str, *, hfov_deg: float | None, clock: Callable[[], int]) -> None:
        self._hfov_deg = hfov_deg
        self._clock = clock
        self._address = address
        self._system: int | None = None
        self._newest: dict[str, tuple[int, Any]] = {}
        """By name, when it came and the message."""
        self._lock = threading.Lock()
        self._stop = threading.Event()
        kind, _, rest = address.partition(":")
        if kind not in _KINDS and not address.startswith("/dev/"):
            raise UserError(f"--pose mavlink:{address} is no address: {_ACCEPTED}")
        if kind in _KINDS and not _HOST_PORT.fullmatch(rest):
            raise UserError(f"--pose mavlink:{address} names no HOST:PORT: {_ACCEPTED}")
        try:
            self._link = mavutil.mavlink_connection(address, source_system=255, autoreconnect=True)
        except (OSError, ValueError, IndexError) as error:
            reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
            raise UserError(f"--pose mavlink:{address} cannot be opened: {reason}; {_ACCEPTED}") from None
        self._thread = threading.Thread(target=self._read, name="--pose", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str:
        """Why there is no pose."""
        with self._lock:
            come = self._newest.get("GLOBAL_POSITION_INT")
        if come is None:
            return f"no position has come on {self._address}"
        age_ns = self._clock() - come[0]
        return f"the autopilot's last position is {age_ns / SECOND_NS:.0f} s old" if age_ns > _OLD_NS else ""

    def at(self, media_ns: int, *, capture_ns: int) -> Pose | None:  # noqa: ARG002 - of now
        """The newest pose."""
        now_ns = self._clock()
        with self._lock:
            known = {name: one for name, (at_ns, one) in self._newest.items() if now_ns - at_ns <= _OLD_NS}
        place = known.get("GLOBAL_POSITION_INT")
        if place is None or not (place.lat or place.lon):  # 0, 0: no fix yet
            return None
        platform = _attitude(known.get("ATTITUDE"))
        field = known.get("CAMERA_FOV_STATUS")
        hfov = self._hfov_deg
        if field is not None and 0 < field.hfov < 180:
            hfov = field.hfov
        fix = known.get("GPS_RAW_INT")
        accuracy = {
            name: value / 1000
            for name, value in (
                ("position_error_m", getattr(fix, "h_acc", 0)),
                ("height_error_m", getattr(fix, "v_acc", 0)),
            )
            if 0 < value < 10**6
        }
        return Pose(
            capture_ns=capture_ns,
            latitude_deg=place.lat / 1e7,
            longitude_deg=place.lon / 1e7,
            height_m=_clipped(place.relative_alt / 1000),
            altitude_m=_clipped(place.alt / 1000),
            camera=_camera(known, platform),
            platform=platform,
            hfov_deg=hfov,
            **accuracy,
        )

    def close(self) -> None:
        """End the thread, and close the port."""
        self._stop.set()
        self._thread.join(timeout=2.0)
        self._link.close()

    def _read(self) -> None:
        while not self._stop.is_set():
            try:
                message = self._link.recv_match(type=list(_MESSAGES), blocking=True, timeout=_POLL_S)
            except Exception:  # noqa: BLE001 - whatever a parser of foreign bytes raises ends no flight
                time.sleep(_POLL_S)
                continue
            if message is None:
                continue
            name, system = message.get_type(), message.get_srcSystem()
            with self._lock:
                if self._system is None and name == "GLOBAL_POSITION_INT":
                    self._system = system
                if system == self._system:
                    self._newest[name] = (self._clock(), message)


def _attitude(message: Any) -> Orientation | None:
    if message is None:
        return None
    return _orientation(math.degrees(message.yaw), math.degrees(message.pitch), math.degrees(message.roll))


def _camera(known: dict[str, Any], platform: Orientation | None) -> Orientation | None:
    """Where the gimbal points; None where its yaw is the platform's and that is not known."""
    device = known.get("GIMBAL_DEVICE_ATTITUDE_STATUS")
    if device is not None:
        yaw, pitch, roll = _angles_deg(*device.q)
        if device.flags & _YAW_IN_EARTH_FRAME:
            return _orientation(yaw, pitch, roll)
        return None if platform is None else _orientation(yaw + platform.yaw_deg, pitch, roll)
    mount = known.get("MOUNT_ORIENTATION")
    if mount is None:
        return None
    yaw = getattr(mount, "yaw_absolute", math.nan)
    if not math.isfinite(yaw) or yaw == 0:  # an autopilot of before 2018 does not say it
        if platform is None:
            return None
        yaw = mount.yaw + platform.yaw_deg
    return _orientation(yaw, mount.pitch, mount.roll)


def _orientation(yaw: float, pitch: float, roll: float) -> Orientation | None:
    if not all(math.isfinite(one) for one in (yaw, pitch, roll)):
        return None
    return Orientation(yaw % 360, max(-90.0, min(90.0, pitch)), (roll + 180) % 360 - 180)


def _angles_deg(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Yaw, pitch and roll of the quaternion of a device in north-east-down (MAVLink, common.xml)."""
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return math.degrees(yaw), math.degrees(pitch), math.degrees(roll)


def _clipped(metres: float) -> float:
    return max(-1000.0, min(100_000.0, metres))
