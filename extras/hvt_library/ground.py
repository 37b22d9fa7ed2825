"""A ground whose events another program takes: `hvt_ground.listen`.

It is the ground of ``hvt-ground``, with one sink more. Who takes too little loses events, the oldest that wait, and
holds nobody else; in lockstep the edge waits for it.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Self

from hvt_common.config import load, settings_words
from hvt_common.protocol.messages import Info
from hvt_common.values import Image
from hvt_common.video.hevc import BaseDecoder
from hvt_ground.app import Ground
from hvt_ground.config import GroundConfig
from hvt_ground.events import Event, FrameEvent, Notice, Overlay, PoseUpdate, Refinement, Traffic, VideoSample
from hvt_ground.extras import checked, config_class
from hvt_ground.sinks import SinkWriter
from hvt_library.program import InThread

_MOST_QUEUED, MOST_QUEUED_BYTES = 32, 128 * 2**20
"""Events, of which each may be a picture, and their pixels."""
_POLL_S = 0.2


@dataclass(frozen=True, slots=True)
class Picture:
    """A decoded picture of the base stream."""

    frame_index: int
    capture_ns: int
    image_bgr: Image
    """(height, width, 3) uint8, base pixels."""
    stored: bool = False
    """It was stored at the edge while the link was down: it lies before others that came already."""


@dataclass(frozen=True, slots=True)
class Received:
    """Something that an edge sent, or that the ground made of it."""

    edge: str
    session_id: int
    event: Picture | Overlay | PoseUpdate | Refinement | Traffic | Notice


def listen(**settings: object) -> Listening:
    """A ground with the settings of ``hvt-ground`` (docs/options.md), such as ``listen="tcp/0.0.0.0:7447"``.

    Names have underscores for dashes; an option that may be repeated takes a list, and a switch True or False.
    Nothing is recorded unless ``record`` says so. Raises `UserError` where a setting is unknown or wrong.
    """
    words = settings_words({"quiet": True, **settings})
    config, _ = load(config_class(), words, program="hvt_ground.listen", description="")
    return Listening(checked(config))


class Listening:
    """Iterate over it: it ends when the ground does, with ``once`` after the edges, or when it is closed.

    Its ``summaries``, one a session, are as ``--summary`` writes them; empty before the end.
    """

    def __init__(self, config: GroundConfig) -> None:
        self._queue = _Events()
        self._stop = threading.Event()
        ground = Ground(config, stop=self._stop, program=self._sink_of)
        self._flight = InThread(ground.run, stop=self._stop.set, name="hvt-ground")

    @property
    def summaries(self) -> list[dict[str, Any]]:
        return self._flight.summary or []

    def __iter__(self) -> Iterator[Received]:
        return self

    def __next__(self) -> Received:
        """The next event; raises the error that ended the ground, `UserError` or `FlightError`."""
        while True:
            running = self._flight.thread.is_alive()
            try:
                return self._queue.get(timeout=_POLL_S if running else 0.0)
            except queue.Empty:
                if running:
                    continue
            self._flight.raise_error()
            raise StopIteration

    def close(self) -> None:
        """End the ground; events in the queue can still be taken."""
        self._flight.end()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def _sink_of(self, info: Info) -> Callable[[], _Queue]:
        return lambda: _Queue(self._queue, self._stop, info)


class _Events(queue.Queue[Received]):
    # It is full, too, where its pictures take too much.

    def __init__(self) -> None:
        super().__init__(_MOST_QUEUED)
        self._bytes = 0

    def _put(self, item: Received) -> None:
        super()._put(item)
        self._count_bytes(item, by=1)

    def _get(self) -> Received:
        item = super()._get()
        self._count_bytes(item, by=-1)
        return item

    def _count_bytes(self, item: Received, *, by: int) -> None:
        self._bytes += by * item.event.image_bgr.nbytes if isinstance(item.event, Picture) else 0
        self.maxsize = _MOST_QUEUED if self._bytes < MOST_QUEUED_BYTES else max(1, len(self.queue))


class _Queue(SinkWriter[Event]):
    # The events of one session, decoded, for the program's queue; waits while that is full.

    def __init__(self, events: _Events, stop: threading.Event, info: Info) -> None:
        self._events = events
        self._stop = stop
        self._info = info
        # Stored units are another stretch of the stream than live ones.
        self._decoders = {stored: BaseDecoder(size=info.base_size) for stored in (False, True)}
        self._awaits_keyframe = {False, True}

    def log(self, item: Event) -> None:
        if not isinstance(item, FrameEvent):
            return
        event = self._decoded(item) if isinstance(item, VideoSample) else item
        if event is not None:
            self._put(Received(self._info.edge, self._info.session_id, event))

    def skipped(self, count: int) -> None:
        del count
        self._awaits_keyframe = {False, True}

    def _put(self, received: Received) -> None:
        waits = self._info.pace == "lockstep"
        while not self._stop.is_set():
            try:
                self._events.put(received, block=waits, timeout=_POLL_S)
            except queue.Full:
                if not waits:
                    with suppress(queue.Empty):
                        self._events.get_nowait()
                continue
            return

    def _decoded(self, sample: VideoSample) -> Picture | None:
        decoder = self._decoders[sample.stored]
        if sample.keyframe:
            decoder.reset()
            self._awaits_keyframe.discard(sample.stored)
        image = None if sample.stored in self._awaits_keyframe else decoder.decode(sample.data)
        return None if image is None else Picture(sample.frame_index, sample.capture_ns, image, sample.stored)
