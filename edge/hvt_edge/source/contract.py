"""The contract of a source, its notes, and the sizes and rates that a base stream can have."""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import wait
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Self

from hvt_common.errors import UserError
from hvt_common.runtime.log import START_LOGGER
from hvt_common.runtime.process import in_thread
from hvt_common.values import Fit, Frame, Pose, View

BaseSize = tuple[int, int] | Callable[[tuple[int, int]], tuple[int, int]]
"""(width, height) of the base frames, or a function that gives it from the source's."""

IDLE_S = 0.25
"""While no frame comes, a source gives None as often."""
_LEAST_SIDE_PX, _MOST_SIDE_PX = 64, 8192


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceSettings:
    """Settings for opening every kind of source; see `hvt_edge.source.opening.open_source`."""

    size: BaseSize
    fps: float
    fit: Fit = "letterbox"
    max_frames: int | None = None
    source_fps: float | None = None
    growing: bool = False


class Source(ABC):
    """Frames at the base rate and size, in order. A context manager; use it from one thread."""

    view: View
    """The map from source to base pixels; fixed once the source is open."""
    live: bool
    """It cannot be paused (camera, network stream); a file, a folder and the demo wait for the reader."""
    fps: float
    """Base rate, frames a second. A live camera that is slower delivers fewer."""
    frame_count: int | None
    """The number of base frames to expect, where that is known."""
    class_names: tuple[str, ...] = ()
    """Names of the classes in the ground truth; only the demo has any."""
    missed: int = 0
    """Frames of a live source for which the reader was too slow."""
    unreadable: int = 0
    """Frames that were damaged, and took no place among the others."""
    passed_over: int = 0
    """Frames of a live source beyond the base rate."""
    restarts: int = 0
    """How often a live source was opened again."""
    notes: tuple[str, ...] = ()
    """The decisions and guesses about it before the flight and their reasons, a sentence each."""

    @abstractmethod
    def frames(self, *, start_ns: int) -> Iterator[Frame]:
        """Frames 0, 1, 2 …; arrays are read-only.

        ``start_ns`` is the Unix time of frame 0 for files, folders and the demo. Live sources ignore it and read
        their clock when a frame is grabbed.
        """

    def steps(self, *, start_ns: int) -> Iterator[Frame | None]:
        """`frames`, with None for each quarter of a second in which a live source, or a file that grows, has none."""
        yield from self.frames(start_ns=start_ns)

    def close(self) -> None:
        """Release devices and threads; calling it twice does no harm."""
        return

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()


class DrawnSource(Source):
    """A scene that is drawn, and so knows its truth. Both are asked for before the first frame."""

    @abstractmethod
    def write_truth(self, path: Path, *, fps: float) -> None:
        """Write the ground truth of a flight at that rate, in MOTChallenge form."""

    @abstractmethod
    def poses(self) -> list[Pose]:
        """The camera's poses from the scene's beginning to its end."""


class ClipSource(Source):
    """A clip that waits for its reader, and is played again from its beginning."""

    live = False
    _running: Generator[Frame, None, None] | None = None
    _growing = False
    """A read at the end of the file waits for more."""

    def frames(self, *, start_ns: int) -> Iterator[Frame]:
        self.close()
        self._running = self._play(start_ns)
        return self._running

    def steps(self, *, start_ns: int) -> Iterator[Frame | None]:
        frames = self.frames(start_ns=start_ns)
        while self._growing:
            coming = in_thread(partial(next, frames, None), name="hvt-source", lowered=False)
            while not wait([coming], timeout=IDLE_S).done:
                yield None
            frame = [coming.result()]
            if frame[0] is None:
                return
            del coming  # or it would be held while the next is read
            yield frame.pop()
        yield from frames

    def close(self) -> None:
        if self._running is not None:
            with suppress(ValueError):  # its thread still waits for the file
                self._running.close()
            self._running = None

    @abstractmethod
    def _play(self, start_ns: int) -> Generator[Frame, None, None]: ...


def size_within(source_size: tuple[int, int], box: tuple[int, int]) -> tuple[int, int]:
    """The largest (width, height) of the source's aspect ratio within a box: even, and 64 on a side at least."""
    scale = min(box[0] / source_size[0], box[1] / source_size[1])
    wide, high = (
        max(_LEAST_SIDE_PX, min(round(side * scale / 2) * 2, most // 2 * 2))
        for side, most in zip(source_size, box, strict=True)
    )
    return wide, high


def check_shape(*, size: BaseSize, fps: float, source_fps: float | None = None) -> None:
    """Raise `UserError` for a size or rate that no base stream can have, with the accepted ones."""
    wide, high = (_LEAST_SIDE_PX, _LEAST_SIDE_PX) if callable(size) else size
    # HEVC codes 4:2:0 pictures in even sizes only.
    if wide % 2 or high % 2 or not all(_LEAST_SIDE_PX <= side <= _MOST_SIDE_PX for side in (wide, high)):
        raise UserError(
            f"--size {wide}x{high} is impossible: width and height must be even and between {_LEAST_SIDE_PX} and "
            f"{_MOST_SIDE_PX}"
        )
    if not (math.isfinite(fps) and 0 < fps <= 240):
        raise UserError(f"--fps {fps:g} is impossible: accepted is above 0 and at most 240 frames a second")
    if source_fps is not None and not (math.isfinite(source_fps) and 0 < source_fps <= 1000):
        raise UserError(
            f"--source-fps {source_fps:g} is impossible: accepted is above 0 and at most 1000 frames a second"
        )


class Notes:
    """Collects sentences; ``name`` is their subject, as it may be printed."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._said: list[str] = []
        self._taken = False

    def __call__(self, sentence: str) -> None:
        """Add the sentence, each once, an empty one never; after `taken` it is logged at once."""
        if not sentence or sentence in self._said:
            return
        self._said.append(sentence)
        if self._taken:
            logging.getLogger(START_LOGGER).info("%s: %s", self._name, sentence)

    def taken(self) -> tuple[str, ...]:
        self._taken = True
        return tuple(self._said)
