"""From tracks to stills: suppression, gate, method, merging, crop; then, as the budget allows, coding.

Pure but for the pixels it codes: no threads, no clock, no network. The outcome of every pending still is counted; a
candidate in the still of a neighbour shares that still's outcome.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, field

from hvt_edge.link.stills import Still
from hvt_edge.perception.analyzer import AnalyzedFrame
from hvt_edge.perception.candidates import BaseLoss, Candidate, TrackMemory
from hvt_edge.stills.maker import Allowance, NoStill
from hvt_edge.stills.on_demand import OnDemand, OnDemandStill
from hvt_edge.stills.outbox import OutboxStill
from hvt_edge.stills.policy.base import CostModel, Method, Request, Step, expected_bytes, group


@dataclass(frozen=True, slots=True)
class Suppression:
    """Holds back candidates before every method, so that methods differ only in their requests.

    Frozen, without state: all its inputs are in the candidates. The paper's plain variants run without it
    (``--cooldown 0``).
    """

    cooldown_s: float = 2.0
    """Rest of a track after a still; 0 is no rest."""
    min_gain: float = 1.2
    """After the rest, it must have grown or sharpened by this factor since the still; 1 demands nothing."""
    gain_s: float = 10.0
    """After this long without a still, it needs no gain any more."""
    avoid_border: bool = True
    """Wait for the whole object where it is only partly in the picture."""
    border_s: float = 1.0
    """The longest such wait for a track without a still so far."""
    retry_s: float = 1.0
    """Rest of a track that the still stage refused; on in the plain variants too, for it costs time only."""

    @classmethod
    def for_cooldown(cls, cooldown_s: float, *, min_gain: float = 1.2) -> Suppression:
        """``--cooldown``: 0 is off; else the wait for a gain (``--min-gain``) is five times as long."""
        if cooldown_s == 0:
            return cls(cooldown_s=0.0, min_gain=1.0, avoid_border=False)
        return cls(cooldown_s=cooldown_s, min_gain=min_gain, gain_s=5 * cooldown_s)

    def reason(self, candidate: Candidate, *, now_ns: int) -> str | None:
        """Why it is held back: ``refused cooldown border no_gain``; None where it is not."""
        if _since_s(candidate.last_refused_ns, now_ns) < self.retry_s:
            return "refused"
        rested_s = _since_s(candidate.last_sent_ns, now_ns)
        if rested_s < self.cooldown_s:
            return "cooldown"
        if self.avoid_border and candidate.touches_border and self._waits_at_border(candidate):
            return "border"
        # Last, because it may have to read pixels.
        if rested_s < self.gain_s and not self._gained(candidate):
            return "no_gain"
        return None

    def _waits_at_border(self, candidate: Candidate) -> bool:
        if candidate.sent_count and not candidate.last_sent_at_border:
            return True  # the ground has it whole; a part adds nothing
        # A leaving object will not get better. An entering one gets its time, and no more, so that an object that
        # only ever touches the border gets a still all the same.
        return not candidate.leaving and candidate.border_s < self.border_s

    def _gained(self, candidate: Candidate) -> bool:
        if self.min_gain <= 1 or candidate.last_sent_area_px is None:
            return True
        if candidate.area_px >= self.min_gain * candidate.last_sent_area_px:
            return True
        if candidate.last_sent_at_border and not candidate.touches_border:
            return True  # whole at last
        if candidate.sharpness is None or candidate.last_sent_sharpness is None:
            return False
        return candidate.sharpness() >= self.min_gain * candidate.last_sent_sharpness


@dataclass(frozen=True, slots=True)
class Gate:
    """Refuses a still where the base shows enough; refuses nothing at 0 dB. Frozen, without state.

    The edge decodes its own stream and measures the base's loss of each candidate (`BaseLoss`). Both conditions have
    to hold, because each has its blind spot: PSNR is high on a dark or smooth object however blurred its edges are,
    and lost detail is small on a coarse object that is plainly wrong in colour. docs/stills.md has the figures.
    """

    psnr_y_db: float = 0.0
    """Luma PSNR of the base crop from which on the base counts as good; 0: no gate."""
    most_detail_lost: float = 0.4
    """Most detail that the base may have lost, as a share of the crop's detail (`BaseLoss.detail_lost`)."""

    @property
    def on(self) -> bool:
        return self.psnr_y_db > 0

    def good_enough(self, loss: BaseLoss) -> bool:
        """Whether the base shows it so well that a still is not worth its bits."""
        return self.on and loss.psnr_y_db >= self.psnr_y_db and loss.detail_lost <= self.most_detail_lost


