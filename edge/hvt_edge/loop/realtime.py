"""The frame loop in real time: base first, everything else behind it in a thread of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from hvt_common.values import Frame
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.loop.counts import FrameCounts
from hvt_edge.source.pacing import realtime_admits
from hvt_edge.stills.stage import StillStage
from hvt_edge.stills.worker import StillWorker
from hvt_edge.video.frame_decision import Action
from hvt_edge.video.stage import BaseStage

__all__ = ["RealtimePace"]


class RealtimePace:
    """Takes frames when they are due; what it cannot code in time is dropped before it is encoded, never after.

    Video waits for nothing behind it: where the stills' thread is behind, frames are coded and sent all the same, and
    the analysis of the oldest that wait is skipped. ``before_frame(now_ns)`` runs first, so that rates can track the
    link.
    """

    def __init__(
        self,
        base: BaseStage,
        stills: StillStage,
        *,
        inbox: FeedbackInbox,
        clock: Callable[[], int],
        fps: float,
        live: bool,
        counts: FrameCounts,
        stop: threading.Event,
        before_frame: Callable[[int], None] = lambda _now_ns: None,
    ) -> None:
        self._base = base
        self._stills = stills
        self._clock = clock
        self._fps = fps
        self._live = live
        self._counts = counts
        self._stop = stop
        self._before_frame = before_frame
        self._worker = StillWorker(stills, results=inbox.take, clock=clock)

    def step(self, frame: Frame) -> None:
        """Encode and send one frame, then hand it to perception, also where it is not coded; or drop it."""
        if not self._live and not realtime_admits(frame, clock=self._clock, fps=self._fps, stop=self._stop):
            self._counts.dropped += 1
            return
        now_ns = self._clock()
        self._before_frame(now_ns)
        began_ns = time.perf_counter_ns()
        decision = self._base.decide(frame.index, now_ns=now_ns)
        unit = self._base.encode(frame, decision, now_ns=now_ns, tracks=self._stills.latest_tracks)
        if unit is not None:
            self._counts.note(frame.index, encode_ns=time.perf_counter_ns() - began_ns)
            self._base.send(unit, decision, now_ns=self._clock())
        elif decision.action is Action.HOLD:
            self._counts.dropped += 1
        self._counts.unanalyzed += self._worker.offer(frame, unit)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._worker.close()
