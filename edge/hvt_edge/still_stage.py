"""One frame of the side channel: see, choose, send what the budget has room for."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from types import TracebackType
from typing import Self

from hvt_common.link.wire import StillResult
from hvt_common.values import AccessUnit, Frame
from hvt_edge.choose import Chooser
from hvt_edge.keyframes import KeyframePlan
from hvt_edge.send import Sender
from hvt_edge.sight import Sight

__all__ = ["StillStage", "StillWorker"]

_BEHIND_FRAMES = 3
"""With more frames waiting than this, detection is put off; decoding never is."""


_REMEMBERED_TRACKS = 10_000


class StillStage:
    """Takes each frame with its access unit, after the unit was sent."""

    def __init__(
        self, sight: Sight, chooser: Chooser, *, sender: Sender, keyframes: KeyframePlan, media_type: str
    ) -> None:
        self._sight = sight
        self._chooser = chooser
        self._sender = sender
        self._keyframes = keyframes
        self._media_type = media_type
        self._track_ids: set[int] = set()
        self._sight_ns = 0
        self._steps = 0
        self.tracks = 0
        """Distinct tracks so far."""

    @property
    def waiting(self) -> int:
        """How many stills wait for room."""
        return self._chooser.waiting

    @property
    def sight_ms(self) -> float:
        """Mean time to decode, detect and track, over all frames."""
        return self._sight_ns / max(1, self._steps) / 1e6

    def step(
        self, frame: Frame, unit: AccessUnit, *, clock: Callable[[], int], hurry: bool = False
    ) -> set[int]:
        """See the frame, choose, send the stills that fit; return their sequence numbers.

        ``clock`` tells the time that windows go by.
        """
        began_ns = time.perf_counter_ns()
        seen = self._sight.see(frame, unit, hurry=hurry)
        self._sight_ns += time.perf_counter_ns() - began_ns
        self._steps += 1
        self._count_tracks(seen.tracks.ids.tolist())
        now_ns = clock()
        room = partial(self._sender.still_room_bytes, now_ns)
        self._chooser.consider(seen, now_ns=now_ns, room_bytes=room())
        sent: set[int] = set()
        if self._keyframes.due(now_ns):
            return sent
        for still in self._chooser.stills(now_ns=now_ns, room_bytes=room):
            self._sender.still(still, media_type=self._media_type, now_ns=now_ns)
            sent.add(still.sequence)
        return sent

    def hear(self, results: Sequence[StillResult]) -> None:
        """What a ground made of stills counts for the next decision; one without a name is no opinion."""
        for result in results:
            if not result.class_name:
                continue
            self._chooser.record_feedback(
                result.track_id,
                class_name=result.class_name,
                confidence=result.confidence,
                entropy_nats=result.entropy_nats,
            )

    def close(self) -> None:
        """Give up what still waits."""
        self._chooser.close()

    def _count_tracks(self, ids: list[int]) -> None:
        new = set(ids) - self._track_ids
        self.tracks += len(new)
        self._track_ids.update(new)
        if len(self._track_ids) > 2 * _REMEMBERED_TRACKS:  # ids only grow: the oldest do not come back
            self._track_ids = set(sorted(self._track_ids)[-_REMEMBERED_TRACKS:])


class StillWorker:
    """Runs a `StillStage` in a thread of its own, so that detection never delays the base stream.

    The queue is bounded; where it is `full` the frame loop drops the next frame before encoding. Before each frame
    the thread asks ``hear`` for what grounds have reported. An error in it ends the process: `offer` and `close`
    raise it.
    """

    def __init__(
        self,
        stage: StillStage,
        *,
        hear: Callable[[], Sequence[StillResult]],
        clock: Callable[[], int],
        length: int = 16,
    ) -> None:
        self._stage = stage
        self._hear = hear
        self._clock = clock
        self._frames: queue.Queue[tuple[Frame, AccessUnit] | None] = queue.Queue(length)
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="hvt-stills", daemon=True)
        self._thread.start()

    @property
    def full(self) -> bool:
        """Whether the next `offer` would have to wait."""
        return self._frames.full()

    def offer(self, frame: Frame, unit: AccessUnit) -> None:
        """Hand over one frame, in order."""
        self._raise_error()
        self._frames.put((frame, unit))

    def close(self) -> None:
        """Let the thread finish what it has, at most for a second, and join it."""
        with contextlib.suppress(queue.Full):
            self._frames.put(None, timeout=1.0)
        self._thread.join(timeout=2.0)
        self._raise_error()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _run(self) -> None:
        try:
            while (item := self._frames.get()) is not None:
                behind = self._frames.qsize() >= _BEHIND_FRAMES
                self._stage.hear(self._hear())
                self._stage.step(*item, clock=self._clock, hurry=behind)
        except BaseException as error:  # noqa: BLE001 - handed to the frame loop, which ends the process
            self._error = error

    def _raise_error(self) -> None:
        if self._error is not None:
            error, self._error = self._error, None
            raise error
