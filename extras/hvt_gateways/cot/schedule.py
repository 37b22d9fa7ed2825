"""Which tracks are reported now: each at most once a second, and all of them within a rate.

| a track                                          | is due after |
|--------------------------------------------------|--------------|
| was never reported                               | nothing      |
| has moved, or is called something else           | 1 s          |
| is where it was                                  | 3 s          |

Of those that are due, refined ones go first, then the most confident ones.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from hvt_common.geodesy import metres_per_degree, wrap_180
from hvt_common.runtime.statistics import Newest
from hvt_common.units import SECOND_NS
from hvt_gateways.cot.event import Motion

STALE_NS: Final = 5 * SECOND_NS
"""A receiver takes an object for lost after this long without a report."""
_MOVED_NS: Final = SECOND_NS
_UNMOVED_NS: Final = 3 * SECOND_NS
_LEAST_MOVE: Final = 0.25
"""Share of the error: boxes tremble by less."""
_MOST_A_SECOND: Final = 50
_FORGOTTEN_NS: Final = 60 * SECOND_NS
_MOST_TRACKS: Final = 4096


@dataclass(frozen=True, slots=True)
class PlacedTrack:
    """A track that has a place."""

    track_id: int
    place: Place
    error_m: float
    name: str
    base_name: str
    confidence: float
    refined: bool
    sure: bool


@dataclass(frozen=True, slots=True)
class Reported:
    """The last report of a track."""

    at_ns: int
    place: Place
    name: str


class TrackSchedule:
    """Remembers each report and its time. Time is an argument, and rises."""

    def __init__(self, *, most_a_second: int = _MOST_A_SECOND) -> None:
        self._most = most_a_second
        self._tokens = float(most_a_second)
        self._refilled_ns: int | None = None
        self._reported: Newest[int, Reported] = Newest(_MOST_TRACKS)

    def due(self, tracks: Sequence[PlacedTrack], *, now_ns: int) -> list[PlacedTrack]:
        """Those to report now, the best first; they count as reported."""
        self._refill(now_ns)
        due = sorted(
            (one for one in tracks if self._is_due(one, now_ns)),
            key=lambda one: (not one.refined, -one.confidence, one.track_id),
        )[: int(self._tokens)]
        self._tokens -= len(due)
        for one in due:
            self._reported.put(one.track_id, Reported(now_ns, one.place, one.name))
        while self._reported and now_ns - next(iter(self._reported.values())).at_ns > _FORGOTTEN_NS:
            self._reported.popitem(last=False)
        return due

    def _refill(self, now_ns: int) -> None:
        if self._refilled_ns is not None:
            self._tokens += max(0, now_ns - self._refilled_ns) / SECOND_NS * self._most
        self._tokens = min(self._tokens, float(self._most))
        self._refilled_ns = now_ns

    def _is_due(self, track: PlacedTrack, now_ns: int) -> bool:
        before = self._reported.get(track.track_id)
        if before is None:
            return True
        since_ns = now_ns - before.at_ns
        if since_ns < _MOVED_NS:
            return False
        moved_m = math.hypot(*metres_between(before.place, track.place))
        changed = moved_m > _LEAST_MOVE * track.error_m or before.name != track.name
        return changed or since_ns >= _UNMOVED_NS


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
    turned = wrap_180(second[1] - first[1])
    return (second[0] - first[0]) * north, turned * east
