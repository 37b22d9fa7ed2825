"""Course and speed of an object that is placed now and then: known once it has moved by more than its error."""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from hvt_common.geodesy import metres_per_degree, turned_deg
from hvt_common.units import SECOND_NS
from hvt_gateways.cot.event import Motion

_WINDOW_NS: Final = 10 * SECOND_NS
_LEAST_NS: Final = SECOND_NS
_MOST_PLACES: Final = 16

Place = tuple[float, float]
"""Latitude and longitude, degrees."""


class MotionTrail:
    """The places of one object over the last ten seconds. Time is an argument."""

    def __init__(self) -> None:
        self._places: deque[tuple[int, Place]] = deque(maxlen=_MOST_PLACES)

    def add(self, at_ns: int, place: Place, *, error_m: float) -> Motion | None:
        """Take a place of that time; the motion from the oldest one, None where it may have stood still.

        After one of a time far ahead, or where the clock was set back, it begins anew.
        """
        places = self._places
        if places and places[-1][0] - at_ns > _WINDOW_NS:
            places.clear()
        if places and at_ns <= places[-1][0]:
            return None
        places.append((at_ns, place))
        while at_ns - places[0][0] > _WINDOW_NS:
            places.popleft()
        since_ns = at_ns - places[0][0]
        if since_ns < _LEAST_NS:
            return None
        north_m, east_m = metres_between(places[0][1], place)
        way_m = math.hypot(north_m, east_m)
        if not way_m > error_m:
            return None
        course_deg = math.degrees(math.atan2(east_m, north_m)) % 360
        return Motion(course_deg, way_m / since_ns * SECOND_NS)


def metres_between(first: Place, second: Place) -> tuple[float, float]:
    """Metres north and east from one to the other, some kilometres at the most."""
    north, east = metres_per_degree(first[0])
    turned = turned_deg(second[1] - first[1])
    return (second[0] - first[0]) * north, turned * east
