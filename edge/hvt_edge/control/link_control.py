"""What the link carries, decided in one place: pace, rate, what is sent again, and what is kept for later."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from hvt_common.protocol.messages import Feedback
from hvt_edge.backlog.outage import BaseInFlight
from hvt_edge.backlog.stage import BacklogStage
from hvt_edge.config import EdgeConfig
from hvt_edge.link.pacer import Pacer
from hvt_edge.link.receivers import PrimaryReceiver
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.operating.keyframes import KeyframePlan
from hvt_edge.stills.outbox import Outbox
from hvt_edge.stills.sending import StillSender
from hvt_edge.video.reconfigure import EncoderReconfiguration

__all__ = ["LinkControl", "wait_for_ground"]

_MOST_WAIT_NS = 100_000_000
"""A frame that would wait longer for the budget's window is dropped before it is encoded."""


class LinkControl:
    """One for each run: `hear` in the link's thread, all else in the frame loop.

    ``pacer`` is None without ``--adapt``. `attach` before the first frame; reports may come before that.
    """

    def __init__(
        self, pacer: Pacer | None, in_flight: BaseInFlight, outbox: Outbox, *, keyframes: KeyframePlan
    ) -> None:
        self.pacer = pacer
        self.in_flight = in_flight
        self.outbox = outbox
        self._primary = PrimaryReceiver()
        self.backlog: BacklogStage | None = None
        """Who keeps what the link cannot carry away; None where nobody does."""
        self._keyframes = keyframes
        self._linked: Callable[[], bool] = lambda: False
        self._sender: Transmitter | None = None
        self._reconfiguration: EncoderReconfiguration | None = None
        self._stills: StillSender | None = None

    def attach(
        self,
        *,
        linked: Callable[[], bool],
        sender: Transmitter,
        reconfiguration: EncoderReconfiguration,
        stills: StillSender,
        backlog: BacklogStage | None,
    ) -> None:
        """What it decides for. ``linked()`` tells whether a ground listens."""
        self._linked, self._sender, self._reconfiguration, self.backlog = (
            linked,
            sender,
            reconfiguration,
            backlog,
        )
        self._stills = stills

    def before_frame(self, now_ns: int) -> None:
        """What the link carries decides on budget, base rate, keyframe, and on whether anything is sent at all."""
        linked = self._linked()
        offline = self.backlog is not None and self.backlog.before_frame(now_ns, linked=linked)
        if self.pacer is None:
            return
        back = self.pacer.link(linked, now_ns=now_ns)
        assert self._reconfiguration is not None, "attached before the first frame"
        if offline:  # what is kept keeps the quality that the link had
            self._reconfiguration.hold(now_ns)
        if offline or not linked:  # nothing is carried anywhere
            return
        if self._reconfiguration.follow(now_ns) or back:
            self._keyframes.renew(now_ns)

    def admits(self, now_ns: int) -> bool:
        """Whether a frame may be coded now; what is held back would only wait and grow old."""
        if self.pacer is None:
            return True
        assert self._sender is not None, "attached before the first frame"
        return self.pacer.admits_base(now_ns) and self._sender.base_wait_ns(now_ns) <= _MOST_WAIT_NS

    def text(self) -> str:
        """What is kept, for the status line; empty where nothing is."""
        return "" if self.backlog is None else self.backlog.text()

    def finish(self, *, stop: threading.Event, note: Callable[[str], None]) -> None:
        """After the last frame of a recorded source: send what was kept."""
        if self.backlog is not None:
            self.backlog.finish(before_frame=self._after_last, stop=stop, note=note)

    def _after_last(self, now_ns: int) -> None:
        assert self._stills is not None, "attached before the first frame"
        self._stills.store_lost(now_ns)
        self.before_frame(now_ns)
        self.admits(now_ns)  # which gives up what is lost: nothing else would, without frames

    def hear(self, feedback: Feedback, *, now_ns: int) -> None:
        """A ground reports on this session (any thread)."""
        self._keyframes.note_losses(feedback.receiver_id, feedback.lost + feedback.corrupt)
        if self.pacer is not None:
            self.pacer.hear(feedback, now_ns=now_ns)
        self._acknowledge(feedback, now_ns)
        if self.backlog is not None:
            self.backlog.on_feedback(feedback, now_ns=now_ns)

    def _acknowledge(self, feedback: Feedback, now_ns: int) -> None:
        # Numbers that were never sent mean nothing, and who names them does not become the primary receiver.
        sender = self._sender
        if sender is None or feedback.base_sequence > sender.base_sequence:
            return
        if feedback.still_sequence > sender.still_sequence:
            return
        if self._primary.take(feedback.receiver_id, feedback.sequence, now_ns=now_ns) is None:
            return
        progress = self.in_flight.on_report(feedback.base_sequence)
        progress |= self.outbox.on_report(
            feedback.still_sequence,
            feedback.missing_stills,
            now_ns=now_ns,
            round_trip_ns=0 if self.pacer is None else self.pacer.round_trip_ns,
        )
        if progress:
            self._primary.note_progress(now_ns)


def wait_for_ground(
    linked: Callable[[], bool], config: EdgeConfig, *, stop: threading.Event, note: Callable[[str], None]
) -> None:
    """Until somebody listens, or for ``--wait``: a recorded source can wait for its audience."""
    if linked():
        return
    deadline_s = time.monotonic() + config.wait
    note(f"{config.edge_id}: waiting up to {config.wait:g} s for a ground (--wait)")
    while not linked() and not stop.is_set():
        if time.monotonic() >= deadline_s:
            note(f"{config.edge_id}: no ground yet; playing on, one may join at any time")
            return
        stop.wait(0.02)
