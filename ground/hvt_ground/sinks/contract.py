"""What a sink is. Each is used by one thread, that of its `QueuedSink`."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Protocol, TypeVar

from hvt_ground.events import Refinement, VideoSample

__all__ = ["Sink", "size_bytes"]

T_contra = TypeVar("T_contra", contravariant=True)

_SMALL_BYTES = 512


class Sink(Protocol[T_contra]):
    """Takes the events of one session, or other items, and uses those that it knows. What it raises ends it."""

    @property
    def path(self) -> Path | None:
        """The file; None without one."""

    def log(self, item: T_contra) -> None:
        """Write an item."""

    def skipped(self, count: int) -> None:
        """So many items were left out before the next one."""

    def close(self, hurry: threading.Event | None = None) -> None:
        """Write what is buffered; what only helps and may take seconds is left out once ``hurry`` is set."""


def size_bytes(item: object) -> int:
    """About what an item takes in memory."""
    match item:
        case VideoSample():
            return len(item.data) + _SMALL_BYTES
        case Refinement():
            pictures = (item.still_bgr, item.base_crop_bgr)
            return len(item.still) + sum(one.nbytes for one in pictures if one is not None) + _SMALL_BYTES
    return _SMALL_BYTES
