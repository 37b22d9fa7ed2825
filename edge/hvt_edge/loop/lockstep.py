"""The frame loop in lockstep: as fast as the parts allow, nothing dropped, every window in media time.

The same input gives the same bytes and stills, however fast the machine: parallel work (a frame is
encoded while the one before it is analyzed) does not change the order in which the budget is spent, and a ground's
report counts a fixed number of frames later.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import KW_ONLY, dataclass
from types import TracebackType
from typing import Self

from hvt_common.values import Frame
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.loop.counts import FrameCounts
from hvt_edge.operating import Keyframes, LoopClock
from hvt_edge.perception.analyzer import AnalyzedFrame
from hvt_edge.stills.stage import StillStage
from hvt_edge.video.stage import BaseStage

_AHEAD_S = 1.0
"""The edge's lead over the ground, in media time: reports of the ground count that much later."""
_GROUND_GONE_S = 20.0
"""The loop does not wait again for a ground that has not answered for this long."""
_UNSUBSCRIBED_S = 2.0
"""The same for a ground that has not subscribed for this long; a link may break and come back."""
_STOP_S = 0.3
"""How long the loop waits for the ground when the run is to stop."""
_POLL_S = 0.1


@dataclass(eq=False)
class LockstepPace:
    """Runs frames in media time; if a ground is there at the start, the loop waits for its answers.

    ``fps`` counts frame indices a second; ``clock`` advances with each frame. The one worker of ``executor`` runs
    perception beside the next frame's encoding; it is closed with the pace.
    """

    base: BaseStage
    stills: StillStage
    _: KW_ONLY
    inbox: FeedbackInbox
    keyframes: Keyframes
    clock: LoopClock
    fps: float
    counts: FrameCounts
    has_ground: Callable[[], bool]
    stop: threading.Event
    executor: Executor | None = None
    has_viewer: Callable[[], bool] = lambda: True

    def __post_init__(self) -> None:
        self._ahead_frames = max(1, round(_AHEAD_S * self.fps))
        self._waits = self.has_ground()
        self._executor = self.executor or ThreadPoolExecutor(1, thread_name_prefix="hvt-perception")
        self._analysis: tuple[Frame, int, bool, Future[AnalyzedFrame]] | None = None
        self._in_flight: deque[tuple[int, int, set[int]]] = deque()
        """(frame index, newest coded index by then, stills sent with it): the expected answers of the ground."""
        self._coded_index = -1
        self._newest_answered = self._newest_analyzed = -1

    def steps(self, frames: Iterable[Frame | None]) -> Iterator[Frame | None]:
        """``frames`` as they are: no frame waits until it is due."""
        yield from frames

    def step(self, frame: Frame | None, *, missed: int = 0) -> None:
        """Encode this frame while the one before is analyzed; send that one's stills, then this one's unit.

        A frame that is not coded is analyzed all the same: its source may show objects that no base frame does.
        """
        del missed  # frames of a camera, which does not wait
        if frame is None:
            return
        now_ns = frame.capture_ns
        began_ns = time.perf_counter_ns()
        decision = self.base.decide(frame, now_ns=now_ns)
        unit = self.base.encode(frame, decision, now_ns=now_ns, tracks=self.stills.latest_tracks)
        if unit is not None:
            self.counts.note(frame, encode_ns=time.perf_counter_ns() - began_ns)
        self._finish_analysis()
        self.clock.advance(now_ns)
        taken = False
        if unit is not None:
            self._coded_index = frame.index
            taken = self.base.send(unit, decision, now_ns=now_ns)
        self.counts.settle(decision, coded=unit is not None, taken=taken, has_viewer=self.has_viewer())
        held = self.keyframes.due(now_ns)
        analysis = self._executor.submit(self.stills.analyze, frame, unit)
        self._analysis = (frame, self._coded_index, held, analysis)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                self._finish_analysis()
                self._wait_for_answers(before=self.counts.last_index + 1)
        finally:
            self._executor.shutdown()

    def _finish_analysis(self) -> None:
        if self._analysis is None:
            return
        frame, coded_index, held, analysis = self._analysis
        self._analysis = None
        self._wait_for_answers(before=frame.index - self._ahead_frames + 1)
        analyzed = analysis.result()
        sent = self.stills.send_requested(now_ns=frame.capture_ns, held=held)
        sent |= self.stills.step(analyzed, now_ns=frame.capture_ns, held=held)
        # The ground receives nothing of other frames, and answers nothing.
        if sent or coded_index == frame.index:
            self._in_flight.append((frame.index, coded_index, sent))

    def _wait_for_answers(self, *, before: int) -> None:
        while self._in_flight and self._in_flight[0][0] < before:
            _, coded_index, sent = self._in_flight.popleft()
            if self._waits:
                self._waits = self._answered(coded_index, sent)
            self._newest_answered = max([self._newest_answered, *sent])
            self._newest_analyzed = coded_index
        self.stills.on_results(
            self.inbox.take_up_to(self._newest_answered),
            detected=self.inbox.take_detected(up_to=self._newest_analyzed),
        )

    def _answered(self, index: int, sent: set[int]) -> bool:
        # Wait for the ground's answer to a frame and its stills; False where it is gone or never answers.
        waited_s = unsubscribed_s = 0.0
        while not self.inbox.wait_for(frame_index=index, stills=sent, timeout_s=_POLL_S):
            waited_s += _POLL_S
            unsubscribed_s = 0.0 if self.has_ground() else unsubscribed_s + _POLL_S
            patience_s = _STOP_S if self.stop.is_set() else _GROUND_GONE_S
            if waited_s >= patience_s or unsubscribed_s >= _UNSUBSCRIBED_S:
                return False
        return True
