"""The frame loop in real time: base first, all other work behind it in a thread of its own.

`LinkControl` decides by the ground's reports on pace, rate, repeated stills and the store, before each frame.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import KW_ONLY, dataclass, replace
from itertools import chain
from typing import Self

from hvt_common.protocol.edge_words import FrameGroup
from hvt_common.protocol.messages import Feedback
from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS
from hvt_common.values import AccessUnit, Frame
from hvt_edge.link.feedback import FeedbackInbox, PrimaryReceiver
from hvt_edge.loop.counts import FrameCounts
from hvt_edge.operating import Keyframes
from hvt_edge.source.contract import IDLE_S
from hvt_edge.stills.stage import StillSender, StillStage
from hvt_edge.stills.worker import StillWorker
from hvt_edge.video.reconfigure import EncoderReconfiguration
from hvt_edge.video.stage import BaseStage

_MOST_GAP_NS = SECOND_NS // 4
"""Most of a clip that is left out in a row if it cannot be read in time, in its own time and in real time:
else nothing would be shown."""
_STEADY_NS = 2 * SECOND_NS
"""After this time without a lost frame, one may be late by two frames: a keyframe takes six times as long to code as
others, on a small board longer than a frame, and would cost the frames behind it. A machine too slow for all frames
gains no delay by that."""
_BEFORE_KEYFRAME_NS = 3 * SECOND_NS // 10
"""About as long as the detector takes on a small board: it does not begin this shortly before a keyframe, which may
wait longer for its room in the budget."""
_MOST_LATE_NS = SECOND_NS
"""A clip that is later than this, and not because of the link, is played slower."""
_MOST_LINK_LATE_NS = 10 * SECOND_NS
_LINK_BOUND_NS = SECOND_NS // 100
_MOST_QUEUED_S = 0.5
"""Longest queue of frames for perception. Each is tracked through before a new one is searched: with a longer queue,
and a quarter of two cores, boxes were 2.4 s old."""
_BEHIND_SHARE = 0.5
"""Share of the time between two frames: beyond it the loop is late."""

_PART, _PICTURES = "reports", "pictures"
_UNSEEN_NS = 10 * SECOND_NS
"""A ground reports it once it has waited for 4 s; a first picture may take that long on a slow link."""
_UNSEEN = (
    "a ground hears the edge and gets no picture: large packets are lost on the way (lower the MTU of the tunnel), "
    "or the link is too slow for one"
)
_MOST_WAIT_NS, _MOST_WAIT_FRAMES = 100_000_000, 1.5
"""A frame that would wait longer than both for the budget's window is left out before it is encoded. A wait until the
camera's next frame costs none, and frames wait about that long for a second after a keyframe that took long to code.
"""


@dataclass(eq=False)
class RealtimePace:
    """Takes frames when they are due; late ones are dropped before they are encoded, never after.

    A clip loses frames like a camera, and pauses for the delay that this does not make up: its clock stands still so
    long, and capture times stay those at which a camera would have taken the frames.

    Video waits for nothing behind it: frames for which the stills' thread has no place are coded and sent all the
    same, and only their analysis is skipped. ``before_frame(now_ns)`` runs first, so that rates can track the link.
    ``has_viewer()`` tells whether any program subscribes to the video.
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
    has_viewer: Callable[[], bool] = lambda: True

    def __post_init__(self) -> None:
        self._missed: int | None = None
        self._must_code_ns = 0
        self._lost_ns = -_STEADY_NS
        self._none_due_ns = 0
        self._awaited = False
        """The next frame was not there: its file has to grow first."""
        self._sent_ns = self._link_late_ns = 0
        """When the last frame was sent; how late a clip is because of a slow link, not yet made up."""
        self._bound: FrameGroup = "processor"
        """The slowest step of the last frame: coding it, the budget's window, or the link."""
        self._sending_ns = 0
        """How long the last frame waited for the budget's window and the link."""
        self._worker = StillWorker(
            self.stills,
            results=self.inbox.take,
            detected=self.inbox.take_detected,
            failures=self.failures,
            clock=self.clock,
            length=max(2, round(_MOST_QUEUED_S * self.fps)),
        )

    def steps(self, frames: Iterable[Frame | None]) -> Iterator[Frame | None]:
        """``frames``, with None for each quarter of a second for which a clip's next one is not due or not there."""
        return iter(frames) if self.live else chain.from_iterable(map(self._when_due, frames))

    def _when_due(self, frame: Frame | None) -> Iterator[Frame | None]:
        # Ends with its frame: a loop over all would hold each while the next is read.
        self._awaited |= frame is None
        while not (frame is None or self.stop.is_set()):
            if frame.capture_ns + self.counts.paused_ns - self.clock() <= IDLE_S * SECOND_NS:
                break
            self.stop.wait(IDLE_S)
            yield None
        yield frame

    def step(self, frame: Frame | None, *, missed: int = 0) -> None:
        """Encode and send one frame, then hand it to perception, also where it is not coded; or drop it.

        ``missed`` counts frames of a live source that this loop did not take in time. ``frame`` None: none has come.
        """
        self._worker.serve_requested()
        if frame is None:
            self.before_frame(self.clock())
            return
        if self._missed is None:  # frames missed before the first do not count
            self._missed = missed
        newly_missed, self._missed = missed - self._missed, missed
        self.counts.drop(self._bound, newly_missed)
        behind = newly_missed > 0 and self._bound == "processor"
        if not self.live:
            frame = self._by_clip_clock(frame)
            # A camera's own unit is never left out: all later ones build on it. The clip is played slower.
            in_time = self._in_time(frame) or frame.camera_unit is not None
            shown_lately = self.clock() - self._sent_ns < _MOST_GAP_NS
            if not in_time and frame.capture_ns < self._must_code_ns and shown_lately:
                self._lost_ns = self.clock()
                self.counts.drop(self._bound)
                return
            self._must_code_ns = frame.capture_ns + _MOST_GAP_NS
            late_ns = self.clock() - frame.capture_ns - self._sending_ns
            behind = late_ns > _BEHIND_SHARE * SECOND_NS / self.fps
        unit = self.send(frame)
        self._hand_over(frame, unit, behind=behind)

    def send(self, frame: Frame) -> AccessUnit | None:
        """Encode and send one frame; None where it is not coded."""
        now_ns = self.clock()
        self.before_frame(now_ns)
        began_ns, budget_ns = self.clock(), self.base.budget_waited_ns
        decision = self.base.decide(frame, now_ns=now_ns)
        decided_ns = self.clock()  # later, where a camera's own unit waited for its room
        unit = self.base.encode(frame, decision, now_ns=decided_ns, tracks=self.stills.latest_tracks)
        encoded_ns, taken = self.clock(), False
        if unit is not None:
            self.counts.note(frame, encode_ns=encoded_ns - decided_ns)
            taken = self.base.send(unit, decision, now_ns=encoded_ns)
        self.counts.settle(decision, coded=unit is not None, taken=taken, has_viewer=self.has_viewer())
        self._sent_ns = self.clock()
        self._sending_ns = decided_ns - began_ns + self._sent_ns - encoded_ns
        self._link_late_ns = min(_MOST_LINK_LATE_NS, self._link_late_ns + self._sending_ns)
        self._bound = "processor"
        if self._sending_ns > max(encoded_ns - decided_ns, _LINK_BOUND_NS):
            for_budget = 2 * (self.base.budget_waited_ns - budget_ns) > self._sending_ns
            self._bound = self.base.holder(self._sent_ns) if for_budget else "link"
        return unit

    def _hand_over(self, frame: Frame, unit: AccessUnit | None, *, behind: bool) -> None:
        # Video goes first: perception gets no frame while the loop is late for want of processor, and fewer for a
        # while after it lost one. Where each frame waits for its room in the budget, all are late, and no processor
        # is scarce. Where its results are not used, perception takes no time.
        used = self.stills.is_used(frame.capture_ns)
        cpu_budget, lost = self.stills.analyzer.cpu_budget, self.counts.dropped_cpu
        keyframe_due = self.base.keyframes.due(self._sent_ns + _BEFORE_KEYFRAME_NS)
        self._none_due_ns = self._none_due_ns if keyframe_due else self._sent_ns
        cpu_budget.keyframe_soon = (
            keyframe_due and self._sent_ns - self._none_due_ns < 2 * _BEFORE_KEYFRAME_NS
        )
        rests = used and not cpu_budget.admits_frame(frame.capture_ns, lost=lost, late=behind)
        taken_up = self._worker.take(frame, unit, late=rests)
        self.counts.unanalyzed += used and not taken_up

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self._worker.close()

    def _by_clip_clock(self, frame: Frame) -> Frame:
        # Later where the machine is too slow, or the file has to grow; delay by the link is made up at twice the
        # clip's speed.
        now_ns = self.clock()
        self._link_late_ns = max(0, self._link_late_ns - (now_ns - self._sent_ns))
        late_ns = now_ns - frame.capture_ns - self.counts.paused_ns - self._link_late_ns
        if late_ns > (0 if self._awaited else _MOST_LATE_NS):
            self.counts.paused_ns += late_ns
            self.counts.awaited_ns += late_ns if self._awaited else 0
        self._awaited = False
        return replace(frame, capture_ns=frame.capture_ns + self.counts.paused_ns)

    def _in_time(self, frame: Frame) -> bool:
        # Wait until the frame of a clip is due; False where it is so late that the next is due already.
        now_ns = self.clock()
        early_ns = frame.capture_ns - now_ns
        if early_ns > 0:
            self.stop.wait(early_ns / SECOND_NS)
        frames = 2 if now_ns - self._lost_ns >= _STEADY_NS else 1
        return -early_ns < frames * SECOND_NS / self.fps


