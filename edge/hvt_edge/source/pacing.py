"""The pace at which the frames of a recorded clip are taken in."""

from __future__ import annotations

import threading
from collections.abc import Callable

from hvt_common.units import SECOND_NS
from hvt_common.values import Frame

__all__ = ["realtime_admits"]


def realtime_admits(frame: Frame, *, clock: Callable[[], int], fps: float, stop: threading.Event) -> bool:
    """Wait until the frame of a recorded clip is due; False where it is so late that the next is due already."""
    early_ns = frame.capture_ns - clock()
    if early_ns > 0:
        stop.wait(early_ns / SECOND_NS)
        return True
    return -early_ns < SECOND_NS / fps
