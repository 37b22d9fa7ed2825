"""The contract of a sink, for those that log, and of the writer behind a `QueuedSink` in its own thread."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Generic, Protocol, TypeVar

T = TypeVar("T")
T_contra = TypeVar("T_contra", contravariant=True)


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
