"""The threads of perception and stills in real time.

Detection delays neither the base stream nor a requested still.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from dataclasses import KW_ONLY, dataclass

from hvt_common.errors import foreign
from hvt_common.protocol.messages import StillResult
from hvt_common.runtime.failures import Failures, RetryPause, Turns
from hvt_common.runtime.process import in_thread, lower_priority
from hvt_common.values import AccessUnit, Frame
from hvt_edge.perception.shadow import Detected
from hvt_edge.stills.stage import StillStage

_PART, _REQUESTED_PART = "stills", "requested stills"
_LEAST_FRAMES = 2
MAX_QUEUE_BYTES = 24 * 2**20
"""Bytes of queued frames: 9 of 1280x720 that are coded in that size, 2 of 1920x1080 and more."""
_RETRY_S = 0.025
_FAILED_S = 1.0
_MOST_SKIPPED_BYTES = 2 * 2**20


class SkippedUnits:
    """Access units of frames that were not analyzed: the decoder needs them before the next. Bounded in bytes."""

    def __init__(self) -> None:
        self._units: list[AccessUnit] = []
        self._whole = True
        """Whether all units since the last keyframe are there."""

    def add(self, unit: AccessUnit | None) -> None:
        """This frame is not analyzed; ``unit`` is None where it was not coded."""
        if unit is None:
            return
        if unit.keyframe:
            self._units, self._whole = [], True
        self._units.append(unit)
        if not self._whole or sum(len(one.data) for one in self._units) > _MOST_SKIPPED_BYTES:
            self._units, self._whole = [], False

    def lose(self) -> None:
        """Units that were handed out did not reach the decoder."""
        self._units, self._whole = [], False

    def take(self, unit: AccessUnit | None) -> tuple[AccessUnit | None, tuple[AccessUnit, ...]]:
        """Return the units that the decoder may be given now: this frame's, and the earlier ones.

        Where units are missing it gets none until a keyframe: the frame is analyzed as one that was not coded.
        """
        if unit is None:
            return None, ()
        if unit.keyframe:
            self._units, self._whole = [], True
        skipped, self._units = tuple(self._units), []
        return (unit, skipped) if self._whole else (None, ())


@dataclass(eq=False)
class StillWorker:
    """Runs a `StillStage` in a thread of its own, and requested stills in another.

    The queue is bounded in frames and in bytes. Before each frame the thread takes the grounds' reports:
    ``results()`` of stills, and detections by ``detected()``. An error in it stops stills and perception
    for a while, never the video: queued frames are given up, and the stage goes on from a keyframe.

    The other thread has not the lower priority: it codes and sends requested stills while a detection, a decision
    or an automatic still takes its time, and ends with the last of them.
    """

    stage: StillStage
    _: KW_ONLY
    results: Callable[[], Sequence[StillResult]]
    detected: Callable[[], Detected | None] = lambda: None
    failures: Failures
    clock: Callable[[], int]
    length: int = 16
    max_bytes: int = MAX_QUEUE_BYTES
    finish_s: float = 1.0
    pause: RetryPause | None = None

    def __post_init__(self) -> None:
        self._pause = self.pause or RetryPause()
        self._frames: queue.Queue[tuple[Frame, AccessUnit | None, Sequence[AccessUnit]] | None] = queue.Queue(
            self.length
        )
        self._most_frames = self.length
        self._lock = threading.Lock()
        self._skipped = SkippedUnits()
        self._given_up = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hvt-stills", daemon=True)
        self._requested: Future[None] | None = None
        self._thread.start()

    @property
    def queued(self) -> int:
        return self._frames.qsize()

    @property
    def full(self) -> bool:
        """Whether the queue has no room for the next frame, or the stage has failed a moment ago."""
        return self._frames.qsize() >= self._most_frames or not self._pause.due(self.clock())

    def take(self, frame: Frame, unit: AccessUnit | None, *, late: bool = False) -> bool:
        """Queue one frame, in order, with its access unit if it has one; False where it is skipped."""
        self.stage.capture(frame)
        # All frames of a source have one size, so a bound in bytes is a bound in frames.
        pictures = {id(one): one.nbytes for one in (frame.source_bgr, frame.base_bgr)}
        fitting = self.max_bytes // sum(pictures.values())
        self._most_frames = min(self._frames.maxsize, max(_LEAST_FRAMES, fitting))
        with self._lock:
            if self.full or late:
                self._skipped.add(unit)
                return False
            self._frames.put((frame, *self._skipped.take(unit)))
        return True

    def close(self) -> None:
        """Let the threads finish their queued work, at most for ``finish_s``, then give up the rest; join them."""
        until_s = time.monotonic() + self.finish_s
        self.serve_requested()
        with contextlib.suppress(queue.Full):
            self._frames.put(None, timeout=self.finish_s)
        self._thread.join(timeout=max(0.0, until_s - time.monotonic()))
        self._given_up.set()
        until_s = time.monotonic() + self.finish_s
        self._thread.join(timeout=self.finish_s)
        wait(filter(None, [self._requested]), timeout=max(0.0, until_s - time.monotonic()))

    def serve_requested(self) -> None:
        """Have requested stills coded and sent, where any wait; call it often, in a thread of full priority."""
        if self.stage.outbox.on_demand is not None and (self._requested is None or self._requested.done()):
            with contextlib.suppress(RuntimeError):  # no thread is to be had now
                self._requested = in_thread(self._run_requested, name="hvt-requested", lowered=False)

    def _run(self) -> None:
        lower_priority()
        turns = Turns(_PART, self.failures, clock=self.clock)
        while not self._given_up.is_set():
            try:
                if (item := self._next()) is None:
                    return
                with turns:
                    self.stage.analyzer.cpu_budget.queued = self._frames.qsize()
                    self.stage.on_results(self.results(), detected=self.detected())
                    analyzed = self.stage.analyze(*item)
                    self.stage.step(analyzed, now_ns=self.clock())
                self.failures.works(_PART)
            except foreign() as error:  # it ends stills for a while, never the flight
                self._fail(error)

    def _run_requested(self) -> None:
        turns = Turns(_REQUESTED_PART, self.failures, clock=self.clock)
        while self.stage.outbox.on_demand is not None and not self._given_up.is_set():
            try:
                with turns:
                    self.stage.send_requested(now_ns=self.clock())
                self.failures.works(_REQUESTED_PART)
            except foreign() as error:  # it ends one requested still, never the flight
                self.failures.failed(_REQUESTED_PART, f"one was not sent ({type(error).__name__}: {error})")
                self._given_up.wait(_FAILED_S)
            self._given_up.wait(_RETRY_S)

    def _fail(self, error: BaseException) -> None:
        with self._lock:
            self._pause.failed(self.clock())
            self._skipped.lose()
            with contextlib.suppress(queue.Empty):
                while self._frames.get_nowait() is not None:
                    pass
                self._given_up.set()  # the removed item was the end mark
        self.failures.failed(_PART, f"perception and stills stopped ({type(error).__name__}: {error})")

    def _next(self) -> tuple[Frame, AccessUnit | None, Sequence[AccessUnit]] | None:
        # Right behind a base frame the link is busy: with few frames a second pending stills had no other moment.
        while True:
            try:
                return self._frames.get(timeout=_RETRY_S)
            except queue.Empty:
                if len(self.stage.outbox) and self._pause.due(self.clock()):
                    self.stage.send_pending(now_ns=self.clock())
