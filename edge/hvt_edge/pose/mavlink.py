"""Poses from an autopilot by MAVLink: listens only, and sends it nothing.

Place and height come from GLOBAL_POSITION_INT, the platform's angles from ATTITUDE, the camera's from
GIMBAL_DEVICE_ATTITUDE_STATUS or MOUNT_ORIENTATION, its field of view from CAMERA_FOV_STATUS, the accuracy of the fix
from GPS_RAW_INT. A value that is older than two seconds is not known any more.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from contextlib import closing
from typing import Any

from hvt_common.units import SECOND_NS
from hvt_common.values import Orientation, Pose
from hvt_edge.pose.angles import compass_deg, euler_deg
from hvt_edge.pose.mavlink_frames import FrameParser
from hvt_edge.pose.mavlink_transport import Address, Connection

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
_YAW_LOCK, _YAW_IN_VEHICLE_FRAME, _YAW_IN_EARTH_FRAME = 16, 32, 64
_JOIN_S = 4.0
"""Longer than an attempt to connect takes."""


class MavlinkPose:
    """Reads in a thread of its own from an address, such as ``udpin:127.0.0.1:14550``.

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
        where = Address.parse(address)
        self._parser = FrameParser(is_stream=where.is_stream)
        self._connection = Connection(where, stop=self._stop)
        self._thread = threading.Thread(target=self._read, name="hvt-pose", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str:
        """Why there is no pose."""
        with self._lock:
            come = self._newest.get("GLOBAL_POSITION_INT")
        if come is None:
            return f"no position has come on {self._address}{self._lost()}"
        age_ns = self._clock() - come[0]
        if age_ns <= _OLD_NS:
            return ""
        return f"the autopilot's last position is {age_ns / SECOND_NS:.0f} s old{self._lost()}"

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
        """End the thread, which closes the port."""
        self._stop.set()
        self._thread.join(timeout=_JOIN_S)

    def _lost(self) -> str:
        trouble = self._connection.trouble
        return f" ({trouble})" if trouble else ""

    def _read(self) -> None:
        with closing(self._connection) as connection:
            while not self._stop.is_set():
                for message in self._parser.messages(connection.read()):
                    self._take(message)

    def _take(self, message: Any) -> None:
        name, system = message.get_type(), message.get_srcSystem()
        if name not in _MESSAGES:
            return
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
        yaw, pitch, roll = euler_deg(*device.q)
        if _is_of_the_earth(device.flags):
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
    return Orientation(compass_deg(yaw), max(-90.0, min(90.0, pitch)), (roll + 180) % 360 - 180)


def _is_of_the_earth(flags: int) -> bool:
    """Whether yaw counts from north: gimbals of before the two frame flags say so by their yaw lock (common.xml)."""
    return bool(flags & _YAW_IN_EARTH_FRAME or (not flags & _YAW_IN_VEHICLE_FRAME and flags & _YAW_LOCK))


def _clipped(metres: float) -> float:
    return max(-1000.0, min(100_000.0, metres))
