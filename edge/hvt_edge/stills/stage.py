"""A still's path: tracks to the ground, a request of the method, a crop, coding, outbox, transmitter or backlog."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing, nullcontext
from dataclasses import KW_ONLY, dataclass

from hvt_common.inference.class_names import same_kind
from hvt_common.protocol.messages import StillResult
from hvt_common.values import AccessUnit, Frame, Tracks
from hvt_edge.backlog.stage import BacklogStage
from hvt_edge.link.stills import Still
from hvt_edge.link.tracks_channel import TrackReporter
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.operating import AutoDecisions, Keyframes
from hvt_edge.perception.analyzer import AnalyzedFrame, Analyzer
from hvt_edge.perception.auto import AutoControl
from hvt_edge.perception.shadow import Detected, ShadowGround
from hvt_edge.stills.maker import Allowance, NoStill, StillMaker
from hvt_edge.stills.outbox import AGAIN, Outbox, OutboxStill
from hvt_edge.stills.scheduler import Chooser, Coded

_ALL = AutoDecisions()


@dataclass(eq=False)
class StillStage:
    """Takes each frame with its access unit, if it has one, after the unit was sent.

    With a ``reporter`` the edge's own tracks are sent at each decision step, before its stills. With ``auto``
    both depend on their measured gain.
    """

    analyzer: Analyzer
    chooser: Chooser
    _: KW_ONLY
    sender: StillSender
    keyframes: Keyframes
    reporter: TrackReporter | None = None
    shadow: ShadowGround | None = None
    tracks_used: bool = True
    """Whether encoder or receivers use tracks; else only a method that sends stills, or a ground's request, does."""
    auto: AutoControl | None = None
    """Decides by reports of ``shadow`` and the grounds; None: tracks and stills are sent as the settings allow."""

    def __post_init__(self) -> None:
        self.outbox = self.sender.outbox
        self.latest_tracks: Tracks | None = None
        """The tracks of the frame that `step` took last. In lockstep they change at the same point of the frame loop
        in every run, whatever `analyze` does meanwhile."""
        self._decisions = _ALL
        self._scene_began = -1
        self._detected: Detected | None = None
        """Reported since the decision before; in lockstep a frame may be compared at this very moment."""

    def capture(self, frame: Frame) -> None:
        """Hold the camera's newest frame, which may never be analyzed: a ground may request a still of it."""
        self.chooser.on_demand.ring.capture(frame)

    def analyze(
        self, frame: Frame, unit: AccessUnit | None, skipped: Sequence[AccessUnit] = ()
    ) -> AnalyzedFrame:
        """Decode, detect and track one frame; ``unit`` is None for a frame that is not part of the base stream.

        ``skipped`` are units before it, of frames that were not analyzed. Where nobody uses the results, the frame is
        only decoded.
        """
        if not self.is_used(frame.capture_ns):
            return self.analyzer.pass_over(frame, unit, skipped=skipped)
        analyzed = self.analyzer.analyze(frame, unit, skipped=skipped)
        if self.shadow is not None:
            self.shadow.compare(analyzed)
        return analyzed

    def is_used(self, capture_ns: int) -> bool:
        """Whether anybody uses the results of `analyze` for a frame of that time."""
        wanted = self.tracks_used or not self.chooser.method.video_only
        return wanted or self.chooser.on_demand.wants_tracks(capture_ns)

    def step(self, analyzed: AnalyzedFrame, *, now_ns: int, held: bool | None = None) -> set[int]:
        """Decide on tracks and stills, send the tracks to grounds, and `send` stills."""
        self.latest_tracks = analyzed.tracks
        self.chooser.on_demand.add(analyzed)
        with self.analyzer.cpu_budget.spending("choose") if analyzed.detected else nullcontext():
            self._decisions = self._decided(now_ns)
            if self.reporter is not None and analyzed.detected and self._decisions.tracks:
                self.reporter.report(analyzed, now_ns=now_ns)
            return self.send(analyzed, now_ns=now_ns, held=held)

    def send(self, analyzed: AnalyzedFrame, *, now_ns: int, held: bool | None = None) -> set[int]:
        """Choose, and send the stills of the method that may go now; return their sequence numbers.

        ``now_ns`` is the time of the budget's windows. With ``held`` none is sent, because a keyframe is due; None
        takes that from the plan.
        """
        if most_bytes := self.sender.transmitter.most_still_bytes():
            self.chooser.most_bytes = most_bytes
        # A method's request waits until the link is free, which right behind a base frame it never is.
        allowance_bytes = self.sender.transmitter.still_allowance_bytes(now_ns, paced=False)
        self.chooser.consider(
            analyzed, now_ns=now_ns, allowance_bytes=allowance_bytes, paused=not self._decisions.stills
        )
        return self.send_pending(now_ns=now_ns, held=held)

    def send_pending(self, *, now_ns: int, held: bool | None = None) -> set[int]:
        """Send pending stills of the method that may go now, without another frame; arguments as for `send`."""
        self.sender.store_lost(now_ns)
        store = self.sender.offline
        if not store and (self.keyframes.due(now_ns) if held is None else held):
            return set()
        allowance = self.sender.allowance(now_ns, paced=not store)
        stills = self.chooser.stills(now_ns=now_ns, allowance=allowance, store=store)
        return self._put(stills, now_ns=now_ns, store=store)

    def send_requested(self, *, now_ns: int, held: bool | None = None) -> set[int]:
        """Send requested stills that may go now; arguments as for `send`. May run beside all else."""
        self.chooser.expire_requested(now_ns)
        store = self.sender.offline
        held = not store and (self.keyframes.due(now_ns) if held is None else held)
        if held and self.keyframes.requested:
            return set()  # a scheduled keyframe can wait for them, this one cannot
        stills = self.chooser.requested(now_ns=now_ns, store=store)
        return self._put(stills, now_ns=now_ns, store=store)

    def _put(self, stills: Coded, *, now_ns: int, store: bool) -> set[int]:
        sent: set[int] = set()
        with closing(stills):
            for coded in stills:
                self.sender.put(coded, now_ns=now_ns, store=store)
                if not store:
                    sent.add(coded.still.header.sequence)
        return sent

    def on_results(self, results: Sequence[StillResult], *, detected: Detected | None = None) -> None:
        """Note a ground's answers to stills for the next decision; one without a name is no opinion.

        A still that it could not decode for want of the base frame is sent once more. ``detected`` is the report of
        its own detector; None: there is nothing new.
        """
        if detected is not None:
            self._detected = detected
        for result in results:
            if result.again:
                self.outbox.on_undecodable(result.still_sequence)
            if result.class_name:
                self._note_change(result)
                self.chooser.memory.record_feedback(
                    result.track_id,
                    class_name=result.class_name,
                    confidence=result.confidence,
                    entropy_nats=result.entropy_nats,
                )

    def note_load(self, cores: float, *, now_ns: int) -> None:
        cpu_budget = self.analyzer.cpu_budget
        cpu_budget.measure(cores, now_ns=now_ns)
        if self.auto is not None:
            self.auto.take_load(too_slow=cpu_budget.too_slow, now_ns=now_ns)

    def _decided(self, now_ns: int) -> AutoDecisions:
        if self.auto is None:
            return _ALL
        if self.shadow is not None:
            if self.shadow.scene_began != self._scene_began:
                self._scene_began = self.shadow.scene_began
                self.auto.forget()
            if self._detected is not None:
                self.shadow.take_detected(self._detected)
                self._detected = None
            self.auto.measured = self.shadow.measured
        self.auto.unlike = self.analyzer.view_unlike
        decisions = self.auto.decide(now_ns)
        if self.shadow is not None:
            self.shadow.stable = self.auto.stable
        return decisions

    def _note_change(self, result: StillResult) -> None:
        # A still has changed something if by it alone the ground names another object than the edge.
        tracks = self.latest_tracks
        if self.auto is None or tracks is None:
            return
        rows = (tracks.ids == result.track_id).nonzero()[0]
        if len(rows):
            name = self.chooser.class_names[int(tracks.class_ids[rows[0]])]
            self.auto.take_answer(changed=not same_kind(result.class_name, name))


