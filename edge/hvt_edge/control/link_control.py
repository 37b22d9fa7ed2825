"""Link control: pace, rate, repeated stills and the store are decided here alone."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass

from hvt_common.protocol.edge_words import FrameGroup
from hvt_common.protocol.messages import Feedback
from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS
from hvt_edge.keyframes import Keyframes
from hvt_edge.link.feedback import FeedbackInbox, PrimaryReceiver
from hvt_edge.stills.stage import StillSender
from hvt_edge.video.reconfigure import EncoderReconfiguration

_PART = "reports"
_MOST_WAIT_NS, _MOST_WAIT_FRAMES = 100_000_000, 1.5
"""A frame that would wait longer than both for the budget's window is left out before it is encoded. A wait until the
camera's next frame costs none, and about so long each waits a second after a keyframe that took long to code.
"""


@dataclass(eq=False)
class LinkControl:
    """Applies receiver reports: `on_feedback` in the link's thread, all else in the frame loop.

    There is no pacer without ``--adapt``, no backlog where nothing is stored while the link is offline. Whoever
    subscribes to the video and is no ground (``has_subscriber``, and not ``has_ground``) reports nothing: it gets all
    that the budget allows, and is no link of which anything is known.
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
        self._primary = PrimaryReceiver()

    def before_frame(self, now_ns: int) -> None:
        """Set budget, base rate and keyframe by the link's rate, and decide whether anything is sent at all."""
        ground = self.has_ground()
        # A ground that has left, with somebody there still who reports nothing: what was known of the path is void.
        linked = ground or (self.has_subscriber() and not self._had_ground)
        self._had_ground = ground
        offline = self.backlog is not None and self.backlog.before_frame(now_ns, linked=linked)
        if not linked:
            self._primary.forget()
        if self.pacer is None:
            return
        back = self.pacer.link(linked, reports=ground, now_ns=now_ns)
        if offline:  # what is stored has the quality that the link had
            self.reconfiguration.hold(now_ns)
        if offline or not linked:  # nothing is carried anywhere
            return
        if self.reconfiguration.track_link(now_ns) or back:
            self.keyframes.require(now_ns)

    def admits(self, now_ns: int, line_bytes: int | None = None, coding_ns: int = 0) -> bool:
        """Whether a message of so many line bytes may be coded now; held back it would only wait and grow old.

        What counts is the room once it is coded, ``coding_ns`` from now: at two frames a second, of which two fill a
        window, the last but one has left it by then.
        The size is of what would go: a keyframe, with which x265 is opened at the link's rate, has room where a
        frame of the rate of before has none. None is an average frame.
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
        self,
        *,
        stop: threading.Event,
        note: Callable[[str], None],
        turn: Callable[[], None] = lambda: None,
    ) -> None:
        """After the last frame of a recorded source: send what was stored, and call ``turn`` meanwhile."""
        self.transmitter.budget.end_base()

        def before_frame(now_ns: int) -> None:
            turn()
            self._after_last(now_ns)

        if self.backlog is not None:
            self.backlog.finish(before_frame=before_frame, stop=stop, note=note)

    def _after_last(self, now_ns: int) -> None:
        self.stills.store_lost(now_ns)
        self.before_frame(now_ns)
        self.admits(now_ns)  # which gives up what is lost: nothing else would, without frames

    def on_feedback(self, feedback: Feedback) -> None:
        """A ground reports (any thread). Where that fails the rate falls to its floor until a report counts again."""
        if feedback.session_id != self.transmitter.session_id:
            return
        try:
            self._apply(feedback, now_ns=self.clock())
        except Exception as error:  # noqa: BLE001 - in a thread of the link, where nobody would notice it
            self.failures.failed(_PART, f"a report failed ({type(error).__name__}: {error})")
            if self.pacer is not None:
                self.pacer.on_fault(self.clock())
        else:
            self.failures.works(_PART)

    def _apply(self, feedback: Feedback, *, now_ns: int) -> None:
        # Whether the report counts is decided here, once.
        sent = (self.transmitter.base_sequence, self.transmitter.still_sequence)
        report = self._primary.judge(feedback, sent=sent, now_ns=now_ns)
        self.keyframes.report_losses(feedback.receiver_id, feedback.lost + feedback.corrupt)
        if self.pacer is not None:
            self.pacer.on_report(report)
            self.keyframes.note_round_trip(self.pacer.round_trip_ns)
        if report.primary:
            self.transmitter.in_flight.on_report(feedback.base_sequence)
            self.stills.outbox.on_report(
                report.feedback.still_sequence,
                report.feedback.missing_stills,
                now_ns=now_ns,
                round_trip_ns=0 if self.pacer is None else self.pacer.round_trip_ns,
            )
        if self.backlog is not None:
            self.backlog.on_feedback(feedback, now_ns=now_ns)
        # Last: who waits there for the end goes on to store what is not acknowledged.
        self.inbox.on_report(report)


def wait_for_ground(
    has_ground: Callable[[], bool],
    *,
    edge_id: str,
    wait_s: float,
    stop: threading.Event,
    note: Callable[[str], None],
    turn: Callable[[], None] = lambda: None,
) -> None:
    """Until a ground subscribes, or for ``--wait``: a recorded source can wait for its audience.

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
