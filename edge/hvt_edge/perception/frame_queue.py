"""Frames on their way to perception, bounded: where there are too many, the oldest makes way for the newest."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence

from hvt_common.values import AccessUnit, Frame

__all__ = ["FrameQueue", "SkippedUnits"]

_LEAST_FRAMES = 2
_MOST_SKIPPED_BYTES = 2 * 2**20


class FrameQueue:
    """One thread puts, another gets; the frame loop never waits.

    ``length`` bounds the frames, ``max_bytes`` their pixels; two frames always have a place.
    """

    def __init__(self, *, length: int, max_bytes: int) -> None:
        self._length = length
        self._max_bytes = max_bytes
        self._frames: deque[tuple[Frame, AccessUnit | None]] = deque()
        self._skipped = SkippedUnits()
        self._changed = threading.Condition()
        self._closed = False

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def ended(self) -> bool:
        """Nothing is queued, and nothing will be."""
        return self._closed and not self._frames

    def put(self, frame: Frame, unit: AccessUnit | None) -> int:
        """Queue a frame with its access unit, if it has one; return how many older ones made way."""
        # All frames of a source have one size, so a bound in bytes is a bound in frames.
        fitting = self._max_bytes // (frame.source_bgr.nbytes + frame.base_bgr.nbytes)
        most, left_out = min(self._length, max(_LEAST_FRAMES, fitting)), 0
        with self._changed:
            self._frames.append((frame, unit))
            while len(self._frames) > most:
                self._skipped.add(self._frames.popleft()[1])
                left_out += 1
            self._changed.notify()
        return left_out

    def get(self, *, timeout_s: float) -> tuple[Frame, AccessUnit | None, Sequence[AccessUnit]] | None:
        """The oldest frame, what the decoder may be given of it, and the units before it; None for none."""
        with self._changed:
            if not self._frames and not self._closed:
                self._changed.wait(timeout_s)
            if not self._frames:
                return None
            frame, unit = self._frames.popleft()
            return frame, *self._skipped.take(unit)

    def close(self) -> None:
        """Nothing is put any more."""
        with self._changed:
            self._closed = True
            self._changed.notify()


class SkippedUnits:
    """Access units of frames that were not analyzed: the decoder needs them before the next. Bounded in bytes."""

    def __init__(self) -> None:
        self._units: list[AccessUnit] = []
        self._whole = True
        """Whether all since the last keyframe are there."""

    def add(self, unit: AccessUnit | None) -> None:
        """This frame is not analyzed; ``unit`` is None where it was not coded."""
        if unit is None:
            return
        if unit.keyframe:
            self._units, self._whole = [], True
        self._units.append(unit)
        if not self._whole or sum(len(one.data) for one in self._units) > _MOST_SKIPPED_BYTES:
            self._units, self._whole = [], False

    def take(self, unit: AccessUnit | None) -> tuple[AccessUnit | None, tuple[AccessUnit, ...]]:
        """Return what the decoder may be given now: this frame's unit, and those before it.

        Where units are missing it is nothing until a keyframe: the frame is analyzed as one that was not coded.
        """
        if unit is None:
            return None, ()
        if unit.keyframe:
            self._units, self._whole = [], True
        skipped, self._units = tuple(self._units), []
        return (unit, skipped) if self._whole else (None, ())
