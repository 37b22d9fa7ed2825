"""The edge's clock, and the pace at which frames are taken in."""

from __future__ import annotations

import threading
import time

from hvt_common.values import Frame

__all__ = ["SteadyClock", "realtime_admits"]

_SECOND_NS = 1_000_000_000


class SteadyClock:
    """Unix time that never jumps: read once from the wall, then carried on by the monotonic clock."""

    def __init__(self) -> None:
        self._wall_ns = time.time_ns()
        self._monotonic_ns = time.monotonic_ns()

    def __call__(self) -> int:
        """Unix nanoseconds."""
        return self._wall_ns + time.monotonic_ns() - self._monotonic_ns


def realtime_admits(frame: Frame, *, clock: SteadyClock, fps: float, stop: threading.Event) -> bool:
    """Wait until the frame of a recorded clip is due; False where it is so late that the next is due already."""
    early_ns = frame.capture_ns - clock()
    if early_ns > 0:
        stop.wait(early_ns / _SECOND_NS)
        return True
    return -early_ns < _SECOND_NS / fps
