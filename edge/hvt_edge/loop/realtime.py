"""The frame loop in real time: base first, everything else behind it in a thread of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from hvt_common.runtime.clock import SteadyClock
from hvt_common.values import Frame
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.loop.counts import FrameCounts
from hvt_edge.source.pacing import realtime_admits
from hvt_edge.stills.stage import StillStage
from hvt_edge.stills.worker import StillWorker
from hvt_edge.video.stage import BaseStage

__all__ = ["RealtimePace"]


class RealtimePace:
    """Takes frames when they are due, drops those it cannot take before they are encoded, never after.

    ``follow(now_ns)`` is called before each frame, so that rates can follow the link.
    """

    def __init__(
        self,
        base: BaseStage,
        stills: StillStage,
        *,
        inbox: FeedbackInbox,
        clock: SteadyClock,
        fps: float,
        live: bool,
        counts: FrameCounts,
        stop: threading.Event,
        follow: Callable[[int], None] = lambda _now_ns: None,
    ) -> None:
        self._base = base
        self._stills = stills
        self._clock = clock
        self._fps = fps
        self._live = live
        self._counts = counts
        self._stop = stop
        self._follow = follow
        self._worker = StillWorker(stills, results=inbox.take, clock=clock)
        self.now_ns = clock()
        """The time that windows go by, of the newest frame."""

    def step(self, frame: Frame) -> None:
        """Encode and send one frame, and let the worker see it, also where it is not coded; or drop it."""
        on_time = self._live or realtime_admits(frame, clock=self._clock, fps=self._fps, stop=self._stop)
        if not on_time or self._worker.full:
            self._counts.dropped += 1
            return
        self.now_ns = self._clock()
        self._follow(self.now_ns)
        began_ns = time.perf_counter_ns()
        unit = self._base.encode(frame, now_ns=self.now_ns, tracks=self._stills.latest_tracks)
        if unit is not None:
            self._counts.note(frame.index, encode_ns=time.perf_counter_ns() - began_ns)
            self.now_ns = self._clock()
            self._base.send(unit, now_ns=self.now_ns)
        elif self._base.held:
            self._counts.dropped += 1
        self._worker.offer(frame, unit)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._worker.close()