@dataclass(eq=False)
class StillSender:
    """`put` is for both threads of stills, the rest for the method's thread, or for the caller that ends the run.

    ``backlog`` may be None.
    """

    outbox: Outbox
    _: KW_ONLY
    maker: StillMaker
    transmitter: Transmitter
    backlog: BacklogStage | None = None

    def __post_init__(self) -> None:
        self._breaks = 0

    @property
    def offline(self) -> bool:
        return self.backlog is not None and self.backlog.offline

    def allowance(self, now_ns: int, *, paced: bool) -> Allowance:
        return lambda still: self.transmitter.still_allowance_bytes(now_ns, still=still, paced=paced)

    def put(self, coded: OutboxStill, *, now_ns: int, store: bool) -> None:
        """Send a coded still, or a second copy of it, or store it."""
        if store:
            self._store(coded, now_ns=now_ns, counted=True)
            return
        # A second copy waits for its allowance like any other still, but no requester waits for it.
        copy, requested = AGAIN if coded.copies > 1 else "", coded.request is None and coded.copies == 1
        self.transmitter.still(coded.still, now_ns=now_ns, copy=copy, requested=requested)

    def store_lost(self, now_ns: int) -> None:
        """Store stills that were sent before the link went down, or came back, and that no report has named."""
        if self.backlog is None or self.backlog.breaks == self._breaks:
            return
        self._breaks = self.backlog.breaks
        for lost in self.outbox.lose():
            self.outbox.stored(lost, self._without_base(lost.still, lost.job))
            self._store(lost, now_ns=now_ns, counted=False)

    def close(self, now_ns: int) -> None:
        """The run ends: stills that no report has named are stored."""
        if self.backlog is not None:
            self.backlog.end_in_flight()
        self.store_lost(now_ns)

    def _store(self, one: OutboxStill, *, now_ns: int, counted: bool) -> None:
        assert self.backlog is not None, "nothing is stored without one"
        packed = self.transmitter.store_still(one.still, now_ns=now_ns, counted=counted)
        self.backlog.store_still(
            packed,
            number=one.still.header.sequence,
            capture_ns=one.still.header.capture_ns,
            utility=one.utility,
        )

    def _without_base(self, still: Still, job: Still | None) -> Still:
        # A sent still, coded anew without the base; unchanged where it needs none, or its crop is gone.
        if job is None:
            return still
        most_bytes = self.transmitter.most_still_bytes()
        made = self.maker.code(job, sequence=still.header.sequence, allowance=lambda _: most_bytes)
        return still if isinstance(made, NoStill) else made
