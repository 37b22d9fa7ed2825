"""The footprint of a picture on the ground: its middle and its corners, and how far away they are."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hvt_common.geodesy import moved
from hvt_common.values import Pose, View
from hvt_ground.geolocation.camera import ground_points
from hvt_ground.geolocation.surface import FLAT_GROUND, Surface

Place = tuple[float, float]
"""Latitude and longitude, degrees, WGS 84."""


@dataclass(frozen=True, slots=True)
class Footprint:
    """The footprint of the base picture, black edges included. Corners at or above the horizon are None."""

    centre: Place
    below_m: float
    """How far the ground at the centre lies below the camera."""
    slant_m: float
    """From the camera to the ground at the centre."""
    corners: tuple[Place, Place, Place, Place] | None
    """Upper left, upper right, lower right, lower left."""


def fields_of_view(pose: Pose, view: View) -> tuple[float, float] | None:
    """The fields of view of the base picture, degrees: across and up; None if the pose lacks that of the source."""
    if pose.hfov_deg is None:
        return None
    half = math.tan(math.radians(pose.hfov_deg) / 2) / (view.source_size[0] / 2)
    across, up = (math.degrees(2 * math.atan(side / view.scale / 2 * half)) for side in view.base_size)
    return across, up


def footprint(pose: Pose, view: View, *, surface: Surface = FLAT_GROUND) -> Footprint | None:
    """The footprint of a picture; None without height, direction or field of view, or with the centre in the sky."""
    if pose.camera is None or pose.hfov_deg is None or not surface.usable(pose):
        return None
    (wide, high), (x, y) = view.base_size, view.offset_px
    base = np.array(((wide / 2, high / 2), (0, 0), (wide, 0), (wide, high), (0, high)), np.float64)
    metres = ground_points(pose, (base - (x, y)) / view.scale, size=view.source_size, surface=surface)
    below_m = float(surface.below_m(pose, metres[:1])[0])
    if not np.isfinite((*metres[0], below_m)).all():
        return None
    centre, *corners = (
        moved(pose.latitude_deg, pose.longitude_deg, north_m=north_m, east_m=east_m)
        for north_m, east_m in metres.tolist()
    )
    first, second, third, fourth = corners
    return Footprint(
        centre=centre,
        below_m=below_m,
        slant_m=math.hypot(*metres[0].tolist(), below_m),
        corners=(first, second, third, fourth) if np.isfinite(metres).all() else None,
    )
