"""From tracks to stills: suppression, gate, method, sharing, queue, budget, still stage, in that order.

Pure but for the pixels it codes: no threads, no clock, no network. The fate of every wish is counted; a candidate
that rides along in the still of a neighbour shares that one's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

from hvt_common.values import Still, View
from hvt_edge.backlog.entry import FIRST_STORED
from hvt_edge.perception.analyzer import AnalyzedFrame
from hvt_edge.perception.candidates import Candidate, TrackMemory
from hvt_edge.stills.gate import Gate
from hvt_edge.stills.maker import NoStill, Room, StillMaker
from hvt_edge.stills.measured import without_frame
from hvt_edge.stills.merging import expected_bytes, group
from hvt_edge.stills.outbox import PendingStill, QueueSettings, StillQueue
from hvt_edge.stills.policy.base import STILL_OVERHEAD_BYTES, Method, Request, Step
from hvt_edge.stills.policy.cost import CostModel
from hvt_edge.stills.resend import ResendRing, ResendSettings
from hvt_edge.stills.suppression import Suppression

__all__ = ["Asked", "Chooser", "ChooserSettings"]

_FULL_SHARE = 0.9
"""With so much of the most a still can ever be given, it is no use to wait for more."""
_PATIENCE_SHARE = 0.75
"""After this share of the longest wait, the most useful wish is coded to whatever room there is: one that never
gets the room it is expected to need must not hold up all others for ever."""
_AGAIN = "again"
"""Why a still is sent that was sent before, and the parameter that names the one before."""


@dataclass(frozen=True, slots=True)
class ChooserSettings:
    """``most_bytes`` is the largest admission the budget can ever give, payload."""

    fps: float
    most_bytes: int
    queue: QueueSettings = field(default_factory=QueueSettings)
    gate: Gate = field(default_factory=Gate)
    resend: ResendSettings = field(default_factory=ResendSettings)
    share: bool = False
    """Neighbours share one still where that is cheaper."""
    overhead_bytes: float = STILL_OVERHEAD_BYTES
    """What a still takes on the line beside its payload."""
    from_source: bool = False
    """Whether candidates were found on the source, and may be unknown to the ground."""


class Asked(Protocol):
    """Stills that somebody asked for (`hvt_edge.stills.on_demand`)."""

    @property
    def waiting(self) -> int:
        """How many wait for room."""
        ...

    def see(self, seen: AnalyzedFrame) -> None:
        """Take in a frame."""
        ...

    def stills(self, *, now_ns: int, room: Room, next_sequence: Callable[[], int]) -> Iterator[Still]:
        """Yield those that may go now."""
        ...

    def close(self) -> None:
        """No more will be sent."""
        ...


class Chooser:
    """Decides at each step who is wanted, and hands out stills as the budget has room for them.

    ``on_outcome(fate, reason)`` is called with ``sent``, ``deferred`` or ``dropped`` for every candidate that a step
    did not simply pass over; ``observe(candidates, step)`` with all tracks of each step, those that rest included.
    ``asked`` are the stills that grounds ask for: they go before all others. ``overdue(now_ns)`` returns stills that
    were sent and seem to be lost, each with its utility, most useful first.

    One that is overdue is yielded again, as it was, before wishes that are less useful, and only where there is room
    for it: it holds up nobody, because what it shows grows old.
    """

    def __init__(
        self,
        method: Method,
        *,
        suppression: Suppression,
        maker: StillMaker,
        memory: TrackMemory,
        view: View,
        class_names: tuple[str, ...],
        settings: ChooserSettings,
        on_outcome: Callable[[str, str], None],
        observe: Callable[[Sequence[Candidate], Step], None] = lambda _candidates, _step: None,
        asked: Asked | None = None,
        overdue: Callable[[int], Sequence[tuple[Still, float]]] = lambda _now_ns: (),
    ) -> None:
        self._method = method
        self._asked = asked
        self._overdue = overdue
        self.utility = 0.0
        """Of the still that was yielded last, as the method scored it; infinite where a ground asked for it."""
        self._suppression = suppression
        self._maker = maker
        self._memory = memory
        self._view = view
        self._class_names = class_names
        self._settings = settings
        self._on_outcome = on_outcome
        self._observe = observe
        self._most_bytes = settings.most_bytes
        self._costs: dict[str, CostModel] = {}
        self._queue = StillQueue(settings.queue)
        self._sent = ResendRing(settings.resend)
        self._put_off = False
        self._held_up: dict[int, int] = {}
        """Track id → since when it has been the most useful and without room (ns)."""
        self._sequences = {False: 0, True: FIRST_STORED}
        """Of the next still: for the link, and to be kept."""
        self._keeps = False

    @property
    def waiting(self) -> int:
        """How many stills wait for room."""
        return len(self._queue)

    @property
    def live_waits(self) -> bool:
        """Whether any still waits for room, one that was asked for included."""
        return bool(self._queue) or (self._asked is not None and self._asked.waiting > 0)

    def consider(self, seen: AnalyzedFrame, *, now_ns: int, room_bytes: int) -> None:
        """Take in one frame's tracks; at a decision step let the method say which it wants.

        Where stills build on the base, a step that falls on a frame without one is put off to the next that has one.
        """
        if self._asked is not None:
            self._asked.see(seen)
        if self._method.video_only:
            return
        due = seen.detected or self._put_off
        able = seen.base_bgr is not None or not self._maker.codec.needs_base
        self._put_off = due and not able
        if not (due and able):
            self._memory.observe(seen.tracks, now_ns=now_ns)
            return
        step = Step(
            frame_index=seen.frame.index,
            now_ns=now_ns,
            fps=self._settings.fps,
            base_size=self._view.base_size,
            cost=self._cost_of(self._maker.codec.name).estimate(),
            room_bytes=room_bytes,
            still_overhead_bytes=self._settings.overhead_bytes,
            from_source=self._settings.from_source,
        )
        candidates = self._candidates(seen, now_ns=now_ns)
        self._observe(candidates, step)
        for request in self._requests(self._wanted(candidates, now_ns=now_ns), step):
            self._wish(request, seen, now_ns=now_ns)

    def stills(self, *, now_ns: int, room: Room, keeps: bool = False) -> Iterator[Still]:
        """Yield stills that fit ``room`` of each; the caller sends each before it asks for the next.

        ``keeps``: they are kept for later. Then none builds on the base, which may come later still, or never.
        """
        self._keeps = keeps
        self._wish_again(now_ns)
        for _, reason in self._queue.expire(now_ns):
            self._on_outcome("dropped", reason)
        yield from self._asked_for(now_ns=now_ns, room=room)
        if self._asked is not None and self._asked.waiting:
            return  # it waits for its room; none of the others takes that away
        while (waiting := self._queue.best()) is not None:
            yield from self._lost(over=waiting.request.score, now_ns=now_ns, room=room)
            if keeps:
                recoded = waiting.cut.recoded(self._maker.without_base, reason=waiting.cut.header.reason)
                waiting = replace(waiting, cut=recoded)
            if not self._may_go(waiting, room(self._header(waiting)), now_ns=now_ns):
                break  # the most useful waits for its room; a lesser one does not slip in before it
            still = self._make(waiting, room, now_ns=now_ns)
            if still is not None:
                self.utility = waiting.request.score
                yield still
        else:
            yield from self._lost(over=-math.inf, now_ns=now_ns, room=room)
        self._forget()

    def without_base(self, still: Still, *, now_ns: int) -> Still:
        """A still that was sent lately, as it is without the base; itself where it is so, or its crop is gone."""
        if still.codec == self._maker.without_base.name:
            return still
        self._wish_again(now_ns)
        self._sent.ask(still.sequence)
        for _, waiting in self._sent.take(now_ns):
            cut = replace(waiting.cut, header=replace(waiting.cut.header, reason=still.reason))
            made = self._maker.code(cut, sequence=still.sequence, room=lambda _: self._most_bytes)
            if not isinstance(made, NoStill):
                return made
        return still

    def record_feedback(
        self, track_id: int, *, class_name: str, confidence: float, entropy_nats: float
    ) -> None:
        """The ground's classifier has spoken on a still of this track."""
        self._memory.record_feedback(
            track_id, class_name=class_name, confidence=confidence, entropy_nats=entropy_nats
        )

    def set_method(self, method: Method) -> None:
        """From the next decision step on; what waits already stays."""
        self._method = method

    def set_most_bytes(self, most_bytes: int) -> None:
        """The largest admission that the budget can give from now on, payload."""
        self._most_bytes = most_bytes

    def ask_again(self, sequence: int) -> None:
        """A ground does not have the base frame of this still; it goes out once more when there is room."""
        self._sent.ask(sequence)

    def close(self) -> None:
        """What still waits will not be sent any more."""
        for _ in self._queue.clear():
            self._on_outcome("dropped", "ended")
        if self._asked is not None:
            self._asked.close()

    # Wishes

    def _candidates(self, seen: AnalyzedFrame, *, now_ns: int) -> list[Candidate]:
        """All tracks of this step."""
        return self._memory.candidates(
            seen.tracks,
            view=self._view,
            class_names=self._class_names,
            now_ns=now_ns,
            source_bgr=seen.frame.source_bgr,
            base_bgr=seen.base_bgr,
        )

    def _wanted(self, candidates: Sequence[Candidate], *, now_ns: int) -> list[Candidate]:
        """Those that may be asked for."""
        kept, held = self._suppression.apply(candidates, now_ns=now_ns)
        for _, reason in held:
            self._on_outcome("deferred", reason)
        # The gate comes last because it looks at pixels, and before the method, so that the queue's places go to
        # those that gain from a still.
        return [one for one in kept if not self._gated(one, now_ns=now_ns)]

    def _gated(self, candidate: Candidate, *, now_ns: int) -> bool:
        gate = self._settings.gate
        if not gate.on or candidate.loss is None or not gate.good_enough(candidate.loss()):
            return False
        self._refuse(candidate, "base_good", now_ns=now_ns)
        return True

    def _requests(self, candidates: list[Candidate], step: Step) -> list[Request]:
        requests = self._method.requests(candidates, step)
        if not self._settings.share:
            return requests
        joined = group(
            requests,
            cost=step.cost,
            overhead_bytes=step.still_overhead_bytes,
            padding=self._maker.padding,
            source_size=self._view.source_size,
        )
        return [request for request, _ in joined]

    def _wish(self, request: Request, seen: AnalyzedFrame, *, now_ns: int) -> None:
        if not self._queue.admits(request, now_ns=now_ns):
            self._on_outcome("dropped", "queue_full")
            return
        cut = self._maker.cut(seen.frame, request, view=self._view, base_bgr=seen.base_bgr)
        if isinstance(cut, NoStill):
            for one in (request.candidate, *request.also):
                self._memory.record_refused(one.track_id, now_ns=now_ns)
            self._on_outcome("dropped", cut.reason)
            return
        self._offer(PendingStill(without_frame(request), cut, now_ns))

    def _wish_again(self, now_ns: int) -> None:
        """Let those that the ground asked for once more wait for room, unless something newer of the track does."""
        for sequence, waiting in self._sent.take(now_ns):
            if waiting.track_id not in self._queue and self._queue.admits(waiting.request, now_ns=now_ns):
                header = waiting.cut.header
                cut = replace(
                    waiting.cut, header=replace(header, parameters={**header.parameters, _AGAIN: sequence})
                )
                self._offer(replace(waiting, cut=cut, since_ns=now_ns))

    def _offer(self, waiting: PendingStill) -> None:
        for _left, reason in self._queue.offer(waiting):
            self._on_outcome("deferred" if reason == "replaced" else "dropped", reason)

    # Stills

    def _asked_for(self, *, now_ns: int, room: Room) -> Iterator[Still]:
        if self._asked is None:
            return
        for still in self._asked.stills(now_ns=now_ns, room=room, next_sequence=lambda: self._sequence):
            self._made(still)
            self.utility = math.inf
            yield still

    def _lost(self, *, over: float, now_ns: int, room: Room) -> Iterator[Still]:
        """Those to be sent again that are more useful than ``over``, and fit."""
        for still, utility in self._overdue(now_ns):
            if utility <= over:
                return
            # Something newer of its track says more.
            if still.track_id not in self._queue and len(still.data) <= room(still):
                self._on_outcome("sent", _AGAIN)
                self.utility = utility
                yield still

    @property
    def _sequence(self) -> int:
        return self._sequences[self._keeps]

    def _made(self, still: Still) -> None:
        """It goes out, or into the store."""
        self._sequences[self._keeps] += 1
        self._on_outcome(*(("deferred", "stored") if self._keeps else ("sent", still.reason)))

    def _header(self, waiting: PendingStill) -> Still:
        return replace(waiting.cut.header, sequence=self._sequence)

    def _may_go(self, waiting: PendingStill, limit_bytes: int, *, now_ns: int) -> bool:
        """Whether there is as much room as it will need, or it has waited for that long enough."""
        expected = expected_bytes(
            waiting.request,
            cost=self._cost_of(waiting.cut.header.codec).estimate(),
            padding=self._maker.padding,
            source_size=self._view.source_size,
        )
        if limit_bytes >= min(expected, self._most_bytes * _FULL_SHARE):
            return True
        # By track, not by wish: methods wish again at each step, and every new wish takes the place of the last.
        since_ns = self._held_up.setdefault(waiting.track_id, now_ns)
        return now_ns - since_ns >= _PATIENCE_SHARE * self._settings.queue.max_age_ns

    def _make(self, waiting: PendingStill, room: Room, *, now_ns: int) -> Still | None:
        self._queue.remove(waiting)
        self._held_up.pop(waiting.track_id, None)
        made = self._maker.code(waiting.cut, sequence=self._sequence, room=room)
        if isinstance(made, NoStill):
            self._refuse(waiting.request.candidate, made.reason, now_ns=now_ns)
            return None
        self._made(made)
        self._record(waiting, made, now_ns=now_ns)
        return made

    def _record(self, waiting: PendingStill, still: Still, *, now_ns: int) -> None:
        height, width = waiting.cut.crop_bgr.shape[:2]
        self._cost_of(still.codec).observe(area_px=width * height, size_bytes=len(still.data))
        if waiting.again:
            return  # its tracks have rested since it was sent first
        for one in (waiting.request.candidate, *waiting.request.also):
            self._memory.record_sent(
                one.track_id,
                frame_index=still.frame_index,
                now_ns=now_ns,
                area_px=one.area_px,
                sharpness=one.sharpness() if one.sharpness else None,
                at_border=one.touches_border,
            )
        if still.codec != self._maker.without_base.name:  # it builds on the base, and a ground may lack that
            cut = waiting.cut.recoded(self._maker.without_base, reason=_AGAIN)
            self._sent.backlog(still.sequence, replace(waiting, cut=cut, again=True), now_ns=now_ns)

    def _refuse(self, candidate: Candidate, reason: str, *, now_ns: int) -> None:
        self._memory.record_refused(candidate.track_id, now_ns=now_ns)
        self._on_outcome("dropped", reason)

    def _cost_of(self, codec: str) -> CostModel:
        """Learnt for each codec apart: a residual takes a fraction of what an intra still takes."""
        return self._costs.setdefault(codec, CostModel.of_codec(codec))

    def _forget(self) -> None:
        """Keep nothing of wishes that wait no more."""
        tracks = {waiting.track_id for waiting in self._queue}
        self._held_up = {
            track_id: since_ns for track_id, since_ns in self._held_up.items() if track_id in tracks
        }
