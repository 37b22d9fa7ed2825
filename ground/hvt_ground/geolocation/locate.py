"""The geolocation of one session: poses come in, the places of tracks go out."""

from __future__ import annotations

import threading
from dataclasses import replace

from hvt_common.protocol.messages import PoseDecoder, PoseReport
from hvt_common.values import Pose, View
from hvt_ground.events import Overlay
from hvt_ground.geolocation.camera import places_of_boxes
from hvt_ground.geolocation.surface import FLAT_GROUND, Surface
from hvt_ground.geolocation.trail import STALE_S, PoseTrail


class Geolocation:
    """Takes poses in one thread, and overlays in another: these by the poses that `use` was told of."""

    def __init__(self, view: View, *, surface: Surface = FLAT_GROUND) -> None:
        self._view = view
        self._surface = surface
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
        """Locate by this pose from now on."""
        with self._lock:
            self._used.add(pose)
        self.has_pose = True

    @property
    def newest(self) -> Pose | None:
        """The last pose that came."""
        return self._trail.newest

    def stale_s(self, capture_ns: int) -> float | None:
        """The age of the newest pose where it is too old to use; None where it is not, or none ever came."""
        age_s = self._trail.age_s(capture_ns)
        return age_s if age_s is not None and age_s > STALE_S else None

    def turned_stale(self, capture_ns: int) -> bool | None:
        """True once when the pose has become stale, False once when there is one again, None otherwise."""
        stale = self.stale_s(capture_ns) is not None
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
        places = places_of_boxes(pose, overlay.boxes_base_px, view=self._view, surface=self._surface)
        return overlay if places is None else replace(overlay, places=places)
