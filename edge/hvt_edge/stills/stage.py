"""One frame of the side channel: see, choose, send what the budget has room for."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Protocol, Self

from hvt_common.protocol.messages import StillResult
from hvt_common.runtime.process import lower_priority
from hvt_common.runtime.statistics import DistinctIds
from hvt_common.values import AccessUnit, Frame, Still, Tracks
from hvt_edge.backlog.stage import BacklogStage
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.operating.keyframes import KeyframePlan
from hvt_edge.perception.analyzer import AnalyzedFrame, Analyzer
from hvt_edge.stills.scheduler import Chooser

__all__ = ["MAX_QUEUE_BYTES", "Reporter", "StillStage", "StillWorker"]

_BEHIND_FRAMES = 3
"""With more frames waiting than this, detection is put off; decoding never is."""
_LEAST_FRAMES = 2
MAX_QUEUE_BYTES = 160 * 2**20
"""Of frames that wait to be seen: 16 of 1280x720 and 1920x1080, 5 of 3840x2160."""
_FINISH_S = 1.0
_AGAIN_S = 0.025


class Reporter(Protocol):
    """Tells the ground which tracks the edge has."""

    def report(self, seen: AnalyzedFrame, *, now_ns: int) -> object:
        """Send the tracks of one decision step, if it wants to."""
        ...


class StillStage:
    """Takes each frame with its access unit, if it has one, after the unit was sent.

    With a ``reporter`` the edge's own tracks go out at each decision step, before the stills of it. While the link is
    away ``backlog`` takes the stills, as many as would have been sent.
    """

    def __init__(
        self,
        analyzer: Analyzer,
        chooser: Chooser,
        *,
        sender: Transmitter,
        keyframes: KeyframePlan,
        reporter: Reporter | None = None,
        backlog: BacklogStage | None = None,
    ) -> None:
        self._analyzer = analyzer
        self._chooser = chooser
        self._sender = sender
        self._keyframes = keyframes
        self._reporter = reporter
        self._backlog = backlog
        self._latest_tracks: Tracks | None = None
        self._track_ids = DistinctIds()
        self._perception_ns = 0
        self._steps = 0

    @property
    def tracks(self) -> int:
        """Distinct tracks so far."""
        return self._track_ids.count

    @property
    def latest_tracks(self) -> Tracks | None:
        """Those of the frame that `send` took last; None before the first.

        In lockstep it changes at the same point of the frame loop in every run, whatever `see` is doing meanwhile.
        """
        return self._latest_tracks

    @property
    def waiting(self) -> int:
        """How many stills wait for room."""
        return self._chooser.waiting

    @property
    def live_waits(self) -> bool:
        """Whether a still waits for room, one that a ground asked for included."""
        return self._chooser.live_waits

    @property
    def perception_ms(self) -> float:
        """Mean time to decode, detect and track, over all frames."""
        return self._perception_ns / max(1, self._steps) / 1e6

    def see(self, frame: Frame, unit: AccessUnit | None, *, hurry: bool = False) -> AnalyzedFrame:
        """Decode, detect and track one frame; ``unit`` is None for one that is not part of the base stream."""
        began_ns = time.perf_counter_ns()
        seen = self._analyzer.see(frame, unit, hurry=hurry)
        self._perception_ns += time.perf_counter_ns() - began_ns
        self._steps += 1
        self._track_ids.add(seen.tracks.ids.tolist())
        return seen

    def send(self, seen: AnalyzedFrame, *, now_ns: int, held: bool | None = None) -> set[int]:
        """Choose, and send the stills that fit now; return their sequence numbers.

        ``now_ns`` is the time that windows go by. With ``held`` none is sent, because a keyframe is to come; None
        asks the plan.
        """
        self._latest_tracks = seen.tracks
        if self._reporter is not None and seen.detected:
            self._reporter.report(seen, now_ns=now_ns)
        # What is wished for waits until the link is free, which right behind a base frame it never is.
        room_bytes = self._sender.still_room_bytes(now_ns, paced=False)
        self._chooser.consider(seen, now_ns=now_ns, room_bytes=room_bytes)
        return self.send_waiting(now_ns=now_ns, held=held)

    def send_waiting(self, *, now_ns: int, held: bool | None = None) -> set[int]:
        """Send those that wait and fit now, without another frame; the rest as of `send`."""
        sent: set[int] = set()
        if self._backlog is not None:
            self._backlog.store_lost(now_ns)
            if self._backlog.offline:
                self._keep_stills(self._backlog, now_ns)
                return sent
        if self._keyframes.due(now_ns) if held is None else held:
            return sent
        for still in self._chooser.stills(
            now_ns=now_ns, room=lambda one: self._sender.still_room_bytes(now_ns, still=one)
        ):
            self._sender.still(still, now_ns=now_ns, utility=self._chooser.utility)
            if self._backlog is not None:
                self._backlog.note_utility(still, self._chooser.utility)
            sent.add(still.sequence)
        return sent

    def _keep_stills(self, backlog: BacklogStage, now_ns: int) -> None:
        """Those that would have gone out now."""
        for still in self._chooser.stills(
            now_ns=now_ns,
            room=lambda one: self._sender.still_room_bytes(now_ns, still=one, paced=False),
            keeps=True,
        ):
            backlog.still(still, utility=self._chooser.utility, now_ns=now_ns)

    def hear(self, results: Sequence[StillResult]) -> None:
        """What a ground made of stills counts for the next decision; one without a name is no opinion.

        A still that it could make nothing of for want of the base frame is sent once more.
        """
        for result in results:
            if result.again:
                self._chooser.ask_again(result.still_sequence)
            if not result.class_name:
                continue
            self._chooser.record_feedback(
                result.track_id,
                class_name=result.class_name,
                confidence=result.confidence,
                entropy_nats=result.entropy_nats,
            )

    def without_base(self, still: Still, *, now_ns: int) -> Still:
        """A still that was sent lately, as it is without the base; in the thread of `send`, or after its end."""
        return self._chooser.without_base(still, now_ns=now_ns)

    def close(self) -> None:
        """Give up what still waits."""
        self._chooser.close()


class StillWorker:
    """Runs a `StillStage` in a thread of its own, so that detection never delays the base stream.

    The queue is bounded in frames and in bytes; where it is `full` the frame loop drops the next frame before
    encoding. Before each frame the thread asks ``hear`` for what grounds have reported. An error in it ends the
    process: `full`, `offer` and `close` raise it.
    """

    def __init__(
        self,
        stage: StillStage,
        *,
        hear: Callable[[], Sequence[StillResult]],
        clock: Callable[[], int],
        length: int = 16,
        max_bytes: int = MAX_QUEUE_BYTES,
    ) -> None:
        self._stage = stage
        self._hear = hear
        self._clock = clock
        self._frames: queue.Queue[tuple[Frame, AccessUnit | None] | None] = queue.Queue(length)
        self._most_frames = length
        self._max_bytes = max_bytes
        self._error: BaseException | None = None
        self._given_up = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hvt-stills", daemon=True)
        self._thread.start()

    @property
    def full(self) -> bool:
        """Whether the next `offer` would have to wait."""
        self._raise_error()  # a dead thread leaves a full queue, and `offer` is not called any more
        return self._frames.qsize() >= self._most_frames

    def offer(self, frame: Frame, unit: AccessUnit | None) -> None:
        """Hand over one frame, in order, with its access unit if it has one."""
        self._raise_error()
        # All frames of a source have one size, so a bound in bytes is a bound in frames.
        fitting = self._max_bytes // (frame.source_bgr.nbytes + frame.base_bgr.nbytes)
        self._most_frames = min(self._frames.maxsize, max(_LEAST_FRAMES, fitting))
        self._frames.put((frame, unit))

    def close(self) -> None:
        """Let the thread finish what it has, at most for a second, then leave the rest; join it."""
        until_s = time.monotonic() + _FINISH_S
        with contextlib.suppress(queue.Full):
            self._frames.put(None, timeout=_FINISH_S)
        self._thread.join(timeout=max(0.0, until_s - time.monotonic()))
        self._given_up.set()
        self._thread.join(timeout=_FINISH_S)
        self._raise_error()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _run(self) -> None:
        lower_priority()
        try:
            while (item := self._next()) is not None and not self._given_up.is_set():
                behind = self._frames.qsize() >= _BEHIND_FRAMES
                self._stage.hear(self._hear())
                seen = self._stage.see(*item, hurry=behind)
                self._stage.send(seen, now_ns=self._clock())
        except BaseException as error:  # noqa: BLE001 - handed to the frame loop, which ends the process
            self._error = error

    def _next(self) -> tuple[Frame, AccessUnit | None] | None:
        """Return the next frame; until it comes what waits is tried again.

        Right behind a base frame the link is busy: with few frames a second there would be no other moment.
        """
        while True:
            try:
                return self._frames.get(timeout=_AGAIN_S)
            except queue.Empty:
                if self._stage.live_waits:
                    self._stage.send_waiting(now_ns=self._clock())

    def _raise_error(self) -> None:
        if self._error is not None:
            error, self._error = self._error, None
            raise error
