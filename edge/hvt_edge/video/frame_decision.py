"""Decides whether a source frame is coded, as a keyframe or not, and where it goes. One pure decision."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from hvt_common.protocol.frame_account import FrameGroup
from hvt_edge.backlog.stage import State


class Action(Enum):
    """The action for a source frame."""

    SKIP = "not coded: frame decimation leaves it out"
    HOLD = "due, and not coded: there is no room for it"
    CODE = "coded"


@dataclass(frozen=True, slots=True)
class FrameInputs:
    """All that the decision depends on."""

    due: bool
    """Frame decimation takes this source frame."""
    keyframe_due: bool
    """The plan wants its keyframe now: one is due, and it fits the budget's window or has waited long enough."""
    admitted: bool
    """Pacer and budget have room for a frame now."""
    yielded: bool = False
    """Its bytes go to a still that a ground requested."""
    link: State = State.LIVE
    """Always LIVE where there is no store."""
    segment_due: bool = False
    """The store needs a keyframe to begin its next segment with."""
    probe_due: bool = False
    """The link is silent and it is time to send a frame that may show whether it is back."""


@dataclass(frozen=True, slots=True)
class FrameDecision:
    """The decision for one source frame."""

    action: Action
    keyframe: bool = False
    to_link: bool = False
    to_store: bool = False
    meets_plan: bool = False
    """This keyframe is the one that the plan waits for."""
    resumes: bool = False
    """With it the link has the stream again."""
    held_by: FrameGroup = "budget"
    """For HOLD: the owner without room."""

    @property
    def codes(self) -> bool:
        """Whether the frame is encoded."""
        return self.action is Action.CODE

    @property
    def reconfigures(self) -> bool:
        """Whether rates may change with it: at a keyframe for the link. The store goes on at the rate there was."""
        return self.keyframe and not self.to_store


_SKIP, _HOLD = FrameDecision(Action.SKIP), FrameDecision(Action.HOLD)
_YIELD = FrameDecision(Action.HOLD, held_by="closer_look")


def decide(inputs: FrameInputs) -> FrameDecision:
    """Decide on one source frame.

    | link | keyframe due | frame due | admitted | segment due | decision |
    |---|---|---|---|---|---|
    | LIVE | no | no | | | skip |
    | LIVE | no | yes | no | | hold |
    | LIVE | no | yes | yes | | code, to the link |
    | LIVE | yes | | no | | hold |
    | LIVE | yes | | yes | | keyframe to the link; meets the plan |
    | OFFLINE | no | no | | no | skip |
    | OFFLINE | no | yes | | no | code, to the store |
    | OFFLINE | yes | | | | keyframe to the store; meets the plan |
    | OFFLINE | | | | yes | keyframe to the store; meets the plan |
    | RETURNING | yes | | yes | | keyframe to the link; meets the plan, resumes |
    | RETURNING | yes | | no | as without keyframe due: |
    | RETURNING | no | no | | no | skip |
    | RETURNING | no | yes | | no | code, to the store |
    | RETURNING | no | | | yes | keyframe to the store; the plan still waits for its own |

    OFFLINE, a coded frame also goes to the link as a probe, where one is due and admitted. LIVE, a frame that is no
    keyframe is held too where a requested still needs its bytes.
    """
    if inputs.link is State.LIVE:
        if not inputs.keyframe_due and not inputs.due:
            return _SKIP
        if not inputs.admitted or (inputs.yielded and not inputs.keyframe_due):
            return _YIELD if inputs.admitted else _HOLD
        keyframe = inputs.keyframe_due
        return FrameDecision(Action.CODE, keyframe, to_link=True, meets_plan=keyframe)
    if inputs.link is State.RETURNING and inputs.keyframe_due and inputs.admitted:
        return FrameDecision(Action.CODE, keyframe=True, to_link=True, meets_plan=True, resumes=True)
    offline = inputs.link is State.OFFLINE
    keyframe = inputs.segment_due or (offline and inputs.keyframe_due)
    if not keyframe and not inputs.due:
        return _SKIP
    probe = offline and inputs.probe_due and inputs.admitted
    return FrameDecision(Action.CODE, keyframe, to_link=probe, to_store=True, meets_plan=keyframe and offline)
