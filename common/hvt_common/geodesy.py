"""Places on the earth a few kilometres around, in metres, and the pose between two poses."""

import math
from dataclasses import replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from hvt_common.values import Orientation, Pose

_EQUATOR_M = 6_378_137.0
_ECCENTRICITY2 = 6.69437999014e-3
"""First eccentricity of WGS 84 squared (NGA.STND.0036)."""
_Degrees = TypeVar("_Degrees", float, npt.NDArray[np.float64])


def wrap_180(degrees: _Degrees) -> _Degrees:
    """The same direction from -180 up to 180; of a difference the shorter way round."""
    return (degrees + 180) % 360 - 180


def metres_per_degree(latitude_deg: float) -> tuple[float, float]:
    """Metres north a degree of latitude, and east a degree of longitude, by WGS 84's radii of curvature.

    A plane that touches the ellipsoid: over 10 km it is wrong by some metres. At a pole a degree east is no metre.
    """
    sine = math.sin(math.radians(latitude_deg))
    bent = 1 - _ECCENTRICITY2 * sine * sine
    meridian = _EQUATOR_M * (1 - _ECCENTRICITY2) / bent**1.5
    normal = _EQUATOR_M / math.sqrt(bent)
    return math.radians(meridian), math.radians(normal * math.cos(math.radians(latitude_deg)))


def moved(latitude_deg: float, longitude_deg: float, *, north_m: float, east_m: float) -> tuple[float, float]:
    """Latitude and longitude of a place ``north_m`` and ``east_m`` away, degrees; longitude from -180 up to 180."""
    north, east = metres_per_degree(latitude_deg)
    longitude = longitude_deg + east_m / max(east, 1e-6)
    return latitude_deg + north_m / north, wrap_180(longitude)


def interpolate(first: Pose, second: Pose, capture_ns: int) -> Pose:
    """The pose at a time on the line through two, also before or behind them; ``first`` is the earlier one.

    A value that only one of them knows is missing. Angles turn the shorter way. Errors are those of the worse pose.
    """
    share = (capture_ns - first.capture_ns) / max(1, second.capture_ns - first.capture_ns)

    def line(one: float | None, other: float | None) -> float | None:
        return None if one is None or other is None else one + (other - one) * share

    def turn(one: Orientation | None, other: Orientation | None) -> Orientation | None:
        if one is None or other is None:
            return None
        pitch = one.pitch_deg + (other.pitch_deg - one.pitch_deg) * share
        return Orientation(
            (one.yaw_deg + wrap_180(other.yaw_deg - one.yaw_deg) * share) % 360,
            max(-90.0, min(90.0, pitch)),
            wrap_180(one.roll_deg + wrap_180(other.roll_deg - one.roll_deg) * share),
        )

    latitude = first.latitude_deg + (second.latitude_deg - first.latitude_deg) * share
    longitude = first.longitude_deg + wrap_180(second.longitude_deg - first.longitude_deg) * share
    return replace(
        first,
        capture_ns=capture_ns,
        latitude_deg=max(-90.0, min(90.0, latitude)),
        longitude_deg=wrap_180(longitude),
        height_m=line(first.height_m, second.height_m),
        altitude_m=line(first.altitude_m, second.altitude_m),
        camera=turn(first.camera, second.camera),
        platform=turn(first.platform, second.platform),
        hfov_deg=line(first.hfov_deg, second.hfov_deg),
        position_error_m=max(first.position_error_m, second.position_error_m),
        height_error_m=max(first.height_error_m, second.height_error_m),
        angle_error_deg=max(first.angle_error_deg, second.angle_error_deg),
    )
