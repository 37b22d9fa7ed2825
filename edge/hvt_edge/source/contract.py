"""The contract of a source."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from types import TracebackType
from typing import Self

from hvt_common.values import Frame, View

__all__ = ["Source"]


class Source(ABC):
    """Frames at the base rate and size, in order. A context manager; use it from one thread."""

    view: View
    """The map from source to base pixels; fixed once the source is open."""
    live: bool
    """True for what cannot be paused (camera, network stream); a file, a folder and the demo wait for the reader."""
    fps: float
    """Base rate, frames a second. A live camera that is slower delivers fewer."""
    frame_count: int | None
    """How many base frames to expect, where that is known."""
    class_names: tuple[str, ...] = ()
    """Names of the classes in the ground truth; only the demo has any."""

    @abstractmethod
    def frames(self, *, start_ns: int) -> Iterator[Frame]:
        """Frames 0, 1, 2 …; arrays are read-only.

        Args:
            start_ns: Unix time of frame 0. Files, folders and the demo count media time from it; live sources
                ignore it and read their clock once, when a frame was grabbed.
        """

    def close(self) -> None:
        """Let go of devices and threads; calling it twice does no harm."""
        return

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
