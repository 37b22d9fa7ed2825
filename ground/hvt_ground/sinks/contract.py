"""The contract of a sink, for those that log, and of the writer behind a `QueuedSink` in its own thread."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from hvt_common.transport.inbox import Received
from hvt_ground.events import Overlay, Refinement, VideoSample

T = TypeVar("T")
T_contra = TypeVar("T_contra", contravariant=True)

_SMALL_BYTES = 512
_TRACK_BYTES = 64
"""Of an overlay, each."""


class Sink(Protocol[T_contra]):
    """Takes the events of one session, or other items, and uses those that it knows."""

    def log(self, item: T_contra) -> None:
        """Take an item."""

    def close(self, hurry: threading.Event | None = None) -> None:
        """Write the buffer; skip slow extras once ``hurry`` is set."""


class SinkWriter(Generic[T]):
    """A sink that one thread uses; this one writes to no file, and holds nothing. An error that it raises ends it."""

    path: Path | None = None
    """The file that was opened last; None without one."""
    awaits_keyframe = False
    """Without one it can show nothing of what came last, and somebody looks: one is asked for, once."""

    def log(self, item: T) -> None:
        """Write an item, or pass it by."""
        raise NotImplementedError

    def skipped(self, count: int) -> None:
        """So many items were left out before the next one."""

    def close(self, hurry: threading.Event | None = None) -> None:
        """Write what is held back; skip slow extras once ``hurry`` is set. A second call does nothing."""


def is_stored(item: object) -> bool:
    """Whether an edge has stored it and forgets it when it is acknowledged."""
    return isinstance(item, VideoSample | Refinement) and item.stored


def size_bytes(item: object) -> int:
    """About the memory of an item."""
    match item:
        case Received():
            return item.size_bytes + _SMALL_BYTES
        case VideoSample():
            return len(item.data) + _SMALL_BYTES
        case Refinement():
            pictures = (item.still_bgr, item.base_crop_bgr)
            return len(item.still) + sum(one.nbytes for one in pictures if one is not None) + _SMALL_BYTES
        case Overlay():
            return _TRACK_BYTES * len(item.track_ids) + _SMALL_BYTES
    return _SMALL_BYTES
