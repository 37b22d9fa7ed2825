"""The frame loop in lockstep: as fast as the parts allow, nothing dropped, every window in media time.

The same input gives the same bytes and stills, however fast the machine: what is done side by side (a frame is
encoded while the one before it is seen) does not change the order in which the budget is spent, and what a ground
reports counts a fixed number of frames later.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Self

from hvt_common.values import Frame
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.loop.counts import FrameCounts
from hvt_edge.operating.keyframes import KeyframePlan
from hvt_edge.perception.analyzer import AnalyzedFrame
from hvt_edge.stills.stage import StillStage
from hvt_edge.video.stage import BaseStage

__all__ = ["LockstepPace"]

_AHEAD_S = 1.0
"""How far the edge runs ahead of the ground, in media time: what a ground reports counts so much later."""
_GROUND_GONE_S = 20.0
"""A ground that has not answered for so long is not waited for again."""
_UNHEARD_S = 2.0
"""Nor one that has not listened for so long; a link may break and come back."""
_STOP_S = 0.3
"""How long the ground is waited for when the run is to stop."""
_LOOK_S = 0.1


class LockstepPace:
    """``heard()``: whether a ground listens. Where one does at the start, the loop waits for it, until ``stop``."""

    def __init__(
        self,
        base: BaseStage,
        stills: StillStage,
        *,
        inbox: FeedbackInbox,
        keyframes: KeyframePlan,
        fps: float,
        counts: FrameCounts,
        heard: Callable[[], bool],
        stop: threading.Event,
    ) -> None:
        self._base = base
        self._stills = stills
        self._inbox = inbox
        self._keyframes = keyframes
        self._ahead_frames = max(1, round(_AHEAD_S * fps))
        self._counts = counts
        self._heard = heard
        self._stop = stop
        self._follows = heard()
        self._eyes = ThreadPoolExecutor(1, thread_name_prefix="hvt-sight")
        self._seeing: tuple[Frame, int, bool, Future[AnalyzedFrame]] | None = None
        self._in_flight: deque[tuple[int, int, set[int]]] = deque()
        """(tick, newest coded tick by then, stills sent with it): what the ground is to answer."""
        self._coded_index = -1
        self._newest_answered = -1
        self.now_ns = 0
        """The capture time of the newest frame."""

    def step(self, frame: Frame) -> None:
        """Encode this frame while the one before is seen; send that one's stills, then this one's unit.

        A tick that is not coded is seen all the same: its source may show what no base frame does.
        """
        began_ns = time.perf_counter_ns()
        unit = self._base.encode(frame, now_ns=frame.capture_ns, tracks=self._stills.latest_tracks)
        if unit is not None:
            self._counts.note(frame.index, encode_ns=time.perf_counter_ns() - began_ns)
        self._finish_seeing()
        self.now_ns = frame.capture_ns
        if unit is not None:
            self._coded_index = frame.index
            self._base.send(unit, now_ns=frame.capture_ns)
        held = self._keyframes.due(frame.capture_ns)
        seen = self._eyes.submit(self._stills.analyze, frame, unit)
        self._seeing = (frame, self._coded_index, held, seen)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                self._finish_seeing()
                self._follow_ground(before=self._counts.last_index + 1)
        finally:
            self._eyes.shutdown()

    def _finish_seeing(self) -> None:
        if self._seeing is None:
            return
        frame, coded_index, held, future = self._seeing
        self._seeing = None
        self._follow_ground(before=frame.index - self._ahead_frames + 1)
        sent = self._stills.send(future.result(), now_ns=frame.capture_ns, held=held)
        if (
            sent or coded_index == frame.index
        ):  # of other ticks the ground learns nothing, and answers nothing
            self._in_flight.append((frame.index, coded_index, sent))

    def _follow_ground(self, *, before: int) -> None:
        """Wait until the ground has done with the frames before this one, and take in what it made of them."""
        while self._in_flight and self._in_flight[0][0] < before:
            _, coded_index, sent = self._in_flight.popleft()
            if self._follows:
                self._follows = self._answered(coded_index, sent)
            self._newest_answered = max([self._newest_answered, *sent])
        self._stills.on_results(self._inbox.take_up_to(self._newest_answered))

    def _answered(self, index: int, sent: set[int]) -> bool:
        """Wait for the ground's answer to a frame and its stills; False where it is gone or never answers."""
        waited_s = unheard_s = 0.0
        while not self._inbox.wait_for(frame_index=index, stills=sent, timeout_s=_LOOK_S):
            waited_s += _LOOK_S
            unheard_s = 0.0 if self._heard() else unheard_s + _LOOK_S
            patience_s = _STOP_S if self._stop.is_set() else _GROUND_GONE_S
            if waited_s >= patience_s or unheard_s >= _UNHEARD_S:
                return False
        return True
