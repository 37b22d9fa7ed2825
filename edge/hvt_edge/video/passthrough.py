"""One frame of the base stream where the camera has coded it itself: send its unit, store it, or leave it out.

A unit builds on the one before it. So where one is not sent, for want of room in the budget's window or on the link,
all that follow are left out up to the camera's next keyframe: nobody could show them. Nothing is asked of the camera.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, replace

from hvt_common.protocol.edge_words import FrameGroup
from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS
from hvt_common.values import AccessUnit, Frame, Tracks
from hvt_edge.backlog.stage import BacklogStage, State
from hvt_edge.keyframes import Keyframes
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.video.encoders.passthrough import LeastLink, unit_of
from hvt_edge.video.stage import Action, BaseStage, FrameDecision, LocalCopy

_PART = "passthrough"
_PATIENCE_NS = SECOND_NS // 2
"""A unit waits so long for its room: a large keyframe leaves none for a moment, and a waiting unit is not lost."""
_POLL_NS = SECOND_NS // 100


@dataclass(frozen=True, slots=True)
class UnitInputs:
    """All that the decision depends on."""

    keyframe: bool
    after_sent: bool
    """The unit before it, on which it builds, was sent."""
    after_stored: bool
    """The same of the store."""
    admitted: bool
    """Pacer and budget have room for it."""
    link: State = State.LIVE
    """Always LIVE where there is no store."""
    probe_due: bool = False
    """The link is silent and it is time to send a frame that may show whether it is back."""


_HOLD = FrameDecision(Action.HOLD)


def decide_unit(inputs: UnitInputs) -> FrameDecision:
    """Decide on one unit.

    | link | keyframe | the one before was | admitted | decision |
    |---|---|---|---|---|
    | LIVE | yes | | yes | to the link |
    | LIVE | no | sent | yes | to the link |
    | LIVE | no | not sent | | left out |
    | LIVE | | | no | left out |
    | RETURNING | yes | | yes | to the link; resumes |
    | OFFLINE, RETURNING | yes | | else | to the store |
    | OFFLINE, RETURNING | no | stored | | to the store |
    | OFFLINE, RETURNING | no | not stored | | left out |

    OFFLINE, a unit that is stored also goes to the link as a probe, where one is due and admitted.
    """
    keyframe, admitted = inputs.keyframe, inputs.admitted
    if inputs.link is State.LIVE:
        whole = keyframe or inputs.after_sent
        return FrameDecision(Action.CODE, keyframe, to_link=True) if whole and admitted else _HOLD
    if inputs.link is State.RETURNING and keyframe and admitted:
        return FrameDecision(Action.CODE, keyframe, to_link=True, resumes=True)
    if not (keyframe or inputs.after_stored):
        return _HOLD
    probe = inputs.link is State.OFFLINE and inputs.probe_due and admitted
    return FrameDecision(Action.CODE, keyframe, to_link=probe, to_store=True)


@dataclass(eq=False)
class PassthroughStage:
    """Runs in the frame loop, in place of `BaseStage`: `decide` for each frame, `encode` and `send` what goes out.

    ``pause(ns)`` sleeps and returns the time; None in lockstep, where nothing is waited for. ``admits(now_ns)`` says
    whether there is room, ``holder(now_ns)`` whether the link or the budget has none. ``observe(unit)`` sees each
    unit. ``reconfigure(decimation, now_ns)`` runs before it is asked whether a keyframe may go to the link,
    so that another budget holds from there on: one that was lowered too far could never be raised again.
    ``least_link`` holds a keyframe that follows a break. ``local_copy`` has all that the camera gave, sent or not.
    """

    keyframes: Keyframes
    transmitter: Transmitter
    _: KW_ONLY
    failures: Failures
    local_copy: LocalCopy | None = None
    reconfigure: Callable[[int, int], object] = lambda _decimation, _now_ns: None
    observe: Callable[[AccessUnit], None] = lambda _unit: None
    least_link: LeastLink | None = None
    admits: Callable[[int], bool] = lambda _now_ns: True
    holder: Callable[[int], FrameGroup] = lambda _now_ns: "budget"
    pause: Callable[[int], int] | None = None
    backlog: BacklogStage | None = None

    def __post_init__(self) -> None:
        self._sent_index = self._stored_index = self._copied_index = -2
        """The frames sent last, stored last, copied last."""
        self._paused_ns = 0
        self._held_by: FrameGroup = "unreadable"
        """Why the chain of units is broken: up to the next keyframe that is sent, for that none can be shown."""
        self.left_out = 0
        """Units that were neither sent nor stored."""

    def wants_keyframe(self, index: int) -> bool:  # noqa: ARG002 - as of `BaseStage`
        """Never: the camera makes its own."""
        return False

    def decide(self, frame: Frame, *, now_ns: int) -> FrameDecision:
        """Decide on this frame's unit; once for each, in order. Waits for a moment where there is no room now."""
        unit, backlog = unit_of(frame), self.backlog
        link = State.LIVE if backlog is None else backlog.state
        whole_store = backlog is not None and backlog.segment_open
        after_sent = self._sent_index == frame.index - 1
        self.observe(unit)
        if unit.keyframe and link is not State.OFFLINE:
            self.reconfigure(1, now_ns)
        wanted = unit.keyframe or (after_sent if link is State.LIVE else link is State.OFFLINE)
        if link is not State.LIVE:
            self._held_by = "link"
        decision = decide_unit(
            UnitInputs(
                keyframe=unit.keyframe,
                after_sent=after_sent,
                after_stored=whole_store and self._stored_index == frame.index - 1,
                admitted=wanted and self._admitted(unit, now_ns, live=link is State.LIVE),
                link=link,
                probe_due=backlog is not None and backlog.probe_due(now_ns),
            )
        )
        self.left_out += not decision.codes
        if decision.codes and decision.keyframe:
            self.failures.works(_PART)
        return decision if decision.codes else replace(decision, held_by=self._held_by)

    def encode(
        self, frame: Frame, decision: FrameDecision, *, now_ns: int, tracks: Tracks | None = None
    ) -> AccessUnit | None:
        """The unit as decided; None where it is left out."""
        del tracks
        unit = unit_of(frame)
        self._copy(unit)
        if not decision.codes:
            return None
        if decision.to_store:
            self._stored_index = unit.frame_index
        else:
            self._sent_index = unit.frame_index
        self._held_by = "unreadable"  # what does not come next was lost before
        if unit.keyframe:
            self.keyframes.done(now_ns)
        if decision.resumes and self.backlog is not None:
            self.backlog.resume()
        return unit

    @property
    def budget_waited_ns(self) -> int:
        """See `BaseStage`."""
        return self._paused_ns + self.transmitter.base_waited_ns

    def send(self, unit: AccessUnit, decision: FrameDecision, *, now_ns: int) -> bool:
        """Store the unit, or send it, or both; as of `BaseStage`."""
        if self.backlog is None or not decision.to_store:
            line_bytes = self.transmitter.base(unit, now_ns=now_ns, announced=False)
            if self.least_link is not None:
                self.least_link.sent(line_bytes, now_ns=now_ns)
            return bool(line_bytes)
        taken = self.backlog.base(unit, now_ns=now_ns, sent=decision.to_link)
        if decision.to_link:
            self.transmitter.base(unit, now_ns=now_ns, after_hole=not unit.keyframe, announced=False)
        elif self.backlog.offline:
            self.transmitter.store_base(unit, now_ns=now_ns)
        return taken or decision.to_link

    def _admitted(self, unit: AccessUnit, now_ns: int, *, live: bool) -> bool:
        # Whether it may go now; where the link is ``live``, or a moment later.
        until_ns = now_ns + (_PATIENCE_NS if live else 0)
        begins = live and self._sent_index != unit.frame_index - 1
        while True:
            wait_ns = self.transmitter.base_unit_wait_ns(unit, now_ns=now_ns)
            in_time = wait_ns is not None and now_ns + wait_ns <= until_ns
            free = not begins or self.least_link is None or self.least_link.is_free(now_ns)
            # The link is always asked: what is lost is given up there.
            if self.admits(now_ns) and in_time and free:
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
        if self.local_copy is None:
            return
        if unit.keyframe or self._copied_index == unit.frame_index - 1:
            self.local_copy.write(unit)
            self._copied_index = unit.frame_index


VideoStage = BaseStage | PassthroughStage
"""The video stage of the frame loop: one that codes, or one that passes a camera's units through."""
