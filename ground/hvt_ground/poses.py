"""The poses of one session, the pose of a moment between or shortly after them, and places that an extra derives."""

from __future__ import annotations

import math
import threading
from bisect import bisect_right
from dataclasses import dataclass, replace
from typing import Final

from hvt_common.geodesy import interpolate, metres_per_degree, wrap_180
from hvt_common.protocol.messages import PoseDecoder, PoseReport
from hvt_common.units import SECOND_NS
from hvt_common.values import Boxes, Orientation, Pose, View
from hvt_ground.events import Overlay, Places

STALE_S: Final = 10.0
"""A pose this old is none."""
_MOST_POSES: Final = 64
"""A minute of them: pictures are not shown later than that."""
_ANEW_AFTER: Final = 5
"""After 5 poses without a newer one they begin anew: the newest may be forged, or the edge's clock set back."""
_DRIFT: Final = 0.5
"""Standard deviation of a change of motion, as a share of the motion in as long a time."""


class PoseTrail:
    """Takes poses as they come, and remembers the last ``most``."""

    def __init__(self, *, most: int = _MOST_POSES) -> None:
        self._most = most
        self._poses: list[Pose] = []
        self._times: list[int] = []
        self._refused = 0

    def add(self, pose: Pose) -> bool:
        """Take a pose; False for one that is not newer than the last."""
        if self._poses and pose.capture_ns <= self._poses[-1].capture_ns:
            self._refused += 1
            if self._refused < _ANEW_AFTER:
                return False
            self._poses, self._times = [], []
        self._refused = 0
        self._poses.append(pose)
        self._times.append(pose.capture_ns)
        if len(self._poses) > self._most:
            del self._poses[0], self._times[0]
        return True

    @property
    def newest(self) -> Pose | None:
        poses = self._poses
        return poses[-1] if poses else None

    def at(self, capture_ns: int) -> Pose | None:
        """The pose of a moment; None where the nearest before it is stale.

        Between two it is on the line from one to the other. After the last one it goes on as it did before, and its
        errors grow with the time since.
        """
        poses = self._poses
        after = bisect_right(self._times, capture_ns)
        if after == 0:
            return poses[0] if poses and poses[0].capture_ns - capture_ns < SECOND_NS else None
        last = poses[after - 1]
        age_ns = capture_ns - last.capture_ns
        if age_ns > STALE_S * SECOND_NS:
            return None
        if after < len(poses):
            later = poses[after]
            if later.capture_ns - last.capture_ns <= STALE_S * SECOND_NS:
                return interpolate(last, later, capture_ns)
        if after < 2 or age_ns == 0:
            return replace(last, capture_ns=capture_ns)
        return _continued(poses[after - 2], last, capture_ns)


def _continued(before: Pose, last: Pose, capture_ns: int) -> Pose:
    lasted_ns = last.capture_ns - before.capture_ns
    age_ns = capture_ns - last.capture_ns
    if lasted_ns > STALE_S * SECOND_NS:
        return replace(last, capture_ns=capture_ns)
    ahead = interpolate(before, last, last.capture_ns + min(age_ns, SECOND_NS))
    share = _DRIFT * age_ns / lasted_ns
    north_m, east_m = metres_per_degree(last.latitude_deg)
    way_m = math.hypot(
        (last.latitude_deg - before.latitude_deg) * north_m,
        wrap_180(last.longitude_deg - before.longitude_deg) * east_m,
    )
    climbed_m = abs((last.height_m or 0.0) - (before.height_m or 0.0))
    return replace(
        last,
        capture_ns=capture_ns,
        latitude_deg=ahead.latitude_deg,
        longitude_deg=ahead.longitude_deg,
        height_m=last.height_m if ahead.height_m is None else ahead.height_m,
        altitude_m=last.altitude_m if ahead.altitude_m is None else ahead.altitude_m,
        camera=ahead.camera or last.camera,
        platform=ahead.platform or last.platform,
        position_error_m=math.hypot(last.position_error_m, share * way_m),
        height_error_m=math.hypot(last.height_error_m, share * climbed_m),
        angle_error_deg=math.hypot(last.angle_error_deg, share * _turn_deg(before.camera, last.camera)),
    )


def _turn_deg(first: Orientation | None, second: Orientation | None) -> float:
    if first is None or second is None:
        return 0.0
    changes = (
        wrap_180(second.yaw_deg - first.yaw_deg),
        second.pitch_deg - first.pitch_deg,
        wrap_180(second.roll_deg - first.roll_deg),
    )
    return max(abs(one) for one in changes)


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


class Locator:
    """Where the pictures of one flight lie on the ground; this one places nothing, where no extra does."""

    def places(self, pose: Pose, boxes_base_px: Boxes, view: View) -> Places | None:  # noqa: ARG002
        """Places of the objects in (N, 4) boxes; None where the pose does not say enough."""
        return None

    def footprint(self, pose: Pose, view: View) -> Footprint | None:  # noqa: ARG002
        """The footprint of a picture; None where the pose does not say enough, or the centre is in the sky."""
        return None


NOWHERE: Final = Locator()


class SessionPoses:
    """Takes poses in one thread, and overlays in another: these by the poses that `use` was told of."""

    def __init__(self, view: View, *, locator: Locator = NOWHERE) -> None:
        self._view = view
        self._locator = locator
        self._decoder = PoseDecoder()
        self._trail = PoseTrail()
        self._used = PoseTrail()
        self._stale = False
        self.has_pose = False
        """Whether one is used: without, there are no places to ask for."""
        self._lock = threading.Lock()

    def report(self, report: PoseReport) -> Pose | None:
        """Take a report; its pose, or None where it builds on one that did not come or is not newer.

        Raises `WireError` where its bits make no sense.
        """
        pose = self._decoder.decode(report)
        return None if pose is None or not self._trail.add(pose) else pose

    def use(self, pose: Pose) -> None:
        with self._lock:
            self._used.add(pose)
        self.has_pose = True

    @property
    def newest(self) -> Pose | None:
        return self._trail.newest

    def turned_stale(self, capture_ns: int) -> bool | None:
        """True once when the pose has become stale, False once when there is one again, None otherwise."""
        newest = self.newest
        stale = newest is not None and capture_ns - newest.capture_ns > STALE_S * SECOND_NS
        if stale is self._stale:
            return None
        self._stale = stale
        return stale

    def located(self, overlay: Overlay) -> Overlay:
        """The overlay with the places of its tracks; as it is where no pose tells."""
        with self._lock:
            pose = self._used.at(overlay.capture_ns)
        if pose is None:
            return overlay
        places = self._locator.places(pose, overlay.boxes_base_px, self._view)
        return overlay if places is None else replace(overlay, places=places)
