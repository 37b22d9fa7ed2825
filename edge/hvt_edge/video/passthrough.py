"""The base stream where the camera has coded it itself: an encoder that cannot make keyframes.

A unit builds on the one before it. So if one is not sent, for want of room in the budget's window or on the link,
all units up to the camera's next keyframe are left out: no ground could show them. The camera is never commanded.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from hvt_common.protocol.edge_words import FrameGroup
from hvt_common.units import SECOND_NS
from hvt_common.values import AccessUnit, Frame, Tracks
from hvt_edge.backlog.stage import State
from hvt_edge.video.encoders.passthrough import CameraRates, LeastLink, unit_of
from hvt_edge.video.stage import Action, BaseStage, FrameDecision, FrameInputs, decide

_PART = "passthrough"
_PATIENCE_NS = SECOND_NS // 2
"""Longest wait of a unit for room: a large keyframe leaves none for a moment, and a waiting unit is not lost."""
_POLL_NS = SECOND_NS // 100


@dataclass(eq=False)
class PassthroughStage(BaseStage):
    """A `BaseStage` whose frames are due, and are keyframes, as the camera's units are.

    ``pause(ns)`` sleeps and returns the time; None in lockstep, where nothing is waited for. ``rates`` note each
    unit, and change before a keyframe's room on the link is checked, so that another budget takes effect there: a
    budget lowered too far could otherwise never be raised again. ``least_link`` holds a keyframe that follows a
    break. ``local_copy`` has all units of the camera, sent or not.
    """

    rates: CameraRates | None = None
    least_link: LeastLink | None = None
    pause: Callable[[int], int] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._sent_index = self._stored_index = self._copied_index = -2
        """Indices of the frames sent last, stored last, copied last."""
        self._paused_ns = 0
        self._held_by: FrameGroup = "unreadable"
        """Why the chain of units is broken: until the next keyframe is sent, no unit can be shown."""
        self.left_out = 0
        """Units that were neither sent nor stored."""

    def decide(self, frame: Frame, *, now_ns: int) -> FrameDecision:
        """Decide on this frame's unit; once for each, in order. Waits for a moment where there is no room now."""
        unit, backlog = unit_of(frame), self.backlog
        keyframe = unit.keyframe
        link = State.LIVE if backlog is None else backlog.state
        if self.rates is not None:
            self.rates.observe(unit)
            if keyframe and link is not State.OFFLINE:
                self.rates.at_keyframe(now_ns)
        after_sent = self._sent_index == frame.index - 1
        after_stored = backlog is not None and backlog.segment_open and self._stored_index == frame.index - 1
        wanted = keyframe or (after_sent if link is State.LIVE else link is State.OFFLINE)
        if link is not State.LIVE:
            self._held_by = "link"
        decision = decide(
            FrameInputs(
                due=keyframe or (after_sent if link is State.LIVE else after_stored),
                keyframe_due=keyframe,
                admitted=wanted and self._admitted(unit, now_ns, live=link is State.LIVE),
                link=link,
                segment_due=keyframe,
                probe_due=backlog is not None and backlog.probe_due(now_ns),
            )
        )
        if not decision.codes:
            self.left_out += 1
            return FrameDecision(Action.HOLD, held_by=self._held_by)
        if keyframe:
            self.failures.works(_PART)
        return replace(decision, meets_plan=keyframe)  # the camera's next keyframe will do

    def encode(
        self, frame: Frame, decision: FrameDecision, *, now_ns: int, tracks: Tracks | None = None
    ) -> AccessUnit | None:
        """The unit as decided; None where it is left out."""
        self._copy(unit_of(frame))
        unit = super().encode(frame, decision, now_ns=now_ns, tracks=tracks)
        if unit is None:
            return None
        if decision.to_store:
            self._stored_index = unit.frame_index
        else:
            self._sent_index = unit.frame_index
        self._held_by = "unreadable"  # a gap in the numbers: frames between were lost before they came here
        return unit

    @property
    def budget_waited_ns(self) -> int:
        """See `BaseStage`; includes the waits before a decision."""
        return self._paused_ns + super().budget_waited_ns

    def _note_sent(self, unit: AccessUnit, line_bytes: int, *, now_ns: int) -> None:
        super()._note_sent(unit, line_bytes, now_ns=now_ns)
        if self.least_link is not None:
            self.least_link.sent(line_bytes, now_ns=now_ns)

    def _leave_out(self, unit: AccessUnit) -> None:
        self._sent_index, self._held_by = -2, "budget"
        self._note_left_out(unit)

    def _admitted(self, unit: AccessUnit, now_ns: int, *, live: bool) -> bool:
        # Whether the unit may be sent now; where the link is ``live``, now or a moment later.
        until_ns = now_ns + (_PATIENCE_NS if live else 0)
        begins = live and self._sent_index != unit.frame_index - 1
        while True:
            wait_ns = self.transmitter.base_unit_wait_ns(unit, now_ns=now_ns)
            in_time = wait_ns is not None and now_ns + wait_ns <= until_ns
            free = not begins or self.least_link is None or self.least_link.is_free(now_ns)
            # The link is always queried: there lost messages are given up.
            admitted = self.admits(now_ns, round(self.transmitter.budget.base_step_bytes), 0)
            if admitted and in_time and free:
                return True
            if wait_ns is None or self.pause is None or now_ns + _POLL_NS > until_ns:
                if live:
                    self._held_by = self.holder(now_ns) if free else "link"
                    self._note_left_out(unit)
                return False
            before_ns = now_ns
            now_ns = self.pause(_POLL_NS)
            self._paused_ns += 0 if in_time and not wait_ns else now_ns - before_ns

    def _note_left_out(self, unit: AccessUnit) -> None:
        what = f"{'a keyframe' if unit.keyframe else 'a frame'} of {len(unit.data) / 1000:.1f} kB"
        full = "the link has no room" if self._held_by == "link" else "the budget's window has no room"
        self.failures.failed(_PART, f"{full} for {what}: nothing is sent up to the camera's next keyframe")

    def _copy(self, unit: AccessUnit) -> None:
        unbroken = unit.keyframe or self._copied_index == unit.frame_index - 1
        if unbroken and self._copied_index != unit.frame_index:
            super()._copy(unit)
            self._copied_index = unit.frame_index
