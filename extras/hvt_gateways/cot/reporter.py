"""From the events of a session to Cursor on Target: its platform with the field of view, and its tracks as atoms."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Final

import numpy as np

from hvt_common.protocol.channels import Channel
from hvt_common.protocol.messages import Info
from hvt_common.runtime.statistics import Newest
from hvt_common.units import SECOND_NS
from hvt_common.values import Pose, View
from hvt_gateways.cot.event import CotEvent, CotMessage, Motion, Parent, Point, Sensor, TypeTable
from hvt_gateways.cot.schedule import STALE_NS, MotionTrail, PlacedTrack, TrackSchedule
from hvt_ground.events import Event, MessageTiming, Overlay, PoseUpdate, Refinement
from hvt_ground.sinks import Sink, SinkWriter

_log = logging.getLogger(__name__)

_CIRCLE_95: Final = 2.448
"""Radius that holds 95 % of a circular normal distribution, in standard deviations along an axis."""
_PLATFORM_NS: Final = SECOND_NS * 9 // 10
"""Poses come once a second, a little early or late."""
_PLATFORM_STALE_NS: Final = 15 * SECOND_NS
"""More than the 10 s after which a pose is stale, because a report may be lost."""
_NOTICE_NS: Final = 10 * SECOND_NS
_MOST_RANGE_M: Final = 5000.0
_LEAST_DEPRESSION_DEG: Final = 1.0
_MOST_TRACKS: Final = 4096
_HOW_PLATFORM, _HOW_TRACK = "m-g", "m-f"
"""A machine says it: by satellite navigation, and fused from that and from pictures."""


class SessionReporter(SinkWriter[Event]):
    """Reports one session to ``targets``; ``clock`` is the ground's, ``wall_ns`` the time of receivers.

    Stored events, and those older than their time to go stale, are not reported. A track that is lost is
    not reported any more and goes stale by itself, as all do when the session ends.
    """

    def __init__(
        self,
        info: Info,
        targets: Sequence[Sink[CotMessage]],
        *,
        types: TypeTable,
        clock: Callable[[], int],
        wall_ns: Callable[[], int] = time.time_ns,
        still_address: Callable[[Refinement], str],
    ) -> None:
        self._info = info
        self._targets = targets
        self._types = types
        self._clock = clock
        self._wall_ns = wall_ns
        self._still_address = still_address
        self._platform = Parent(f"hvt-{info.edge}", types.of_edge(info.edge), info.edge)
        self._track_uid = f"hvt-{info.edge}-{info.session_id & 0xFFFFFFFF:08x}"
        """With the session's id: a track of the next session is another object."""
        self._offset_ns = 0
        self._schedule = TrackSchedule()
        self._motions: Newest[int, MotionTrail] = Newest(_MOST_TRACKS)
        self._stills: Newest[int, str] = Newest(_MOST_TRACKS)
        """The address of the newest still by track."""
        self._platform_trail = MotionTrail()
        self._platform_ns: int | None = None
        """When it was reported."""
        self._pose: Pose | None = None
        """The last one."""
        self._unplaced_ns: int | None = None
        """When the first tracks came, until some have a place."""
        self._noted = False

    def log(self, item: Event) -> None:
        """Report an event as far as Cursor on Target can."""
        match item:
            case MessageTiming(kind=Channel.BASE):
                self._offset_ns = item.clock_offset_ns
            case PoseUpdate():
                self._pose = item.pose
                self._report_platform(item)
            case Overlay(stored=False):
                self._report_tracks(item)
            case Refinement(stored=False, track_id=int(track_id)):
                address = self._still_address(item)
                if address:
                    self._stills.put(track_id, address)

    def _age_ns(self, capture_ns: int) -> int:
        """The age since capture. In lockstep capture is media time: there everything is from now."""
        if self._info.pace == "lockstep":
            return 0
        return max(0, self._clock() - (capture_ns - self._offset_ns))

    def _report_platform(self, update: PoseUpdate) -> None:
        now_ns, age_ns, pose = self._clock(), self._age_ns(update.capture_ns), update.pose
        error_m = _CIRCLE_95 * pose.position_error_m
        place = (pose.latitude_deg, pose.longitude_deg)
        motion = self._platform_trail.add(pose.capture_ns, place, error_m=error_m)
        early = self._platform_ns is not None and now_ns - self._platform_ns < _PLATFORM_NS
        if early or age_ns > _PLATFORM_STALE_NS:
            return
        self._platform_ns = now_ns
        made_ns = self._wall_ns()
        self._send(
            CotEvent(
                uid=self._platform.uid,
                type=self._platform.type,
                how=_HOW_PLATFORM,
                time_ns=made_ns,
                start_ns=made_ns - age_ns,
                stale_ns=made_ns - age_ns + _PLATFORM_STALE_NS,
                point=Point(*place, ce_m=error_m),
                callsign=self._platform.callsign,
                remarks=_platform_remarks(pose),
                motion=motion,
                sensor=sensor_of(pose, update.view),
            )
        )

    def _report_tracks(self, overlay: Overlay) -> None:
        tracks = list(placed_tracks(overlay))
        self._note_unplaced(overlay, placed=bool(tracks))
        age_ns = self._age_ns(overlay.capture_ns)
        if age_ns > STALE_NS:
            return
        made_ns = self._wall_ns()
        for track in self._schedule.due(tracks, now_ns=self._clock()):
            trail = self._motions.get(track.track_id) or MotionTrail()
            self._motions.put(track.track_id, trail)
            motion = trail.add(overlay.capture_ns, track.place, error_m=track.error_m)
            self._send(self._event_of(track, motion, made_ns=made_ns, age_ns=age_ns))

    def _event_of(self, track: PlacedTrack, motion: Motion | None, *, made_ns: int, age_ns: int) -> CotEvent:
        still = self._stills.get(track.track_id, "") if track.refined else ""  # of its own object
        return CotEvent(
            uid=f"{self._track_uid}-{track.track_id}",
            type=self._types.of_class(track.name),
            how=_HOW_TRACK,
            time_ns=made_ns,
            start_ns=made_ns - age_ns,
            stale_ns=made_ns - age_ns + STALE_NS,
            point=Point(*track.place, ce_m=track.error_m),
            callsign=f"{track.name[:40]} {track.track_id}",
            remarks=_track_remarks(track, still=still),
            motion=motion,
            parent=self._platform,
            url=still if "://" in still else "",
        )

    def _note_unplaced(self, overlay: Overlay, *, placed: bool) -> None:
        """Say once where tracks go without a place for long: who watches the map waits for them."""
        if self._noted or not len(overlay.track_ids):
            return
        if placed:
            self._noted = True
            return
        now_ns = self._clock()
        if self._unplaced_ns is None:
            self._unplaced_ns = now_ns
        elif now_ns - self._unplaced_ns > _NOTICE_NS:
            self._noted = True
            why = _why_unplaced(self._pose)
            _log.warning("CoT of %s: its tracks are not reported, because %s", self._info.edge, why)

    def _send(self, event: CotEvent) -> None:
        message = event.message()
        for target in self._targets:
            target.log(message)


