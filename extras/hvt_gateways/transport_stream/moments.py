"""Times the metadata: once a frame, with its tracks as soon as they are known, without them where they are not.

Pictures go out at once and never wait for perception. Tracks come later, of some frames not at all, and of others
that the base stream left out. Capture times become times of a stream that grow, whatever the edge's clock does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Final

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


TIME_BASE: Final = Fraction(1, 90_000)
"""ISO/IEC 13818-1, 2.4.3.7."""
_LONGEST_S: Final = 3600
"""A longer pause is a clock that was set. The 33 bits of a time hold a day."""
_AHEAD_S: Final = 10
"""Lead at which the facts of a moment may be known before its picture comes."""
_PER_SECOND: Final = TIME_BASE.denominator


class Timeline:
    """The times of one stream, which begins with its first picture; ``fps`` is its rate if times do not say."""

    def __init__(self, *, fps: float) -> None:
        self._frame = max(1, round(_PER_SECOND / fps))
        self._zero_ns: int | None = None
        self._picture = -1
        self._metadata = -1

    @property
    def begun(self) -> bool:
        return self._zero_ns is not None

    def picture(self, capture_ns: int) -> int:
        """The time of the next picture in `TIME_BASE`; after one that is later, or an hour earlier, a frame on."""
        if self._zero_ns is None:
            self._zero_ns = capture_ns
        at = self.of(capture_ns)
        if not self._picture < at <= self._picture + _LONGEST_S * _PER_SECOND:
            at = self._picture + self._frame
            self._zero_ns = capture_ns - at * SECOND_NS // _PER_SECOND
        self._picture = at
        return at

    def of(self, capture_ns: int) -> int:
        """The time of a moment; there was a picture."""
        assert self._zero_ns is not None
        return ((capture_ns - self._zero_ns) * _PER_SECOND + SECOND_NS // 2) // SECOND_NS

    def metadata(self, at: int) -> bool:
        """Whether metadata of this time may come next: newer than the last, and not far ahead of the pictures."""
        fits = self._metadata < at <= self._picture + _AHEAD_S * _PER_SECOND
        if fits:
            self._metadata = at
        return fits
