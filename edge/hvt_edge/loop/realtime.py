"""The frame loop in real time: base first, everything else behind it in a thread of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import Self

from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS
from hvt_common.values import Frame
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.loop.counts import FrameCounts
from hvt_edge.stills.stage import StillStage
from hvt_edge.stills.worker import StillWorker
from hvt_edge.video.frame_decision import Action
from hvt_edge.video.stage import BaseStage

__all__ = ["RealtimePace"]

_MOST_GAP_NS = SECOND_NS // 4
"""Of a clip that cannot be read in time so much is left out in a row, and no more: else nothing would be shown."""
_LINK_BOUND_NS = SECOND_NS // 100
_BEHIND_SHARE = 0.5
"""Of the time between two frames: later than that the loop is late."""


@dataclass(eq=False)
class RealtimePace:
    """Takes frames when they are due; what it cannot code in time is dropped before it is encoded, never after.

    Video waits for nothing behind it: frames for which the stills' thread has no place are coded and sent all the
    same, and only their analysis is skipped. ``before_frame(now_ns)`` runs first, so that rates can track the link.
    """

    base: BaseStage
    stills: StillStage
    _: KW_ONLY
    inbox: FeedbackInbox
    clock: Callable[[], int]
    fps: float
    live: bool
    counts: FrameCounts
    stop: threading.Event
    failures: Failures
    before_frame: Callable[[int], None] = lambda _now_ns: None

    def __post_init__(self) -> None:
        self._missed: int | None = None
        self._must_code_ns = 0
        self._link_bound = False
        """Sending the last frame took longer than coding it."""
        self._worker = StillWorker(
            self.stills, results=self.inbox.take, failures=self.failures, clock=self.clock
        )

    def step(self, frame: Frame | None, *, missed: int = 0) -> None:
        """Encode and send one frame, then hand it to perception, also where it is not coded; or drop it.

        ``missed`` counts frames of a live source that came before this loop took them; None: there is none now.
        """
        if frame is None:
            self.before_frame(self.clock())
            return
        if self._missed is None:  # before the first frame there was no loop
            self._missed = missed
        newly_missed, self._missed = missed - self._missed, missed
        self.counts.captured += 1 + newly_missed
        self._drop(newly_missed)
        behind = newly_missed > 0
        if not self.live:
            if not self._in_time(frame) and frame.capture_ns < self._must_code_ns:
                self._drop(1)
                return
            self._must_code_ns = frame.capture_ns + _MOST_GAP_NS
            behind = self.clock() - frame.capture_ns > _BEHIND_SHARE * SECOND_NS / self.fps
        now_ns = self.clock()
        self.before_frame(now_ns)
        began_ns = time.perf_counter_ns()
        decision = self.base.decide(frame.index, now_ns=now_ns)
        unit = self.base.encode(frame, decision, now_ns=now_ns, tracks=self.stills.latest_tracks)
        encoded_ns = time.perf_counter_ns()
        if unit is not None:
            self.counts.note(frame.index, encode_ns=encoded_ns - began_ns)
            self.base.send(unit, decision, now_ns=self.clock())
        elif decision.action is Action.HOLD:
            self.counts.dropped_link += 1
        sending_ns = time.perf_counter_ns() - encoded_ns
        self._link_bound = sending_ns > max(encoded_ns - began_ns, _LINK_BOUND_NS)
        # Video goes first: perception gets no frame while the loop is late.
        self.counts.unanalyzed += not self._worker.take(frame, unit, late=behind)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self._worker.close()

    def _drop(self, count: int) -> None:
        """So many frames came while the one before was coded or sent, whichever took longer."""
        if self._link_bound:
            self.counts.dropped_link += count
        else:
            self.counts.dropped_cpu += count

    def _in_time(self, frame: Frame) -> bool:
        """Wait until the frame of a clip is due; False where it is so late that the next is due already."""
        early_ns = frame.capture_ns - self.clock()
        if early_ns > 0:
            self.stop.wait(early_ns / SECOND_NS)
        return -early_ns < SECOND_NS / self.fps