def _since_s(then_ns: int | None, now_ns: int) -> float:
    return float("inf") if then_ns is None else (now_ns - then_ns) / 1e9


Coded = Generator[OutboxStill, None, None]
"""Stills that are coded and may go. Closing the generator gives other threads their turn."""

_FULL_SHARE = 0.9
"""At this share of the most that a still can ever be given, it is no use to wait for more."""
_PATIENCE_SHARE = 0.75
"""After this share of the longest wait, the most useful still is coded to whatever the budget allows: a still that
never gets its expected bytes must not hold up all others for ever."""


@dataclass(eq=False)
class Chooser:
    """Decides at each step which candidates get a still, and codes pending stills as the budget allows.

    ``on_outcome(outcome, reason)`` is called with ``deferred`` or ``dropped`` for every candidate that a step did not
    simply pass over, and whose still does not go to the link; ``observe(candidates, step)`` with all tracks of each
    step, resting ones included. Requested stills go before all others: `requested` may run in a thread
    of its own, beside all else.

    A still that is overdue is sent again, unchanged, before less useful pending ones, and only if it is
    allowed: it holds up no other still, because its content grows old.
    """

    method: Method
    _: KW_ONLY
    suppression: Suppression
    memory: TrackMemory
    fps: float
    most_bytes: int
    """The largest allowance that the budget can give from now on, payload."""
    gate: Gate = field(default_factory=Gate)
    share: bool = False
    """Neighbours share one still where that is cheaper."""
    from_source: bool = False
    """Whether candidates were found on the source, and may be unknown to the ground."""
    on_outcome: Callable[[str, str], None]
    on_demand: OnDemand
    observe: Callable[[Sequence[Candidate], Step], None] | None = None

    def __post_init__(self) -> None:
        self.outbox, self.maker = self.on_demand.outbox, self.on_demand.maker
        self.view, self.class_names = self.on_demand.view, self.on_demand.class_names
        self._costs: dict[str, CostModel] = {}
        self._put_off = False
        self._held_up: dict[int, int] = {}
        """Track id → since when it has been the most useful and not allowed (ns)."""

    # Which candidates get a still

    def consider(
        self, analyzed: AnalyzedFrame, *, now_ns: int, allowance_bytes: int, paused: bool = False
    ) -> None:
        """Process one frame's tracks; at a decision step let the method request stills, unless it is ``paused``.

        Where stills build on the base, a step on a frame without one is put off to the next frame that has one.
        """
        if self.method.video_only:
            return
        due = analyzed.detected or self._put_off
        able = analyzed.base is not None or not self.maker.preferred.needs_base
        self._put_off = due and not able
        if paused or not (due and able):
            self.memory.observe(analyzed.tracks, now_ns=now_ns)
            return
        step = Step(
            frame_index=analyzed.frame.index,
            now_ns=now_ns,
            fps=self.fps,
            base_size=self.view.base_size,
            cost=self._cost_of(self.maker.preferred.name).estimate(),
            allowance_bytes=allowance_bytes,
            from_source=self.from_source,
        )
        candidates = self.memory.candidates(
            analyzed.tracks,
            view=self.view,
            class_names=self.class_names,
            now_ns=now_ns,
            source_bgr=analyzed.frame.source_bgr,
            base_bgr=analyzed.base_bgr,
        )
        if self.observe is not None:
            self.observe(candidates, step)
        for request in self._requests(self._unheld(candidates, now_ns=now_ns), step):
            self._crop(request, analyzed, now_ns=now_ns)

    def _unheld(self, candidates: Sequence[Candidate], *, now_ns: int) -> list[Candidate]:
        unheld = []
        for one in candidates:
            # The gate comes last because it reads pixels, and before the method, so that the places in the outbox go
            # to candidates that gain from a still.
            if (reason := self.suppression.reason(one, now_ns=now_ns)) is not None:
                self.on_outcome("deferred", reason)
            elif self.gate.on and one.loss is not None and self.gate.good_enough(one.loss()):
                self._refuse(one, "base_good", now_ns=now_ns)
            else:
                unheld.append(one)
        return unheld

    def _requests(self, candidates: list[Candidate], step: Step) -> list[Request]:
        requests = self.method.requests(candidates, step)
        if not self.share:
            return requests
        return group(
            requests,
            cost=step.cost,
            overhead_bytes=step.still_overhead_bytes,
            padding=self.maker.padding,
            source_size=self.view.source_size,
        )

    def _crop(self, request: Request, analyzed: AnalyzedFrame, *, now_ns: int) -> None:
        if not self.outbox.admits(request, now_ns=now_ns):
            self.on_outcome("dropped", "queue_full")
            return
        job = self.maker.crop(analyzed.frame, request, view=self.view, base=analyzed.base)
        if isinstance(job, NoStill):
            for one in (request.candidate, *request.also):
                self.memory.record_refused(one.track_id, now_ns=now_ns)
            self.on_outcome("dropped", job.reason)
            return
        # A pending still must not hold frames: measurements on them are made now.
        pending = OutboxStill(job, request.without_frame(), request.score, now_ns)
        self._count_left(self.outbox.offer(pending), now_ns=now_ns)

    # Which stills go now

    def expire_requested(self, now_ns: int) -> None:
        """Give up stills that grounds requested too long ago, whether or not any may go now."""
        self._count_left(self.outbox.expire_on_demand(now_ns), now_ns=now_ns)

    def requested(self, *, now_ns: int, store: bool = False) -> Coded:
        """Yield coded stills that grounds requested, as `stills` does for the method."""
        while isinstance(pending := self.outbox.on_demand, OnDemandStill):
            sequence = self.outbox.sequence(store=store)
            still = self.on_demand.code(pending, now_ns=now_ns, sequence=sequence, paced=not store)
            if still is not None:
                with self.outbox.turn:
                    self._coded(pending, still, now_ns=now_ns, store=store)
                    yield pending
            elif self.outbox.on_demand is pending:
                return  # it waits

    def stills(self, *, now_ns: int, allowance: Allowance, store: bool = False) -> Coded:
        """Yield coded stills of the method that fit ``allowance``; the caller sends each before it takes the next.

        ``store``: they go to the backlog, and then none builds on the base, which may come later still, or never.
        None is sent while a requested one waits for its allowance.
        """
        self._count_left(self.outbox.offer_undecodable(now_ns), now_ns=now_ns)
        self._count_left(self.outbox.expire(now_ns), now_ns=now_ns)
        while self.outbox.on_demand is None and (pending := self.outbox.best()) is not None:
            yield from self._overdue(over=pending.utility, now_ns=now_ns, allowance=allowance)
            job = pending.crop
            if store:
                job = job.without_base(self.maker.without_base)
            limit_bytes = allowance(job.with_header(sequence=self.outbox.sequence(store=store)))
            if not self._may_go(pending, job, limit_bytes, now_ns=now_ns):
                break  # the most useful waits for its allowance; a lesser one must not go before it
            made = self._code(pending, job, now_ns=now_ns, allowance=allowance, store=store)
            if made is not None and self.outbox.on_demand is None:  # else one was requested meanwhile
                with self.outbox.turn:
                    self._record_coded(pending, job, made, now_ns=now_ns, store=store)
                    yield pending
        else:
            yield from self._overdue(over=-math.inf, now_ns=now_ns, allowance=allowance)
        held = {pending.track_id for pending in self.outbox.pending}
        self._held_up = {track_id: ns for track_id, ns in self._held_up.items() if track_id in held}

    def _overdue(self, *, over: float, now_ns: int, allowance: Allowance) -> Iterator[OutboxStill]:
        # Stills to be sent again that are more useful than ``over``, and fit.
        for sent in self.outbox.overdue(now_ns):
            if sent.utility <= over or self.outbox.on_demand is not None:
                return
            # A newer still of its track says more.
            if sent.track_id not in self.outbox and len(sent.still.data) <= allowance(sent.still):
                self.outbox.sent_again(sent)
                yield sent

    def _may_go(self, pending: OutboxStill, job: Still, limit_bytes: int, *, now_ns: int) -> bool:
        # Whether its allowance holds its expected bytes, or it has waited for that long enough.
        assert pending.request is not None, "it is of the method"
        if limit_bytes < self.maker.least_bytes:
            return False
        expected = expected_bytes(
            pending.request,
            cost=self._cost_of(job.header.codec).estimate(),
            padding=self.maker.padding,
            source_size=self.view.source_size,
        )
        if limit_bytes >= min(expected, self.most_bytes * _FULL_SHARE):
            return True
        # By track: methods request again at each step, and every new still takes the place of the last.
        since_ns = self._held_up.setdefault(pending.track_id, now_ns)
        return now_ns - since_ns >= _PATIENCE_SHARE * self.outbox.settings.max_pending_ns

    def _code(
        self, pending: OutboxStill, job: Still, *, now_ns: int, allowance: Allowance, store: bool
    ) -> Still | None:
        assert pending.request is not None, "it is of the method"
        made = self.maker.code(job, sequence=self.outbox.sequence(store=store), allowance=allowance)
        if isinstance(made, NoStill):
            self._held_up.pop(pending.track_id, None)
            self.outbox.give_up(pending)
            self._refuse(pending.request.candidate, made.reason, now_ns=now_ns)
            return None
        return made

    def _record_coded(
        self, pending: OutboxStill, job: Still, made: Still, *, now_ns: int, store: bool
    ) -> None:
        assert pending.request is not None, "it is of the method"
        self._held_up.pop(pending.track_id, None)
        height, width = job.crop_bgr.shape[:2]
        self._cost_of(made.header.codec).observe(area_px=width * height, size_bytes=len(made.data))
        resend, plain = None, self.maker.without_base
        # A second time its tracks have rested since the first sending, and it is not sent a third time.
        if not pending.again:
            for one in (pending.request.candidate, *pending.request.also):
                self.memory.record_sent(one, frame_index=made.header.frame_index, now_ns=now_ns)
            if made.header.codec != plain.name:  # it builds on the base, and a ground may lack that
                resend = job.without_base(plain)
        self._coded(pending, made, now_ns=now_ns, store=store, resend=resend)

    def _coded(
        self, pending: OutboxStill, still: Still, *, now_ns: int, store: bool, resend: Still | None = None
    ) -> None:
        # It is sent under the number that is next now: another may have gone while it was coded.
        if still.header.sequence != (number := self.outbox.sequence(store=store)):
            still = still.with_header(sequence=number)
        if store:
            self.outbox.stored(pending, still)
            self.on_outcome("deferred", "stored")
        else:
            self.outbox.sent(pending, still, now_ns=now_ns, resend=resend)

    def close(self) -> None:
        """End: pending stills will not be sent any more."""
        self.on_demand.close()
        self._count_left(self.outbox.clear(), now_ns=0)

    def _count_left(self, left: Iterable[tuple[OutboxStill, str]], *, now_ns: int) -> None:
        for one, reason in left:
            if isinstance(one, OnDemandStill):
                self.on_demand.expired(one, reason, now_ns=now_ns)
            else:
                self.on_outcome("deferred" if reason == "replaced" else "dropped", reason)

    def _refuse(self, candidate: Candidate, reason: str, *, now_ns: int) -> None:
        self.memory.record_refused(candidate.track_id, now_ns=now_ns)
        self.on_outcome("dropped", reason)

    def _cost_of(self, codec: str) -> CostModel:
        # Learnt for each codec apart: a residual takes a fraction of the bytes of an intra still.
        return self._costs.setdefault(codec, CostModel.of_codec(codec))
