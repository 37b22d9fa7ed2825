"""The last seconds of untouched source frames, each with its tracks, for stills on demand.

Frames are kept raw: a still has to be cut from what the camera gave, and another loss before the still codec would be
paid in its bits. The bound is in bytes and in seconds. Where the bytes do not hold every frame of those
seconds, frames are kept further apart, evenly, so that the ring reaches as far back as asked for: 64 MB hold
one frame each 0.25 s at 1280x720, one each 0.6 s at 1920x1080 and two at 3840x2160. The newest is always there.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

from hvt_common.values import Frame, Image, Tracks

__all__ = ["FrameRing", "RingFrame", "RingSettings"]


@dataclass(frozen=True, slots=True)
class RingSettings:
    """The bounds; with fewer bytes than a frame takes, nothing is kept."""

    max_bytes: int = 64_000_000
    max_age_ns: int = 5_000_000_000


@dataclass(frozen=True, slots=True)
class RingFrame:
    """A source frame and what was tracked in it."""

    frame_index: int
    capture_ns: int
    source_bgr: Image
    """As the source gave it, not copied: nobody may write into it."""
    tracks: Tracks
    """At this very frame, base pixels."""


class FrameRing:
    """One thread adds, others look; time is the frames' own."""

    def __init__(self, settings: RingSettings = RingSettings()) -> None:
        self._settings = settings
        self._frames: list[RingFrame] = []
        """Oldest first; all but the newest lie on the grid that `_spacing_ns` makes."""
        self._size_bytes = 0
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def size_bytes(self) -> int:
        """Memory of the pixels."""
        return self._size_bytes

    @property
    def newest(self) -> RingFrame | None:
        """The frame added last; None before the first, or where none is kept."""
        with self._lock:
            return self._frames[-1] if self._frames else None

    def add(self, frame: Frame, tracks: Tracks) -> None:
        """Keep a frame, newer than all before; let go of what there is no more room or time for."""
        size_bytes = frame.source_bgr.nbytes
        with self._lock:
            if size_bytes > self._settings.max_bytes:
                self._drop_from(0)
                return
            spacing_ns = self._spacing_ns(size_bytes)
            # The newest was kept for being the newest; unless it lies on the grid, it makes way for this one.
            if len(self._frames) > 1 and self._gap_ns(-1) < spacing_ns:
                self._size_bytes -= self._frames.pop().source_bgr.nbytes
            self._frames.append(RingFrame(frame.index, frame.capture_ns, frame.source_bgr, tracks))
            self._size_bytes += size_bytes
            self._let_go(frame.capture_ns - self._settings.max_age_ns)

    def near_time(self, capture_ns: int) -> RingFrame | None:
        """The frame kept that was taken nearest to this time; None where that is further back than the ring goes."""
        with self._lock:
            if not self._frames or capture_ns < self._reach_ns():
                return None
            return min(self._frames, key=lambda one: abs(one.capture_ns - capture_ns))

    def near_index(self, frame_index: int) -> RingFrame | None:
        """The frame kept whose index is nearest; None where that is further back than the ring goes, or to come."""
        with self._lock:
            if not self._frames or frame_index > self._frames[-1].frame_index:
                return None
            near = min(self._frames, key=lambda one: abs(one.frame_index - frame_index))
            return None if frame_index < self._frames[0].frame_index else near

    def reach_s(self) -> float:
        """How far it goes back from the newest frame."""
        with self._lock:
            if not self._frames:
                return 0.0
            return (self._frames[-1].capture_ns - self._frames[0].capture_ns) / 1e9

    def _spacing_ns(self, size_bytes: int) -> int:
        """The least time between two frames on the grid, for them to reach back all the seconds."""
        count = self._settings.max_bytes // size_bytes
        # The newest is one more, and so is the one that is about to grow too old.
        return self._settings.max_age_ns // max(1, count - 2)

    def _gap_ns(self, place: int) -> int:
        return self._frames[place].capture_ns - self._frames[place - 1].capture_ns

    def _reach_ns(self) -> int:
        """Half a gap before the oldest: what was asked for lies nearer to it than to one that is gone."""
        gap_ns = self._gap_ns(1) if len(self._frames) > 1 else 0
        return self._frames[0].capture_ns - gap_ns // 2

    def _let_go(self, oldest_ns: int) -> None:
        while len(self._frames) > 1 and (
            self._size_bytes > self._settings.max_bytes or self._frames[0].capture_ns < oldest_ns
        ):
            self._size_bytes -= self._frames.pop(0).source_bgr.nbytes

    def _drop_from(self, place: int) -> None:
        del self._frames[place:]
        self._size_bytes = sum(one.source_bgr.nbytes for one in self._frames)
