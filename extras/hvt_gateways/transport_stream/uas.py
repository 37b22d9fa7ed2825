"""One moment as a UAS Datalink local set (MISB ST 0601.16). Unknown values are left out."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from hvt_common.geodesy import turned_deg
from hvt_common.values import Orientation, Pose, View
from hvt_gateways.transport_stream.klv import item, packet, signed, unsigned
from hvt_gateways.transport_stream.vmti import vmti_local_set
from hvt_ground.events import Overlay
from hvt_ground.poses import NOWHERE, Footprint, Locator

KEY: Final = bytes.fromhex("060e2b34020b01010e01030101000000")
_VERSION: Final = 16
_WGS_84: Final = b"Geodetic WGS84"
_LATEST_US: Final = (1 << 64) - 1
_LOWEST_M, _HIGHEST_M = -900.0, 19_000.0
_FARTHEST_M: Final = 5_000_000.0
_SHORT_PITCH_DEG, _SHORT_ROLL_DEG = 20.0, 50.0
_CORNER_DEG: Final = 0.075
_STRAIGHT: Final = 1e-6
"""Cosine of an elevation at which azimuth and roll are one turn."""


@dataclass(frozen=True, slots=True)
class Platform:
    """Whose pictures they are."""

    edge: str
    session: str
    view: View
    locator: Locator = NOWHERE


def uas_local_set(
    platform: Platform, *, capture_ns: int, pose: Pose | None, overlay: Overlay | None
) -> bytes:
    """The whole packet, key and checksum included.

    ``capture_ns`` is the moment, by the edge's clock (item 2); ``pose`` is that of the moment. ``overlay`` becomes a
    VMTI local set (item 74).
    """
    time = min(max(capture_ns // 1000, 0), _LATEST_US).to_bytes(8)
    items = [
        item(2, time),
        item(3, platform.session.encode()),
        item(10, platform.edge.encode()),
        item(65, bytes((_VERSION,))),
    ]
    ground = None
    if pose is not None:
        ground = platform.locator.footprint(pose, platform.view)
        items += [item(tag, value) for tag, value in _pose_items(pose, platform.view, ground) if value]
    if overlay is not None:
        centre = None if ground is None else ground.centre
        nested = vmti_local_set(overlay, size=platform.view.base_size, centre=centre, time=time)
        items.append(item(74, nested))
    return packet(KEY, items)


def fields_of_view(pose: Pose, view: View) -> tuple[float, float] | None:
    """The fields of view of the base picture, degrees: across and up; None if the pose lacks that of the source."""
    if pose.hfov_deg is None:
        return None
    half = math.tan(math.radians(pose.hfov_deg) / 2) / (view.source_size[0] / 2)
    across, up = (math.degrees(2 * math.atan(side / view.scale / 2 * half)) for side in view.base_size)
    return across, up


def sensor_angles(camera: Orientation, platform: Orientation) -> tuple[float, float, float]:
    """Azimuth, elevation and roll of the camera as its platform has it, degrees (ST 0601, items 18 to 20).

    The three turn the platform's axes into the camera's, in this order. Straight up or down the roll is 0.
    """
    turn = _axes(platform).T @ _axes(camera)
    elevation = math.asin(min(1.0, max(-1.0, -float(turn[2, 0]))))
    if math.cos(elevation) > _STRAIGHT:
        azimuth, roll = math.atan2(turn[1, 0], turn[0, 0]), math.atan2(turn[2, 1], turn[2, 2])
    else:
        azimuth, roll = math.atan2(-turn[0, 1], turn[1, 1]), 0.0
    azimuth_deg, roll_deg = (math.degrees(one) % 360 % 360 for one in (azimuth, roll))
    # Once is not enough: -1e-16 % 360 is 360.
    return azimuth_deg, math.degrees(elevation), roll_deg


def _axes(one: Orientation) -> npt.NDArray[np.float64]:
    """(3, 3): columns are its forward, right and down, as north, east, down."""
    (sy, cy), (sp, cp), (sr, cr) = (
        (math.sin(angle), math.cos(angle))
        for angle in map(math.radians, (one.yaw_deg, one.pitch_deg, one.roll_deg))
    )
    return np.array(
        (
            (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
            (-sp, cp * sr, cp * cr),
        )
    )


def _pose_items(pose: Pose, view: View, ground: Footprint | None) -> Iterator[tuple[int, bytes]]:
    """Tags and values; a value is empty where the standard has no code for it."""
    if pose.platform is not None:
        yield from _platform_items(pose.platform)
    yield 12, _WGS_84
    yield 13, signed(pose.latitude_deg, 90, size=4)
    yield 14, signed(pose.longitude_deg, 180, size=4)
    if pose.altitude_m is not None:
        yield 15, _altitude(pose.altitude_m)
    if (fields := fields_of_view(pose, view)) is not None:
        yield 16, unsigned(fields[0], 0, 180, size=2)
        yield 17, unsigned(fields[1], 0, 180, size=2)
    if pose.camera is not None and pose.platform is not None:
        azimuth, elevation, roll = sensor_angles(pose.camera, pose.platform)
        yield 18, unsigned(azimuth, 0, 360, size=4)
        yield 19, signed(elevation, 180, size=4)
        yield 20, unsigned(roll, 0, 360, size=4)
    if ground is not None:
        yield from _ground_items(pose, ground)


def _platform_items(platform: Orientation) -> Iterator[tuple[int, bytes]]:
    """Items 5 to 7; a drone that leans more than an aeroplane does has 90 and 91 in place of 6 and 7."""
    yield 5, unsigned(platform.yaw_deg % 360, 0, 360, size=2)
    pitch, roll = platform.pitch_deg, platform.roll_deg
    if abs(pitch) <= _SHORT_PITCH_DEG:
        yield 6, signed(pitch, _SHORT_PITCH_DEG, size=2)
    else:
        yield 90, signed(pitch, 90, size=4)
    if abs(roll) <= _SHORT_ROLL_DEG:
        yield 7, signed(roll, _SHORT_ROLL_DEG, size=2)
    else:
        yield 91, signed(roll, 90, size=4)


def _ground_items(pose: Pose, ground: Footprint) -> Iterator[tuple[int, bytes]]:
    """Items 21 and 23 to 33; corners too far from the centre for these are items 82 to 89."""
    latitude, longitude = ground.centre
    yield 21, unsigned(ground.slant_m, 0, _FARTHEST_M, size=4)
    yield 23, signed(latitude, 90, size=4)
    yield 24, signed(longitude, 180, size=4)
    if pose.altitude_m is not None:
        yield 25, _altitude(pose.altitude_m - ground.below_m)
    if ground.corners is None:
        return
    offsets = [(north - latitude, turned_deg(east - longitude)) for north, east in ground.corners]
    if all(abs(one) <= _CORNER_DEG for offset in offsets for one in offset):
        for number, offset in enumerate(offsets):
            yield 26 + 2 * number, signed(offset[0], _CORNER_DEG, size=2)
            yield 27 + 2 * number, signed(offset[1], _CORNER_DEG, size=2)
        return
    for number, corner in enumerate(ground.corners):
        yield 82 + 2 * number, signed(corner[0], 90, size=4)
        yield 83 + 2 * number, signed(corner[1], 180, size=4)


def _altitude(metres: float) -> bytes:
    """Metres above mean sea level (items 15 and 25)."""
    return unsigned(metres, _LOWEST_M, _HIGHEST_M, size=2)
