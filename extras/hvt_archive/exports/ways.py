"""A way over the earth, and its geometry in GeoJSON: a line, in parts where it crosses the antimeridian."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final

from hvt_common.geodesy import turned_deg

_DIGITS: Final = 7
"""Digits of degrees: a centimetre."""


@dataclass(frozen=True, slots=True)
class Fix:
    """A place of a way."""

    capture_ns: int
    longitude_deg: float
    latitude_deg: float
    height_m: float | None = None
    """Above the ground."""

    @property
    def position(self) -> list[float]:
        """A position for GeoJSON."""
        return [round(self.longitude_deg, _DIGITS), round(self.latitude_deg, _DIGITS)]


def line(parts: Sequence[Sequence[Fix]]) -> dict[str, Any]:
    """A LineString, or a MultiLineString of several parts."""
    lines = [[one.position for one in part] for part in parts]
    if len(lines) == 1:
        return {"type": "LineString", "coordinates": lines[0]}
    return {"type": "MultiLineString", "coordinates": lines}


def parts_of(way: Sequence[Fix]) -> list[list[Fix]]:
    """The way, with an end at the antimeridian and a beginning on its other side each time that it crosses it.

    RFC 7946, 3.1.9: a reader would draw the line around the earth.
    """
    parts = [[way[0]]]
    for before, after in pairwise(way):
        if abs(after.longitude_deg - before.longitude_deg) > 180:
            side_deg = math.copysign(180.0, before.longitude_deg)
            crossing = _crossing(before, after, side_deg)
            parts[-1].append(crossing)
            parts.append([replace(crossing, longitude_deg=-side_deg)])
        parts[-1].append(after)
    return parts


def _crossing(before: Fix, after: Fix, side_deg: float) -> Fix:
    """Between two places, where the line through them is at 180 or -180 degrees."""
    across_deg = turned_deg(after.longitude_deg - before.longitude_deg)
    share = (side_deg - before.longitude_deg) / across_deg if across_deg else 0.0
    heights = before.height_m, after.height_m
    return Fix(
        before.capture_ns + round(share * (after.capture_ns - before.capture_ns)),
        side_deg,
        before.latitude_deg + share * (after.latitude_deg - before.latitude_deg),
        None if heights[0] is None or heights[1] is None else heights[0] + share * (heights[1] - heights[0]),
    )
