"""Times the metadata: once a frame, with its tracks as soon as they are known, without them where they are not.

Pictures go out at once and never wait for perception. Tracks come later, of some frames not at all, and of others
that the base stream left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from hvt_common.units import SECOND_NS
from hvt_ground.events import Overlay

_HOLD_NS = SECOND_NS
"""Perception that is later than this is not waited for."""
_MOST = 64


@dataclass(frozen=True, slots=True)
class Moment:
    """One frame of which metadata is said."""

    frame_index: int
    capture_ns: int
    at: int
    """Time of the stream."""
    pictured: bool
    """It has a picture in the stream."""
    overlay: Overlay | None = None


class Moments:
    """Takes pictures and tracks, each in order of frames, and gives each frame out once.

    A frame is given out when it has both; or has a picture and there are tracks of a later frame; or has tracks and
    there is a later picture; or is a second old; or when 64 wait.
    """

    def __init__(self) -> None:
        self._open: dict[int, Moment] = {}
        self._given = -1
        self._picture = self._tracks = -1
        """The newest frame of each."""

    def picture(self, frame_index: int, capture_ns: int, *, at: int) -> list[Moment]:
        """Take a picture; return the moments that are due."""
        self._picture = max(self._picture, frame_index)
        before = self._open.get(frame_index)
        overlay = None if before is None else before.overlay
        return self._take(Moment(frame_index, capture_ns, at, pictured=True, overlay=overlay))

    def tracks(self, overlay: Overlay, *, at: int) -> list[Moment]:
        """Take tracks; return the moments that are due."""
        self._tracks = max(self._tracks, overlay.frame_index)
        moment = self._open.get(overlay.frame_index)
        if moment is None:
            moment = Moment(overlay.frame_index, overlay.capture_ns, at, pictured=False)
        return self._take(replace(moment, overlay=overlay))

    def rest(self) -> list[Moment]:
        """At the end: all that waits."""
        given = [self._open[frame] for frame in sorted(self._open)]
        self.forget()
        return given

    def forget(self) -> None:
        """After a gap: drop all waiting moments."""
        self._open.clear()

    def _take(self, moment: Moment) -> list[Moment]:
        if moment.frame_index <= self._given:
            return []
        self._open[moment.frame_index] = moment
        given = []
        for frame in sorted(self._open):
            if not self._ready(self._open[frame]):
                break
            given.append(self._open.pop(frame))
            self._given = frame
        return given

    def _ready(self, one: Moment) -> bool:
        if one.overlay is not None and (one.pictured or self._picture > one.frame_index):
            return True
        if one.overlay is None and self._tracks > one.frame_index:
            return True
        newest_ns = max(other.capture_ns for other in self._open.values())
        return newest_ns - one.capture_ns > _HOLD_NS or len(self._open) > _MOST
