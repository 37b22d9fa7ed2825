"""Angles as `hvt_common.values.Orientation` has them, from those that files and autopilots say."""

from __future__ import annotations

import math

_UPRIGHT = 0.99999
"""Sine of a pitch within 0.3 degrees of straight up or down, where yaw and roll turn about the same axis."""


def compass_deg(yaw_deg: float) -> float:
    """From 0 up to but not 360; the remainder of a very small negative number is rounded to 360."""
    turned = yaw_deg % 360.0
    return 0.0 if turned >= 360.0 else turned


_UNIT = 0.1
"""The length of a quaternion may differ from 1 by this."""


def euler_deg(w: float, x: float, y: float, z: float) -> tuple[float, float, float] | None:
    """Yaw, pitch and roll of the unit quaternion of a device in north-east-down (MAVLink, common.xml).

    Order yaw, pitch, roll. Straight up or down only their sum or difference is known: it is the yaw, and the roll 0.
    None for an impossible quaternion: zeros or NaN, from a device that does not know.
    """
    length = math.hypot(w, x, y, z)
    if not abs(length - 1) <= _UNIT:
        return None
    w, x, y, z = w / length, x / length, y / length, z / length
    sine = 2 * (w * y - z * x)
    if abs(sine) > _UPRIGHT:
        return math.degrees(2 * math.atan2(z, w)), math.copysign(90.0, sine), 0.0
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return math.degrees(yaw), math.degrees(math.asin(sine)), math.degrees(roll)
