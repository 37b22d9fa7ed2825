"""One moment as a UAS Datalink local set (MISB ST 0601.16). Unknown values are left out.

Items are key, length, value (SMPTE ST 336). The tracks of one frame are a VMTI local set (MISB ST 0903.5), nested as
item 74: the class of a target is the detector's or the classifier's own word, as a VObject (item 102) with a class
and no ontology: there is none that knows these words.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from hvt_common.geodesy import wrap_180
from hvt_common.values import Orientation, Pose, View
from hvt_ground.events import Overlay
from hvt_ground.poses import NOWHERE, Footprint, Locator

_SHORT = 128
"""BER lengths and identifiers below take one byte (ITU-T X.690, 8.1.3)."""


def ber_length(size: int) -> bytes:
    """A length: one byte below 128, else how many bytes there are and those (ST 336; ST 0107)."""
    if size < _SHORT:
        return bytes((size,))
    data = whole(size)
    return bytes((0x80 | len(data),)) + data


def ber_oid(number: int) -> bytes:
    """A number from 0 on, seven bits a byte, the first ones first (ITU-T X.690, 8.19)."""
    data = [number & 0x7F]
    while number := number >> 7:
        data.append(0x80 | (number & 0x7F))
    return bytes(reversed(data))


def item(tag: int, value: bytes) -> bytes:
    return ber_oid(tag) + ber_length(len(value)) + value


def packet(key: bytes, items: Iterable[bytes]) -> bytes:
    """A set with its 16-byte key, and behind its items the checksum, item 1.

    The checksum is the sum of the 16-bit words from the key to its own length, modulo 2^16 (ST 0601, item 1).
    """
    body = b"".join(items) + b"\x01\x02"
    data = key + ber_length(len(body) + 2) + body
    padded = data + bytes(len(data) % 2)
    return data + (sum(memoryview(padded)[::2]) * 256 + sum(memoryview(padded)[1::2]) & 0xFFFF).to_bytes(2)


def whole(number: int) -> bytes:
    """A number from 0 on, in as few bytes as hold it."""
    return number.to_bytes(max(1, (number.bit_length() + 7) // 8))


def signed(value: float, limit: float, *, size: int) -> bytes:
    """From -limit … limit onto -(2^(8·size-1)-1) … 2^(8·size-1)-1 (ST 0601, items 6, 13 and others).

    A value out of range becomes the lowest integer, which means "out of range" or an error.
    """
    top = (1 << (8 * size - 1)) - 1
    if not abs(value) <= limit:
        return (-top - 1).to_bytes(size, signed=True)
    return round(value * top / limit).to_bytes(size, signed=True)


def unsigned(value: float, low: float, high: float, *, size: int) -> bytes:
    """From low … high onto 0 … 2^(8·size)-1 (ST 0601, items 5, 15 and others); empty out of range: it has no code."""
    if not low <= value <= high:
        return b""
    return round((value - low) * ((1 << (8 * size)) - 1) / (high - low)).to_bytes(size)


def imapb(value: float, low: float, high: float, *, size: int) -> bytes:
    """ST 1201, 'Starting Point B'; empty out of range."""
    if not low <= value <= high:
        return b""
    scale = 2.0 ** (8 * size - 1 - math.ceil(math.log2(high - low)))
    offset = scale * low - math.floor(scale * low) if low < 0 < high else 0.0
    return math.floor(scale * (value - low) + offset).to_bytes(size)


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
    offsets = [(north - latitude, wrap_180(east - longitude)) for north, east in ground.corners]
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


MOST_BYTES: Final = 48 * 1024
"""Limit of all targets: a PES packet holds 64 kB."""
_SYSTEM: Final = b"HVT"
_VMTI_VERSION: Final = 5
_MOST_COUNT: Final = 0xFFFFFF
_OFFSET_DEG: Final = 19.2
_LONGEST_CLASS: Final = 127


def vmti_local_set(
    overlay: Overlay, *, size: tuple[int, int], centre: tuple[float, float] | None, time: bytes
) -> bytes:
    """The value of item 74, without key and checksum, as it is nested.

    ``size`` is (width, height) of the picture, base pixels. Places are offsets (items 10 and 11) from ``centre``, the
    frame centre of the set around it, latitude and longitude in degrees; None leaves them out. (Item 17 would need a
    height above the ellipsoid, which nobody knows.) ``time`` is the precision time stamp.

    Tracks that stills doubt are counted (item 5) but not reported (item 6), and so are those for which there is no
    room, the least sure ones.
    """
    rows = np.flatnonzero(~overlay.doubted)
    targets: dict[int, bytes] = {}
    left_bytes = MOST_BYTES
    for row in sorted(rows.tolist(), key=lambda one: -float(overlay.confidences[one])):
        target = _target(overlay, row, size=size, centre=centre)
        left_bytes -= len(target)
        if left_bytes < 0:
            break
        targets[row] = target
    items = [
        item(2, time),
        item(3, _SYSTEM),
        item(4, whole(_VMTI_VERSION)),
        item(5, whole(min(len(overlay.track_ids), _MOST_COUNT))),
        item(6, whole(len(targets))),
        item(7, whole(overlay.frame_index & _MOST_COUNT)),
        item(8, whole(size[0])),
        item(9, whole(size[1])),
    ]
    if targets:
        items.append(item(101, b"".join(targets[row] for row in sorted(targets))))
    return b"".join(items)


def _target(
    overlay: Overlay, row: int, *, size: tuple[int, int], centre: tuple[float, float] | None
) -> bytes:
    """One VTarget pack with its length."""
    x1, y1, x2, y2 = overlay.boxes_base_px[row].tolist()
    items = [
        item(1, _pixel((x1 + x2) / 2, (y1 + y2) / 2, size=size)),
        item(2, _pixel(x1, y1, size=size)),
        item(3, _pixel(math.ceil(x2) - 1, math.ceil(y2) - 1, size=size)),
        item(5, whole(round(100 * min(max(float(overlay.confidences[row]), 0.0), 1.0)))),
    ]
    if centre is not None and overlay.places is not None:
        latitude, longitude = overlay.places.places_deg[row].tolist()
        across = wrap_180(longitude - centre[1])
        offsets = [imapb(one, -_OFFSET_DEG, _OFFSET_DEG, size=3) for one in (latitude - centre[0], across)]
        if all(offsets):
            items += [item(10, offsets[0]), item(11, offsets[1])]
    name = overlay.words[row].encode()[:_LONGEST_CLASS].decode(errors="ignore").encode()
    items.append(item(102, item(2, name)))
    pack = ber_oid(max(0, int(overlay.track_ids[row]))) + b"".join(items)
    return ber_length(len(pack)) + pack


def _pixel(x: float, y: float, *, size: tuple[int, int]) -> bytes:
    """The number of the pixel that a point lies in: from 1 at the top left, row by row (ST 0903, VTarget item 1)."""
    column, line = (
        min(max(math.floor(value), 0), side - 1) for value, side in zip((x, y), size, strict=True)
    )
    return whole(column + 1 + line * size[0])