def placed_tracks(overlay: Overlay) -> Iterator[PlacedTrack]:
    """The tracks that have a place, but those of which stills say that they are nothing of mine."""
    places = overlay.places
    if places is None:
        return
    known = np.isfinite(places.places_deg).all(axis=1) & np.isfinite(places.ellipses[:, 0])
    words = overlay.words
    for row in np.flatnonzero(known & ~overlay.doubted).tolist():
        latitude, longitude = places.places_deg[row].tolist()
        yield PlacedTrack(
            track_id=int(overlay.track_ids[row]),
            place=(latitude, longitude),
            error_m=float(places.ellipses[row, 0]),
            name=words[row],
            base_name=words[row] if overlay.vague[row] else overlay.base_classes[row],
            confidence=float(overlay.confidences[row]),
            refined=bool(overlay.refined[row]),
            sure=bool(overlay.sure[row]),
        )


def sensor_of(pose: Pose, view: View) -> Sensor | None:
    """The place that the camera looks at; None without direction or field of view.

    Its range is where the middle of the picture's upper edge meets flat ground, 5 km at the most.
    """
    if pose.camera is None or pose.hfov_deg is None:
        return None
    width, height = view.source_size
    tangent = math.tan(math.radians(pose.hfov_deg) / 2) * height / width
    vfov_deg = 2 * math.degrees(math.atan(tangent))
    range_m = None
    if pose.height_m is not None and pose.height_m > 0:
        down_deg = -(pose.camera.pitch_deg + vfov_deg / 2)
        range_m = _MOST_RANGE_M
        if down_deg >= _LEAST_DEPRESSION_DEG:
            range_m = min(range_m, max(1.0, pose.height_m / math.tan(math.radians(down_deg))))
    return Sensor(
        azimuth_deg=pose.camera.yaw_deg,
        elevation_deg=pose.camera.pitch_deg,
        roll_deg=pose.camera.roll_deg,
        hfov_deg=pose.hfov_deg,
        vfov_deg=vfov_deg,
        range_m=range_m,
    )


def _why_unplaced(pose: Pose | None) -> str:
    """The reason why tracks have no place, by the last pose.

    | the pose                                   | the reason                                     |
    |--------------------------------------------|------------------------------------------------|
    | never came                                 | that                                           |
    | lacks height, direction or field of view   | the missing fields                             |
    | has only an altitude above the sea         | ``--terrain`` is missing, or has no ground     |
    | says a height of 0 or less                 | that                                           |
    | is whole                                   | horizon, age, or ``--terrain`` has no ground   |
    """
    if pose is None:
        return "it says no pose (hvt-edge --pose)"
    said = {
        "height": pose.height_m is not None or pose.altitude_m is not None,
        "direction": pose.camera is not None,
        "field of view": pose.hfov_deg is not None,
    }
    missing = [name for name, known in said.items() if not known]
    if missing:
        return f"its pose says no {' and no '.join(missing)}"
    if pose.height_m is None:
        return "its pose says only how high it is above the sea, and hvt-ground has no --terrain there"
    if pose.height_m <= 0:
        return f"its pose says {pose.height_m:.1f} m above the ground"
    return "they are at the horizon, or the pose is old, or --terrain has no ground below the camera"


def _platform_remarks(pose: Pose) -> str:
    heights = ((pose.height_m, "above the ground"), (pose.altitude_m, "above mean sea level"))
    return ", ".join(f"{metres:.0f} m {what}" for metres, what in heights if metres is not None)


def _track_remarks(track: PlacedTrack, *, still: str) -> str:
    words = [f"{track.name[:80]} {track.confidence:.2f}"]
    if track.refined:
        words.append("refined by stills, which agree" if track.sure else "refined by stills")
    if track.base_name != track.name:
        words.append(f"{track.base_name[:80]} in the video")
    if still:
        words.append(f"still {still}")
    return "; ".join(words)
