"""From picture to ground: the pinhole camera of a pose, how far it may be off, and a flight's locator by it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from hvt_common.geodesy import metres_per_degree, moved, wrap_180
from hvt_common.values import Boxes, Pose, View
from hvt_ground.events import Places
from hvt_ground.poses import Footprint, Locator

Points = npt.NDArray[np.float64]
"""(N, 2): pixels, or metres north and east."""
Rays = npt.NDArray[np.float64]
"""(N, 3): north, east, down; of any length."""

LEAST_DEPRESSION_DEG: Final = 1.0
"""A ray nearer to the horizon meets nothing."""


class Surface(Protocol):
    """The ground."""

    def usable(self, pose: Pose) -> bool:
        """Whether the pose says how high above this surface the camera is."""
        ...

    def meet(self, pose: Pose, rays: Rays) -> Points:
        """Points where rays meet it, metres north and east of the camera, (N, 2); NaN where they do not."""
        ...

    def below_m(self, pose: Pose, metres: Points) -> npt.NDArray[np.float64]:
        """The ground's depth below the camera, (N,), at ``metres`` north and east of it; NaN where not known."""
        ...


class FlatGround:
    """A plane ``height_m`` below the camera."""

    def usable(self, pose: Pose) -> bool:
        return pose.height_m is not None and pose.height_m > 0

    def meet(self, pose: Pose, rays: Rays) -> Points:
        assert pose.height_m is not None, "else it is not usable"
        falls = rays[:, 2] > np.linalg.norm(rays, axis=1) * math.sin(math.radians(LEAST_DEPRESSION_DEG))
        with np.errstate(divide="ignore", invalid="ignore"):
            metres = rays[:, :2] * (pose.height_m / rays[:, 2:])
        return np.where(falls[:, None], metres, np.nan)

    def below_m(self, pose: Pose, metres: Points) -> npt.NDArray[np.float64]:
        assert pose.height_m is not None, "else it is not usable"
        return np.full(len(metres), pose.height_m)


FLAT_GROUND: Final = FlatGround()
_CHI2_95: Final = 5.991
"""Chi-square of two degrees of freedom: the ellipse that holds 95 % (Abramowitz and Stegun, 26.4.9)."""
_FIELD_ERROR: Final = 0.02
"""Standard deviation of a field of view, as a share of it: the error of data sheets and stabilisation."""
_BOX_ERROR: Final = (0.15, 0.25)
"""Standard deviation of the point where an object stands, of its box's width and height."""
_LEAST_BOX_PX: Final = 1.0
_MOST_LATITUDE_DEG: Final = 89.8
"""22 km from a pole."""
_SURE: Final = 2.0
"""A ray nearer to the horizon than 2 standard deviations of the pitch tells no place."""


def at_a_pole(pose: Pose) -> bool:
    """Whether places around it have no degrees that a plane tells: they would lie beyond latitude 90."""
    return abs(pose.latitude_deg) > _MOST_LATITUDE_DEG


def ground_points(
    pose: Pose, points_px: Points, *, size: tuple[int, int], surface: Surface = FLAT_GROUND
) -> Points:
    """Points where rays of pixels meet the ground, metres north and east of the point below the camera, (N, 2).

    ``points_px`` (N, 2) are source pixels, (0, 0) the outer corner of the first one, of a picture of ``size`` (width,
    height). The optical axis goes through its middle; pixels are square; no lens distortion. NaN where a ray does
    not meet it. The pose has camera and field of view, and is `Surface.usable`.
    """
    return surface.meet(pose, _rays(pose, points_px, size=size))


def _rays(pose: Pose, points_px: Points, *, size: tuple[int, int]) -> Rays:
    camera, hfov_deg = pose.camera, pose.hfov_deg
    assert camera is not None, "there is no ray without"
    assert hfov_deg is not None
    yaw, pitch, roll = (math.radians(one) for one in (camera.yaw_deg, camera.pitch_deg, camera.roll_deg))
    # North, east, down: the directions of the axis, of right and of down in the picture.
    forward = np.array((math.cos(pitch) * math.cos(yaw), math.cos(pitch) * math.sin(yaw), -math.sin(pitch)))
    level_right = np.array((-math.sin(yaw), math.cos(yaw), 0.0))
    level_down = np.cross(forward, level_right)
    right = level_right * math.cos(roll) + level_down * math.sin(roll)
    down = level_down * math.cos(roll) - level_right * math.sin(roll)
    focal_px = size[0] / 2 / math.tan(math.radians(hfov_deg) / 2)
    x, y = points_px[:, 0] - size[0] / 2, points_px[:, 1] - size[1] / 2
    return focal_px * forward + x[:, None] * right + y[:, None] * down


