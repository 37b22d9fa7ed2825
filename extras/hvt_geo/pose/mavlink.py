"""Poses from an autopilot by MAVLink: listens only, and sends it nothing.

Place and height come from GLOBAL_POSITION_INT, the platform's angles from ATTITUDE or ATTITUDE_QUATERNION,
the camera's from GIMBAL_DEVICE_ATTITUDE_STATUS, MOUNT_ORIENTATION or MOUNT_STATUS, its field of view from
CAMERA_FOV_STATUS, the fix and its accuracy from the better of GPS_RAW_INT and GPS2_RAW. A value that is older
than two seconds, a fix of ten, is not known any more.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable
from contextlib import closing
from typing import Any

from hvt_common.runtime.statistics import Newest
from hvt_common.units import SECOND_NS
from hvt_common.values import Orientation, Pose
from hvt_geo.pose.angles import compass_deg, euler_deg
from hvt_geo.pose.mavlink_transport import Address, Connection, FrameParser

_log = logging.getLogger(__name__)

_OLD_NS, _OLD_FIX_NS = 2 * SECOND_NS, 10 * SECOND_NS
_MESSAGES = (
    "GLOBAL_POSITION_INT",
    "ATTITUDE",
    "ATTITUDE_QUATERNION",
    "MOUNT_ORIENTATION",
    "MOUNT_STATUS",
    "GIMBAL_DEVICE_ATTITUDE_STATUS",
    "CAMERA_FOV_STATUS",
    "GPS_RAW_INT",
    "GPS2_RAW",
)
_OF_AUTOPILOT = frozenset(
    {"GLOBAL_POSITION_INT", "ATTITUDE", "ATTITUDE_QUATERNION", "GPS_RAW_INT", "GPS2_RAW"}
)
"""Messages that a gimbal or a companion may send of itself, not of the aircraft."""
_FIXES = ("GPS_RAW_INT", "GPS2_RAW")
_AUTOPILOT = 1
"""``MAV_COMP_ID_AUTOPILOT1``."""
_FIX_2D = 2
"""``GPS_FIX_TYPE_2D_FIX``: no altitude. With less an autopilot says where its estimate has drifted to from 0, 0."""
_NOWHERE = 10_000
"""1e-7 degrees around 0, 0: a hundred metres in the Gulf of Guinea."""
_MOST_LATITUDE = 900_000_000
_MOST_SENDERS = 8
_MOST_KNOWN = 200
"""Limit of the messages of all senders, by name: strangers may send any number."""
_OF_GIMBAL = ("GIMBAL_DEVICE_ATTITUDE_STATUS", "MOUNT_ORIENTATION", "MOUNT_STATUS")
_NO_DIRECTION_NS = 10 * SECOND_NS
_YAW_LOCK, _YAW_IN_VEHICLE_FRAME, _YAW_IN_EARTH_FRAME = 16, 32, 64
_JOIN_S = 4.0
"""Longer than an attempt to connect takes."""


class MavlinkPose:
    """Reads in a thread of its own from an address, such as ``udpin:127.0.0.1:14550``.

    Of several vehicles the first that says where it is counts, until it has said nothing of the kind for two seconds.
    Place and attitude are those of one component, the autopilot's where it speaks. Raises `UserError` where the
    address cannot be opened.
    """

    notes = ()

    def __init__(self, address: str, *, hfov_deg: float | None, clock: Callable[[], int]) -> None:
        self._hfov_deg = hfov_deg
        self._clock = clock
        self._address = address
        self._vehicle: tuple[int, int] | None = None
        """System and component whose place counts."""
        self._newest: dict[tuple[int, int, str], tuple[int, Any]] = {}
        """Arrival and message by system, component and name."""
        self._placed_ns: int | None = None
        """The time since which there is a place and no direction of the camera; 0 once that was reported."""
        self._lock = threading.Lock()
        self._stop = threading.Event()
        where = Address.parse(address)
        self._is_stream = where.is_stream
        self._parsers: Newest[object, FrameParser] = Newest(_MOST_SENDERS)
        self._connection = Connection(where, stop=self._stop)
        self._thread = threading.Thread(target=self._read, name="hvt-pose", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str:
        known = self._known(fresh=False)
        come = known.get("GLOBAL_POSITION_INT")
        if come is None:
            return f"no position has come on {self._address}{self._lost()}"
        age_ns = self._clock() - come[0]
        if age_ns > _OLD_NS:
            return f"the autopilot's last position is {age_ns / SECOND_NS:.0f} s old{self._lost()}"
        if not _has_place({name: one for name, (_, one) in known.items()}):
            return "the autopilot has no GPS fix"
        return ""

    def at(self, media_ns: int, *, capture_ns: int) -> Pose | None:  # noqa: ARG002 - of now
        known = {name: one for name, (_, one) in self._known(fresh=True).items()}
        if not _has_place(known):
            return None
        place = known["GLOBAL_POSITION_INT"]
        platform = _attitude(known)
        field = known.get("CAMERA_FOV_STATUS")
        hfov = self._hfov_deg
        if field is not None and 0 < field.hfov < 180:
            hfov = field.hfov
        fix = max(_fixes(known), key=lambda one: one.fix_type, default=None)
        accuracy = {
            name: value / 1000
            for name, value in (
                ("position_error_m", getattr(fix, "h_acc", 0)),
                ("height_error_m", getattr(fix, "v_acc", 0)),
            )
            if 0 < value < 10**6
        }
        camera = _camera(known, platform)
        self._watch_direction(camera)
        return Pose(
            capture_ns=capture_ns,
            latitude_deg=place.lat / 1e7,
            longitude_deg=place.lon / 1e7,
            height_m=_clipped(place.relative_alt / 1000),
            altitude_m=None if fix and fix.fix_type == _FIX_2D else _clipped(place.alt / 1000),
            camera=camera,
            platform=platform,
            hfov_deg=hfov,
            **accuracy,
        )

    def close(self) -> None:
        self._stop.set()
        self._thread.join(timeout=_JOIN_S)

    def _lost(self) -> str:
        trouble = self._connection.trouble
        return f" ({trouble})" if trouble else ""

    def _known(self, *, fresh: bool) -> dict[str, tuple[int, Any]]:
        # Arrival and newest message by name of the present vehicle; with ``fresh`` only recent ones.
        now_ns = self._clock()
        with self._lock:
            vehicle, newest = self._vehicle, dict(self._newest)
        known: dict[str, tuple[int, Any]] = {}
        for (system, component, name), (at_ns, message) in sorted(newest.items(), key=lambda one: one[0]):
            if fresh and _is_old(name, now_ns - at_ns):
                continue
            if vehicle is not None and system != vehicle[0]:
                continue
            if vehicle is not None and name in _OF_AUTOPILOT and component != vehicle[1]:
                continue
            known.setdefault(name, (at_ns, message))  # of two gimbals always the same
        return known

    def _watch_direction(self, camera: Orientation | None) -> None:
        now_ns = self._clock()
        if camera is not None:
            self._placed_ns = None
        elif self._placed_ns is None:
            self._placed_ns = now_ns
        elif self._placed_ns and now_ns - self._placed_ns > _NO_DIRECTION_NS:
            self._placed_ns = 0
            _log.warning(
                "pose: the autopilot says where it is, and nobody where the camera points (with its ATTITUDE one of "
                "%s): nothing is placed on the map",
                ", ".join(_OF_GIMBAL),
            )

    def _read(self) -> None:
        with closing(self._connection) as connection:
            while not self._stop.is_set():
                data = connection.read()
                sender = connection.sender
                parser = self._parsers.setdefault(sender, FrameParser(is_stream=self._is_stream))
                for message in parser.messages(data):
                    self._take(message)

    def _take(self, message: Any) -> None:
        name, whose = message.get_type(), (message.get_srcSystem(), message.get_srcComponent())
        if name not in _MESSAGES:
            return
        now_ns = self._clock()
        with self._lock:
            if len(self._newest) > _MOST_KNOWN:
                self._newest = {key: one for key, one in self._newest.items() if now_ns - one[0] <= _OLD_NS}
            if name in _FIXES and message.fix_type >= _FIX_2D and _has_no_fix(self._of(whose, now_ns)):
                self._newest.pop((*whose, "GLOBAL_POSITION_INT"), None)  # its former place
            if len(self._newest) <= _MOST_KNOWN:
                self._newest[(*whose, name)] = (now_ns, message)
            if name == "GLOBAL_POSITION_INT" and whose != self._vehicle and self._is_better(whose, now_ns):
                self._vehicle = whose

    def _is_better(self, whose: tuple[int, int], now_ns: int) -> bool:
        if self._vehicle is None:
            return True
        if not _has_place(self._of(whose, now_ns)):
            return False
        if not _has_place(self._of(self._vehicle, now_ns)):
            return True
        return whose == (self._vehicle[0], _AUTOPILOT)

    def _of(self, whose: tuple[int, int], now_ns: int) -> dict[str, Any]:
        return {
            name: message
            for (system, component, name), (at_ns, message) in self._newest.items()
            if (system, component) == whose and not _is_old(name, now_ns - at_ns)
        }


def _is_old(name: str, age_ns: int) -> bool:
    # Receivers may report their fix less often than autopilots their place.
    return age_ns > (_OLD_FIX_NS if name in _FIXES else _OLD_NS)


def _has_place(known: dict[str, Any]) -> bool:
    # Whether a position is one: not where an autopilot without a fix believes to be.
    place = known.get("GLOBAL_POSITION_INT")
    if place is None or max(abs(place.lat), abs(place.lon)) < _NOWHERE:
        return False
    # The largest number: not known.
    if abs(place.lat) > _MOST_LATITUDE or abs(place.lon) > 2 * _MOST_LATITUDE:
        return False
    return not _has_no_fix(known)


def _fixes(known: dict[str, Any]) -> list[Any]:
    return [known[name] for name in _FIXES if name in known]


def _has_no_fix(known: dict[str, Any]) -> bool:
    return bool(fixes := _fixes(known)) and max(one.fix_type for one in fixes) < _FIX_2D


def _attitude(known: dict[str, Any]) -> Orientation | None:
    if (angles := known.get("ATTITUDE")) is not None:
        return _orientation(math.degrees(angles.yaw), math.degrees(angles.pitch), math.degrees(angles.roll))
    turn = known.get("ATTITUDE_QUATERNION")
    euler = None if turn is None else euler_deg(turn.q1, turn.q2, turn.q3, turn.q4)
    return None if euler is None else _orientation(*euler)


def _camera(known: dict[str, Any], platform: Orientation | None) -> Orientation | None:
    # Where the gimbal points; None where its yaw is the platform's and that is not known.
    device = known.get("GIMBAL_DEVICE_ATTITUDE_STATUS")
    euler = None if device is None else euler_deg(*device.q)
    if device is not None and euler is not None:
        yaw, pitch, roll = euler
        if _is_of_the_earth(device.flags):
            return _orientation(yaw, pitch, roll)
        return None if platform is None else _orientation(yaw + platform.yaw_deg, pitch, roll)
    mount = known.get("MOUNT_ORIENTATION")
    if mount is not None:
        yaw = getattr(mount, "yaw_absolute", math.nan)
        if math.isfinite(yaw) and yaw != 0:  # an autopilot of before 2018 does not say it
            return _orientation(yaw, mount.pitch, mount.roll)
        return (
            None if platform is None else _orientation(mount.yaw + platform.yaw_deg, mount.pitch, mount.roll)
        )
    # Of before ArduPilot 4.3: pitch, roll and yaw to the vehicle, in 0.01 degrees.
    status = known.get("MOUNT_STATUS")
    if status is None or platform is None:
        return None
    pitch, roll, yaw = (value / 100 for value in (status.pointing_a, status.pointing_b, status.pointing_c))
    return _orientation(yaw + platform.yaw_deg, pitch, roll)


def _orientation(yaw: float, pitch: float, roll: float) -> Orientation | None:
    if not all(math.isfinite(one) for one in (yaw, pitch, roll)):
        return None
    return Orientation(compass_deg(yaw), max(-90.0, min(90.0, pitch)), (roll + 180) % 360 - 180)


def _is_of_the_earth(flags: int) -> bool:
    # Whether yaw counts from north: gimbals of before the two frame flags say so by their yaw lock (common.xml).
    return bool(flags & _YAW_IN_EARTH_FRAME or (not flags & _YAW_IN_VEHICLE_FRAME and flags & _YAW_LOCK))


def _clipped(metres: float) -> float:
    return max(-1000.0, min(100_000.0, metres))
