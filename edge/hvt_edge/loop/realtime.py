"""The frame loop in real time: base first, everything else behind it in a thread of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from hvt_common.values import AccessUnit, Frame
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.loop.counts import FrameCounts
from hvt_edge.source.pacing import realtime_admits
from hvt_edge.stills.stage import StillStage
from hvt_edge.stills.worker import StillWorker
from hvt_edge.video.frame_decision import Action
from hvt_edge.video.stage import BaseStage

__all__ = ["RealtimePace", "SkippedUnits"]

_MOST_SKIPPED_BYTES = 2 * 2**20


class RealtimePace:
    """Takes frames when they are due; what it cannot code in time is dropped before it is encoded, never after.

    Video waits for nothing behind it: frames for which the stills' thread has no place are coded and sent all the
    same, and only their analysis is skipped. ``before_frame(now_ns)`` runs first, so that rates can track the link.
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
        self._skipped = SkippedUnits()
        self._worker = StillWorker(stills, results=inbox.take, clock=clock)

    def step(self, frame: Frame) -> None:
        """Encode and send one frame, then hand it to perception, also where it is not coded; or drop it."""
        if not self._live and not realtime_admits(frame, clock=self._clock, fps=self._fps, stop=self._stop):
            self._counts.dropped_cpu += 1
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
            self._counts.dropped_link += 1
        self._analyze(frame, unit)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._worker.close()

    def _analyze(self, frame: Frame, unit: AccessUnit | None) -> None:
        if self._worker.full:
            self._counts.unanalyzed += 1
            self._skipped.add(unit)
        else:
            self._worker.offer(frame, *self._skipped.take(unit))


class SkippedUnits:
    """Access units of frames that were not analyzed: the decoder needs them before the next. Bounded in bytes."""

    def __init__(self) -> None:
        self._units: list[AccessUnit] = []
        self._whole = True
        """Whether all since the last keyframe are there."""

    def add(self, unit: AccessUnit | None) -> None:
        """This frame is not analyzed; ``unit`` is None where it was not coded."""
        if unit is None:
            return
        if unit.keyframe:
            self._units, self._whole = [], True
        self._units.append(unit)
        if not self._whole or sum(len(one.data) for one in self._units) > _MOST_SKIPPED_BYTES:
            self._units, self._whole = [], False

    def take(self, unit: AccessUnit | None) -> tuple[AccessUnit | None, tuple[AccessUnit, ...]]:
        """Return what the decoder may be given now: this frame's unit, and those before it.

        Where units are missing it is nothing until a keyframe: the frame is analyzed as one that was not coded.
        """
        if unit is None:
            return None, ()
        if unit.keyframe:
            self._units, self._whole = [], True
        skipped, self._units = tuple(self._units), []
        return (unit, skipped) if self._whole else (None, ())
