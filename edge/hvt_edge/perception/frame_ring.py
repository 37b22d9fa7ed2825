"""The last seconds of untouched source frames, each with its tracks and its base picture, for stills on demand.

The newest is stored as the source gave it; older ones as 4:2:0, half the memory, which still codecs and
cameras use anyway. They are bounded in bytes and in seconds. If the bytes do not hold every frame of those seconds,
frames are stored further apart, evenly, so that the ring reaches as far back as set: 24 MB hold one each 0.6 s at
1280x720, one each second at 1920x1080 and one of 5 s ago at 3840x2160.

Coded frames are preferred: with them the base picture is stored, which a still has to beat. Of the others
only the newest is stored, and one in each `_UNCODED_NS` where no frames are coded.

Frames come here once they were analyzed, which on a slow machine takes seconds, and not all are. So the newest frame
of the camera is held beside them, without tracks: it is "now" for requests without a track.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.units import SECOND_NS
from hvt_common.values import Frame, Image, Tracks
from hvt_common.video.hevc import YuvPicture

_UNCODED_NS = 6 * SECOND_NS // 10
"""Within this time a coded frame stands for an uncoded one: at two coded frames a second there always is one."""


@dataclass(frozen=True, slots=True)
class RingFrame:
    """A source frame with its tracks."""

    frame_index: int
    capture_ns: int
    size: tuple[int, int]
    pixels: npt.NDArray[np.uint8]
    """The source's own array, not copied: nobody may write into it. With two dimensions it is I420."""
    tracks: Tracks
    """The tracks of this very frame, base pixels."""
    base: YuvPicture | Image | None = None
    """The decoded base picture of this very frame; None where it was not coded."""

    @property
    def base_bytes(self) -> int:
        return 0 if self.base is None else self.base.nbytes

    @property
    def source_bgr(self) -> Image:
        if self.pixels.ndim == 3:
            return self.pixels
        return np.asarray(cv2.cvtColor(self.pixels, cv2.COLOR_YUV2BGR_I420), np.uint8)

    @property
    def packed_bytes(self) -> int:
        """Memory of the pixels once `packed`."""
        return self.pixels.nbytes // 2 if self._packs else self.pixels.nbytes

    def packed(self) -> RingFrame:
        """The same frame in half the memory, if the sides are even."""
        if not self._packs:
            return self
        return replace(self, pixels=np.asarray(cv2.cvtColor(self.pixels, cv2.COLOR_BGR2YUV_I420), np.uint8))

    @property
    def _packs(self) -> bool:
        return self.pixels.ndim == 3 and not any(side % 2 for side in self.size)


