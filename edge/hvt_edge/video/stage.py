"""One frame of the base stream: gather the inputs of the decision, decide, encode, store or send."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, replace
from enum import Enum
from typing import Protocol

import cv2
import numpy as np

from hvt_common.errors import FlightError, foreign
from hvt_common.protocol.edge_words import FrameGroup
from hvt_common.runtime.failures import Failures, Turns
from hvt_common.units import SECOND_NS, bitrate_text
from hvt_common.values import AccessUnit, Frame, Tracks
from hvt_edge.backlog.stage import BacklogStage, State
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.operating import Keyframes
from hvt_edge.video.encoder import Encoder
from hvt_edge.video.rate_model import FrameSkip
from hvt_edge.video.x265 import TrackRegions


class Action(Enum):
    """The action for a source frame."""

    SKIP = "not coded: frame decimation leaves it out"
    HOLD = "due, and not coded: there is no room for it"
    CODE = "coded"


@dataclass(frozen=True, slots=True)
class FrameInputs:
    """All inputs of the decision."""

    due: bool
    """Frame decimation takes this source frame."""
    keyframe_due: bool
    """The plan's keyframe is due, and it fits the budget's window or has waited long enough."""
    admitted: bool
    """Pacer and budget have room for a frame now, and no keyframe that a ground waits for needs it."""
    yielded: bool = False
    """Its bytes go to a still that a ground requested."""
    link: State = State.LIVE
    """Always LIVE where there is no store."""
    segment_due: bool = False
    """The store needs a keyframe to begin its next segment."""
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
    """With this frame the link gets the stream again."""
    held_by: FrameGroup = "budget"
    """For HOLD: the part that has no room."""

    @property
    def codes(self) -> bool:
        return self.action is Action.CODE

    @property
    def reconfigures(self) -> bool:
        """Whether rates may change with it: at a keyframe for the link. The store continues at the former rate."""
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

    OFFLINE, a coded frame also goes to the link as a probe, if one is due and admitted. LIVE, a frame that is no
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


_PART, _SIZE_PART = "encoder", "video"
_MOST_FAILURES, _FAILURES_NS = 3, 10 * SECOND_NS
_CODING_MEMORY = 4
"""Number of frames over which the coding time is averaged."""
_COARSER = (2, 4, 8)
"""Factors by which a picture is coarsened if its unit is too large. x265 cannot code more coarsely than at quantiser
51, but its input can have less detail."""


class LocalCopy(Protocol):
    """``--record-base``: keeps every access unit at the edge."""

    def write(self, unit: AccessUnit) -> None:
        """Hand over an access unit; returns at once."""
        ...


@dataclass(eq=False)
class BaseStage:
    """Runs in the frame loop: `decide` for each source frame; `encode` and `send` for each that is coded.

    ``first_keyframe_bytes`` is the guess until a keyframe has been coded. ``reconfigure(decimation, now_ns)`` runs
    before each keyframe for the link and returns a newly opened encoder, or None where nothing has changed: x265
    takes neither another frame rate nor another bit rate once it is open. ``keyframe_bytes(last_bytes)`` estimates
    that keyframe's line bytes, ``admits(now_ns, line_bytes, coding_ns)`` tells whether pacer and budget have
    room for them once it is coded, ``holder(now_ns)`` which of the two has none. ``open_again()`` returns another
    encoder for one that has failed; without it, as in lockstep, the failure is raised.
    """

    encoder: Encoder
    _: KW_ONLY
    encoder_name: str = "x265"
    keyframes: Keyframes
    transmitter: Transmitter
    failures: Failures
    local_copy: LocalCopy | None = None
    first_keyframe_bytes: int = 0
    regions: TrackRegions | None = None
    frame_skip: FrameSkip | None = None
    reconfigure: Callable[[int, int], Encoder | None] | None = None
    keyframe_bytes: Callable[[int], int] = lambda last_bytes: last_bytes
    admits: Callable[[int, int, int], bool] = lambda _now_ns, _line_bytes, _coding_ns: True
    holder: Callable[[int], FrameGroup] = lambda _now_ns: "budget"
    backlog: BacklogStage | None = None
    open_again: Callable[[], Encoder] | None = None

    def __post_init__(self) -> None:
        self._keyframe_bytes = self.first_keyframe_bytes
        self._frame_skip = self.frame_skip or FrameSkip()
        self._failed_ns: deque[int] = deque(maxlen=_MOST_FAILURES)
        self._coding_began_ns = self._coding_ns = 0
        """When the newest frame came to the encoder, and the recent mean of the coding time."""
        self._turns = Turns(_PART, self.failures)
        self._begins_anew = False
        """The encoder was opened again, or a frame that others build on was left out: the next is a keyframe."""

    def decide(self, frame: Frame, *, now_ns: int) -> FrameDecision:
        """Decide on this source frame; once for each, in order."""
        keyframe_bytes = self.keyframe_bytes(self._keyframe_bytes)
        awaited, budget = self.keyframes.awaited, self.transmitter.budget
        fits = budget.keyframe_fits(keyframe_bytes, now_ns=now_ns, awaited=awaited)
        if not self.keyframes.requested:  # a scheduled keyframe: a requested still goes before it
            fits = fits and not budget.yielding(now_ns)
        backlog, frame_bytes = self.backlog, round(budget.base_step_bytes)
        link = State.LIVE if backlog is None else backlog.state
        keyframe_due = self.keyframes.now(now_ns, fits=fits) or self._begins_anew
        # A frame that fits no window needs another rate.
        if link is State.LIVE and self.reconfigure is not None:
            keyframe_due = keyframe_due or not budget.holds(frame_bytes)
        line_bytes = keyframe_bytes if keyframe_due else frame_bytes
        yields_to_keyframe = awaited and link is State.LIVE and not keyframe_due
        due = self._frame_skip.codes(frame.index)
        admitted = not yields_to_keyframe and self.admits(now_ns, line_bytes, self._coding_ns)
        coded = due and admitted and not keyframe_due and link is State.LIVE
        if backlog is not None and backlog.awaits_keyframe and not admitted:
            keyframe_due = False  # it waits for room
        segment_due = backlog is not None and backlog.segment_due(now_ns)
        probe_due = backlog is not None and backlog.probe_due(now_ns, keyframe=keyframe_due or segment_due)
        decision = decide(
            FrameInputs(
                due=due,
                keyframe_due=keyframe_due,
                admitted=admitted,
                yielded=coded and budget.leaves_out(now_ns),
                link=link,
                segment_due=segment_due,
                probe_due=probe_due,
            )
        )
        if decision.action is Action.HOLD and not admitted:
            return replace(decision, held_by=self.holder(now_ns))
        return decision

    def encode(
        self, frame: Frame, decision: FrameDecision, *, now_ns: int, tracks: Tracks | None = None
    ) -> AccessUnit | None:
        """Encode the frame as decided (None where it is not coded); ``tracks`` are the newest known.

        A frame on which the encoder fails is left out. Raises `FlightError` if it fails repeatedly. A frame for which
        no window of the budget has room is coded again, as a keyframe of less and less detail.
        """
        if not decision.codes:
            return None
        self._coding_began_ns = now_ns
        try:
            if decision.reconfigures:
                self._at_keyframe(frame.index, now_ns=now_ns)
            regions = [] if self.regions is None else self.regions.regions(tracks)
            with self._turns:
                unit = self.encoder.encode(frame, keyframe=decision.keyframe, regions=regions)
                if decision.to_link:
                    unit = self._within_a_window(unit, frame, now_ns=now_ns, may_open=not decision.to_store)
        except foreign() as error:
            if self.open_again is None:
                raise
            self._recover(error, now_ns=now_ns)
            return None
        assert unit.keyframe or not decision.keyframe, "others than x265 are checked (CheckedEncoder)"
        if self._begins_anew:
            self.failures.works(_PART)
        self._begins_anew = False
        self._frame_skip.coded(frame.index, keyframe=unit.keyframe, mean_qp=self.encoder.mean_qp)
        if decision.meets_plan or (unit.keyframe and not decision.to_store):
            self.keyframes.done(now_ns)
        if decision.resumes and self.backlog is not None:
            self.backlog.resume()
        self._copy(unit)
        return unit

    @property
    def budget_waited_ns(self) -> int:
        """The total time for which frames have waited for the budget's window."""
        return self.transmitter.base_waited_ns

    def send(self, unit: AccessUnit, decision: FrameDecision, *, now_ns: int) -> bool:
        """Store the unit, or send it, or both; blocks while the link is full: frames are dropped before encoding.

        False where the store did not take it, or the link has no room for it.
        """
        taken_ns = now_ns - self._coding_began_ns
        self._coding_ns += (taken_ns - self._coding_ns) // (_CODING_MEMORY if self._coding_ns else 1)
        if self.backlog is not None and decision.to_store:
            taken = self.backlog.base(unit, now_ns=now_ns, sent=decision.to_link)
            if decision.to_link:  # a probe; earlier frames that it builds on were not sent
                announced = self.keyframes.made_here
                self.transmitter.base(unit, now_ns=now_ns, after_hole=not unit.keyframe, announced=announced)
            elif self.backlog.offline:
                self.transmitter.store_base(unit, now_ns=now_ns)
            # On the way back no stored frame is on the line: the budget needs room for the keyframe that resumes.
            return taken or decision.to_link
        line_bytes = self.transmitter.base(unit, now_ns=now_ns, announced=self.keyframes.made_here)
        if not line_bytes:
            self._leave_out(unit)
            return False
        self._note_sent(unit, line_bytes, now_ns=now_ns)
        return True

    def wants_keyframe(self, index: int) -> bool:
        """Whether more frames are worth a keyframe of their own after this one; about once a second."""
        return self._frame_skip.wants_keyframe(index)

    def _within_a_window(self, unit: AccessUnit, frame: Frame, *, now_ns: int, may_open: bool) -> AccessUnit:
        # The unit, or a keyframe of the same picture for which a window has room: first at the present rate, since at
        # the former one x265 fills its VBV with any picture, and then with less and less detail.
        if may_open and not unit.keyframe and not self.transmitter.holds(unit):
            self._at_keyframe(frame.index, now_ns=now_ns)
            unit = self.encoder.encode(frame, keyframe=True, regions=[])
        for factor in _COARSER:
            if self.transmitter.holds(unit):
                break
            height, width = frame.base_bgr.shape[:2]
            small = (max(1, width // factor), max(1, height // factor))
            coarse = cv2.resize(frame.base_bgr, small, interpolation=cv2.INTER_AREA)
            coarse = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
            coded = replace(frame, base_bgr=coarse.astype(np.uint8, copy=False))
            unit = self.encoder.encode(coded, keyframe=True, regions=[])
        return unit

    def _copy(self, unit: AccessUnit) -> None:
        if self.local_copy is not None:
            self.local_copy.write(unit)

    def _note_sent(self, unit: AccessUnit, line_bytes: int, *, now_ns: int) -> None:
        del now_ns
        self.failures.works(_SIZE_PART)
        if unit.keyframe:
            self._keyframe_bytes = line_bytes
            self.keyframes.note_cost(8 * SECOND_NS * line_bytes // self.transmitter.budget.total_bps)

    def _leave_out(self, unit: AccessUnit) -> None:
        # No window has room for it: later frames cannot be shown before another keyframe.
        self._begins_anew = True
        what = f"{'a keyframe' if unit.keyframe else 'a frame'} of {len(unit.data) / 1000:.1f} kB"
        total = bitrate_text(self.transmitter.budget.total_bps)
        self.failures.failed(
            _SIZE_PART,
            f"{what} is more than a window of {total} or one message holds, and is left out: raise --budget, or "
            "lower --size",
        )

    def _recover(self, error: BaseException, *, now_ns: int) -> None:
        assert self.open_again is not None, "checked"
        while True:
            self.failures.failed(_PART, f"{self.encoder_name} failed ({error})")
            self._failed_ns.append(now_ns)
            if len(self._failed_ns) == _MOST_FAILURES and now_ns - self._failed_ns[0] <= _FAILURES_NS:
                raise FlightError(
                    f"{self.encoder_name} failed {_MOST_FAILURES} times within {_FAILURES_NS // SECOND_NS} s "
                    f"({error}): there is no video without it, and another start may help"
                ) from error
            error.__traceback__ = None  # its frames hold the encoder, and with it its device
            try:
                self.encoder = self.open_again()
            except foreign() as again:  # another failure of the same kind
                error = again
                continue
            self._begins_anew = True
            return

    def _at_keyframe(self, index: int, *, now_ns: int) -> None:
        before = self._frame_skip.decimation
        decimation = self._frame_skip.at_keyframe(index)
        encoder = None if self.reconfigure is None else self.reconfigure(decimation, now_ns)
        assert encoder is not None or decimation == before, "another decimation needs another encoder"
        self.encoder = encoder or self.encoder