def places_of_boxes(
    pose: Pose, boxes_base_px: Boxes, *, view: View, surface: Surface = FLAT_GROUND
) -> Places | None:
    """Places of the objects in (N, 4) boxes, with the ellipse that holds each with 95 %.

    An object is taken to stand at the lower edge of its box where the camera looks along the ground, in the middle
    where it looks straight down, and between the two otherwise. The ellipse comes from the errors of the pose, of the
    field of view and of the box, by the effect of each alone on the place (error propagation, JCGM 100, 5.1). None
    where the pose does not say height, direction or field of view, or is at a pole; NaN for an object at or near the
    horizon.
    """
    if pose.camera is None or pose.hfov_deg is None or at_a_pole(pose) or not surface.usable(pose):
        return None
    boxes = view.to_source(boxes_base_px).astype(np.float64)
    focal_px = view.source_size[0] / 2 / math.tan(math.radians(pose.hfov_deg) / 2)
    points = _standing(pose, boxes, focal_px=focal_px, size=view.source_size)
    at = partial(ground_points, size=view.source_size, surface=surface)
    metres = at(pose, points)
    covariance = np.zeros((len(boxes), 2, 2))
    covariance[:, 0, 0] = covariance[:, 1, 1] = pose.position_error_m**2
    for effect in _effects(at, pose, points, sides=boxes[:, 2:] - boxes[:, :2]):
        covariance += effect[:, :, None] * effect[:, None, :]
    # One that looks higher than it says, by more than happens as a rule, is to see ground there all the same.
    highest = at(_turned(pose, pitch_deg=_SURE * pose.angle_error_deg), points)
    whole = np.isfinite(np.concatenate((highest, covariance.reshape(-1, 4)), axis=1))
    known = np.asarray(whole.all(axis=1), np.bool_)
    values, vectors = np.linalg.eigh(np.where(known[:, None, None], covariance, np.eye(2)))
    half_axes = np.sqrt(_CHI2_95 * np.maximum(values[:, ::-1], 0.0))
    azimuth = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])) % 180
    north_m, east_m = metres_per_degree(pose.latitude_deg)
    places = np.stack(
        (
            pose.latitude_deg + metres[:, 0] / north_m,
            wrap_180(pose.longitude_deg + metres[:, 1] / max(east_m, 1e-6)),
        ),
        axis=1,
    )
    places[~known] = np.nan
    ellipses = np.column_stack((half_axes, azimuth))
    ellipses[~known] = np.nan
    return Places(places, ellipses)


def _standing(
    pose: Pose, boxes: npt.NDArray[np.float64], *, focal_px: float, size: tuple[int, int]
) -> Points:
    # The point of each box where its object touches the ground, (N, 2) source pixels.
    assert pose.camera is not None
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    depression = np.clip(
        -math.radians(pose.camera.pitch_deg) + np.arctan2(middle[:, 1] - size[1] / 2, focal_px),
        0,
        math.pi / 2,
    )
    # Down in the world is down in the picture where it is not rolled.
    roll = math.radians(pose.camera.roll_deg)
    reach = (boxes[:, 3] - boxes[:, 1]) / 2 * np.cos(depression)
    return middle + np.stack((reach * math.sin(roll), reach * math.cos(roll)), axis=1)


def _turned(pose: Pose, **degrees: float) -> Pose:
    assert pose.camera is not None
    angles = {name: getattr(pose.camera, name) + step for name, step in degrees.items()}
    return replace(pose, camera=replace(pose.camera, **angles))


def _raised(pose: Pose, metres: float) -> Pose:
    height_m, altitude_m = (
        None if value is None else value + metres for value in (pose.height_m, pose.altitude_m)
    )
    return replace(pose, height_m=height_m, altitude_m=altitude_m)


def _effects(
    at: Callable[[Pose, Points], Points], pose: Pose, points: Points, *, sides: Points
) -> list[Points]:
    # Metres by which one standard deviation of each source of error moves the places, (N, 2) each.
    height_step, angle, hfov_deg = pose.height_error_m, pose.angle_error_deg, pose.hfov_deg
    assert hfov_deg is not None, "there is no ray without"
    field_step = hfov_deg * _FIELD_ERROR
    pairs = [
        (_raised(pose, height_step), _raised(pose, -height_step)),
        (replace(pose, hfov_deg=hfov_deg + field_step), replace(pose, hfov_deg=hfov_deg - field_step)),
        *(
            (_turned(pose, **{name: angle}), _turned(pose, **{name: -angle}))
            for name in ("yaw_deg", "pitch_deg", "roll_deg")
        ),
    ]
    effects = [(at(more, points) - at(less, points)) / 2 for more, less in pairs]
    for axis, share in enumerate(_BOX_ERROR):
        shift = np.zeros_like(points)
        shift[:, axis] = np.maximum(_LEAST_BOX_PX, share * sides[:, axis])
        effects.append((at(pose, points + shift) - at(pose, points - shift)) / 2)
    return effects


@dataclass(frozen=True, slots=True)
class SurfaceLocator(Locator):
    """On this surface."""

    surface: Surface = FLAT_GROUND

    def places(self, pose: Pose, boxes_base_px: Boxes, view: View) -> Places | None:
        return places_of_boxes(pose, boxes_base_px, view=view, surface=self.surface)

    def footprint(self, pose: Pose, view: View) -> Footprint | None:
        return footprint(pose, view, surface=self.surface)


def footprint(pose: Pose, view: View, *, surface: Surface = FLAT_GROUND) -> Footprint | None:
    """The footprint of a picture; None without height, direction or field of view, or with the centre in the sky."""
    if pose.camera is None or pose.hfov_deg is None or at_a_pole(pose) or not surface.usable(pose):
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