class FrameRing:
    """One thread adds, one captures, others read; time is the capture time of the frames.

    A ``tracked`` frame is one that was analyzed. ``max_bytes`` and ``max_age_ns`` bound all but the
    newest; with no bytes, nothing is stored.
    """

    def __init__(self, *, max_bytes: int = 24_000_000, max_age_ns: int = 5_000_000_000) -> None:
        self._max_bytes, self._max_age_ns = max_bytes, max_age_ns
        self._frames: list[RingFrame] = []
        """Oldest first; all but the newest, and the newest coded one, are packed and lie on the grid that
        `_spacing_ns` makes."""
        self._captured: RingFrame | None = None
        """The newest frame of the camera, analyzed or not."""
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def size_bytes(self) -> int:
        """Memory of the pixels, source and base, without those of the newest frame."""
        return sum(one.pixels.nbytes + one.base_bytes for one in self._frames[:-1])

    def newest(self, *, tracked: bool = True) -> RingFrame | None:
        """The newest frame; None before the first, or where none is stored."""
        with self._lock:
            frames = self._held(tracked=tracked)
            return frames[-1] if frames else None

    def newest_coded(self, *, tracked: bool = True) -> RingFrame | None:
        """The newest coded frame; the newest of all where that is much newer, or none was coded."""
        with self._lock:
            frames = self._held(tracked=tracked)
            return _nearest(frames, lambda one: frames[-1].capture_ns - one.capture_ns) if frames else None

    def capture(self, frame: Frame) -> None:
        height, width = frame.source_bgr.shape[:2]
        if self._max_bytes:
            self._captured = RingFrame(
                frame.index, frame.capture_ns, (width, height), frame.source_bgr, Tracks.none(frame.index)
            )

    def add(self, frame: Frame, tracks: Tracks, *, base: YuvPicture | Image | None = None) -> None:
        """Store a frame, newer than all before; drop frames beyond the ring's bytes or time."""
        height, width = frame.source_bgr.shape[:2]
        newest = RingFrame(frame.index, frame.capture_ns, (width, height), frame.source_bgr, tracks, base)
        with self._lock:
            if not self._max_bytes:
                return
            frames = self._frames
            if frames and frames[-1].base is None and self._stands_for(frames[-1]):
                frames.pop()
            # The last frame was stored as the newest; unless it lies on the grid, it makes way for this one.
            last = frames[-1] if frames else None
            if last is not None and (base is not None or last.base is None):
                frames.pop()
                if not frames or last.capture_ns - frames[-1].capture_ns >= self._spacing_ns(last):
                    frames.append(last.packed())
            frames.append(newest)
            oldest_ns = frame.capture_ns - self._max_age_ns
            while len(frames) > 1 and (self.size_bytes > self._max_bytes or frames[0].capture_ns < oldest_ns):
                frames.pop(0)

    def near_time(self, capture_ns: int, *, tracked: bool = True) -> RingFrame | None:
        """The stored frame nearest to this capture time; None where the time lies before the ring's oldest frame."""
        with self._lock:
            frames = self._held(tracked=tracked)
            if not frames or capture_ns < _reach_ns(frames):
                return None
            return _nearest(frames, lambda one: abs(one.capture_ns - capture_ns))

    def near_index(self, frame_index: int, *, tracked: bool = True) -> RingFrame | None:
        """The stored frame of the nearest index; None where the index is older than the ring, or yet to come."""
        with self._lock:
            frames = self._held(tracked=tracked)
            come = [one.frame_index for one in (self._captured, *self._frames[-1:]) if one is not None]
            if not frames or not frames[0].frame_index <= frame_index <= max(come):
                return None
            near = min(frames, key=lambda one: abs(one.frame_index - frame_index))
            return _nearest(frames, lambda one: abs(one.capture_ns - near.capture_ns))

    def _held(self, *, tracked: bool) -> Sequence[RingFrame]:
        # All frames that may be requested, oldest first.
        newest, frames = self._captured, self._frames
        near = (
            bool(frames) and newest is not None and newest.capture_ns - frames[-1].capture_ns <= _UNCODED_NS
        )
        return frames if tracked or near or newest is None else [*frames, newest]

    def _stands_for(self, uncoded: RingFrame) -> bool:
        before = self._frames[-2] if len(self._frames) > 1 else None
        near = before is not None and uncoded.capture_ns - before.capture_ns <= _UNCODED_NS
        return before is not None and before.base is not None and near

    def reach_s(self) -> float:
        with self._lock:
            if not self._frames:
                return 0.0
            return (self._frames[-1].capture_ns - self._frames[0].capture_ns) / 1e9

    def _spacing_ns(self, frame: RingFrame) -> int:
        # The least time between two frames on the grid, such that they reach back all the seconds.
        count = self._max_bytes // (frame.packed_bytes + frame.base_bytes)
        return self._max_age_ns // max(1, count - 1)  # one more is about to grow too old


def _nearest(frames: Sequence[RingFrame], distance_ns: Callable[[RingFrame], int]) -> RingFrame:
    # The nearest of the coded frames, or of all where no coded one is near.
    coded = [one for one in frames if one.base is not None and distance_ns(one) <= _UNCODED_NS]
    return min(coded or frames, key=distance_ns)


def _reach_ns(frames: Sequence[RingFrame]) -> int:
    # Half a gap before the oldest: a time requested after that lies nearer to it than to a frame already dropped.
    first = frames[0].capture_ns
    gap_ns = frames[1].capture_ns - first if len(frames) > 1 else 0
    return first - gap_ns // 2