@dataclass(eq=False)
class LinkControl:
    """Applies receiver reports: `on_feedback` in the link's thread, the rest in the frame loop.

    There is no pacer without ``--adapt``, no backlog where nothing is stored while the link is offline. A program
    that subscribes to the video and is no ground (``has_subscriber``, and not ``has_ground``) reports nothing: it
    gets all that the budget allows, and its link is unknown.
    """

    _: KW_ONLY
    has_ground: Callable[[], bool]
    has_subscriber: Callable[[], bool]
    keyframes: Keyframes
    inbox: FeedbackInbox
    reconfiguration: EncoderReconfiguration
    clock: Callable[[], int]
    stills: StillSender
    failures: Failures

    def __post_init__(self) -> None:
        self.transmitter, self.backlog = self.stills.transmitter, self.stills.backlog
        self.pacer = self.transmitter.pacer
        self._had_ground = False
        self._unseen_ns: int | None = None
        """Since when the primary receiver sees nothing."""
        self._unseen_failure = 0
        self._primary = PrimaryReceiver()

    def before_frame(self, now_ns: int) -> None:
        """Set budget, base rate and keyframe by the link's rate, and decide whether frames are sent at all."""
        ground = self.has_ground()
        # A ground has left, and the remaining subscriber reports nothing: the path's measurements are void.
        linked = ground or (self.has_subscriber() and not self._had_ground)
        self._had_ground = ground
        offline = self.backlog is not None and self.backlog.before_frame(now_ns, linked=linked)
        if not linked:
            self._primary.forget()
            self._note_seen(True, now_ns)
        if self.pacer is None:
            return
        back = self.pacer.link(linked, reports=ground, now_ns=now_ns)
        if offline:  # stored objects have the quality that the link had
            self.reconfiguration.hold(now_ns)
        if offline or not linked:  # nothing is carried anywhere
            return
        if self.reconfiguration.track_link(now_ns) or back:
            self.keyframes.require(now_ns)

    def admits(self, now_ns: int, line_bytes: int | None = None, coding_ns: int = 0) -> bool:
        """Whether a message of ``line_bytes`` may be coded now; a delayed one would only wait and grow old.

        The room once it is coded counts, ``coding_ns`` from now: at two frames a second, of which two fill a window,
        the last but one has left it by then.
        The size is the next message's: a keyframe, with which x265 is opened at the link's rate, has room where a
        frame of the former rate has none. None is an average frame.
        """
        if self.pacer is None:
            return True
        wait_ns = self.transmitter.base_wait_ns(now_ns + coding_ns, line_bytes=line_bytes)
        most_ns = max(_MOST_WAIT_NS, _MOST_WAIT_FRAMES * SECOND_NS / self.reconfiguration.nominal_fps)
        return self.pacer.admits_base(now_ns, coding_ns=coding_ns) and wait_ns <= most_ns

    def holder(self, now_ns: int) -> FrameGroup:
        """The part without room for a frame that `admits` has just held back."""
        return "link" if self.pacer is not None and self.pacer.holds(now_ns) else "budget"

    def finish(
        self, *, stop: threading.Event, note: Callable[[str], None], turn: Callable[[], None] = lambda: None
    ) -> None:
        """After the last frame of a recorded source: send stored objects, and call ``turn`` meanwhile."""
        self.transmitter.budget.end_base()

        def before_frame(now_ns: int) -> None:
            turn()
            self.stills.store_lost(now_ns)
            self.before_frame(now_ns)
            self.admits(now_ns)  # this gives up lost messages: without frames nothing else would

        if self.backlog is not None:
            self.backlog.finish(before_frame=before_frame, stop=stop, note=note)

    def on_feedback(self, feedback: Feedback) -> None:
        """A ground reports (any thread). Where that fails the rate falls to its floor until a report counts again."""
        if feedback.session_id != self.transmitter.session_id:
            return
        if not self.failures.attempt(_PART, self._apply, False, feedback) and self.pacer is not None:
            self.pacer.on_fault(self.clock())

    def _note_seen(self, seen: bool, now_ns: int) -> None:  # noqa: FBT001 - the news itself
        # Both threads: whichever is later, the next report sets it right.
        if seen:
            self._unseen_ns = None
            self.failures.over(_PICTURES, self._unseen_failure)
            self._unseen_failure = 0
        elif self._unseen_ns is None:
            self._unseen_ns = now_ns
        elif not self._unseen_failure and now_ns - self._unseen_ns >= _UNSEEN_NS:
            self._unseen_failure = self.failures.failed(_PICTURES, _UNSEEN)

    def _apply(self, feedback: Feedback) -> bool:
        # The decision whether the report counts is made here, once.
        now_ns = self.clock()
        sent = (self.transmitter.base_sequence, self.transmitter.still_sequence)
        report = self._primary.judge(feedback, sent=sent, now_ns=now_ns)
        self.keyframes.report_losses(feedback.receiver_id, feedback.lost_so_far + feedback.corrupt)
        if self.pacer is not None:
            self.pacer.on_report(report)
            self.keyframes.note_round_trip(self.pacer.round_trip_ns)
        if report.primary:
            self._note_seen(not feedback.misses_video, now_ns)
            self.transmitter.in_flight.on_report(feedback.base_sequence, feedback.missing_base)
            self.stills.outbox.on_report(
                report.feedback.still_sequence,
                report.feedback.missing_stills,
                now_ns=now_ns,
                round_trip_ns=0 if self.pacer is None else self.pacer.round_trip_ns,
            )
        if self.backlog is not None:
            self.backlog.on_feedback(feedback, now_ns=now_ns)
        # After the outbox: a thread that waits there for the end then stores unacknowledged messages.
        self.inbox.on_report(report)
        if report.primary:
            self.transmitter.resend(feedback.missing_base, now_ns=now_ns)
        return True


def wait_for_ground(
    has_ground: Callable[[], bool],
    *,
    edge_id: str,
    wait_s: float,
    stop: threading.Event,
    note: Callable[[str], None],
    turn: Callable[[], None] = lambda: None,
) -> None:
    """Wait until a ground subscribes, or for ``--wait``: a recorded source can wait for its audience.

    ``turn`` is called meanwhile.
    """
    if has_ground():
        return
    deadline_s = time.monotonic() + wait_s
    note(f"{edge_id}: waiting up to {wait_s:g} s for a ground (--wait)")
    while not has_ground() and not stop.is_set():
        if time.monotonic() >= deadline_s:
            note(f"{edge_id}: no ground yet; playing on, one may join at any time")
            return
        turn()
        stop.wait(0.02)
