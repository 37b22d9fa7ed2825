"""The state of an edge at one moment, as one value.

Made once a second (`Heartbeat`). Status line, the wire's `Status`, metrics and ``hvt-edge status`` all read from it,
so that they never contradict each other. Unknown values are None, never 0.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, asdict, dataclass
from typing import Any, Literal

from hvt_common import __version__
from hvt_common.protocol.channels import Channel
from hvt_common.protocol.edge_words import FrameAccount
from hvt_common.protocol.ledger import Account
from hvt_common.protocol.messages import WIRE_VERSION
from hvt_common.runtime.failures import FailedPart, Failures
from hvt_common.runtime.process import notify_systemd
from hvt_common.units import SECOND_NS
from hvt_common.values import View
from hvt_edge.backlog.stage import BacklogStage
from hvt_edge.backlog.worker import StoreNumbers
from hvt_edge.config import EdgeConfig
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.link.publisher import EdgeLink
from hvt_edge.loop.counts import Cores, FrameCounts
from hvt_edge.operating import AutoDecisions, LoopClock, Operating
from hvt_edge.stills.stage import StillStage

_LEAST_OLD_S = 1.5
"""Boxes that are younger do not count as old."""
_SILENT_S = 3.0
"""A source that has given no frame for this long, and two frames longer, has failed."""

Phase = Literal["waiting", "running", "ended"]
"""``waiting``: a clip waits for its first ground."""


@dataclass(frozen=True, slots=True)
class OperatingState:
    """The operating point."""

    source_size: tuple[int, int]
    base_size: tuple[int, int]
    fps: float
    """Frames a second that are coded, if none is dropped."""
    decimation: int
    profile: str | None
    preset: str
    preset_says: str
    """The reason for a faster preset than with more time; empty for the usual one."""
    budget_bps: int
    """The budget as set or commanded."""
    allowed_bps: int
    """The rate that may be sent now: less than the budget if the link carries less."""
    base_budget_bps: int


@dataclass(frozen=True, slots=True)
class Frames:
    """Frame counts since the start."""

    account: FrameAccount
    encoded: int
    unanalyzed: int
    """Skipped by perception for want of time."""


@dataclass(frozen=True, slots=True)
class LinkState:
    """The edge's view of its link."""

    ground: bool
    since_ns: int
    """Unix time of the last change of ``ground``."""
    watched: bool
    """Whether any program subscribes to the video, also one that reports nothing."""
    trouble: str | None
    """The reason why no ground can be reached, where that is known."""
    reported_s: float | None
    round_trip_ms: float | None
    rate_bps: int | None
    """The measured rate of the link; None if it is not measured."""
    unusable_messages: int
    """Messages from grounds that were damaged, foreign, or of another version."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BacklogState(StoreNumbers):
    """Objects stored while the link is down, and sent afterwards."""

    offline: bool
    """Frames and stills go into the store now."""
    limit_bytes: int
    disk_free_bytes: int | None
    """Free bytes of the store's disk; None where it does not answer."""
    frames_stored: int
    """Frames stored by this session."""


@dataclass(frozen=True, slots=True)
class EdgeState:
    """The edge and its session."""

    at_ns: int
    """Unix time, as all times here."""
    version: str
    schema_version: int
    """Version of the messages on the wire."""
    edge: str
    session: str
    state: Phase
    lockstep: bool
    duration_s: float
    method: str
    decisions: AutoDecisions
    """The parts sent beside the video, and the reason."""
    operating: OperatingState
    total_bps: float | None
    """Rate over the budget's window, like those below; None before the first frame."""
    base_bps: float | None
    roi_bps: float | None
    backlog_bps: float | None
    meta_bps: float | None
    budget_share: float | None
    """The used share of the allowed rate."""
    frames: Frames
    source_silent_s: float | None
    """Time since the source gave its last frame; None before the first."""
    keyframes: int
    keyframe_requests: int
    """Requests of grounds that were served."""
    stills_sent: int
    stills_pending: int
    stills_in_flight: int
    """Sent, and in no report yet."""
    stills_not_sent: Mapping[str, int]
    tracks: int
    encode_ms: float | None
    """Mean of one frame, since the start; like the next."""
    perception_ms: float | None
    boxes_age_s: float | None
    """Age, at the newest frame, of the frame in which objects were last searched for; None before the first search,
    and while no picture comes."""
    detection_slow: bool
    """Boxes are older than they would be if detection had its time."""
    cores_needed: float | None
    """Processor cores that all frames would need, had none been left out."""
    cores_free: float | None
    """Cores that other processes leave."""
    link: LinkState
    backlog: BacklogState | None
    failed: tuple[FailedPart, ...]

    def as_dict(self) -> dict[str, Any]:
        found = asdict(self)
        found["frames"] |= {"account": self.frames.account.as_dict()}
        return found


def lacks(state: EdgeState) -> str:
    """The reason why an edge whose loop turns sends no pictures; empty for none."""
    if state.state == "waiting":
        return "it waits for a ground"
    silent_s, operating = state.source_silent_s, state.operating
    if silent_s is not None and silent_s < _patience_s(operating.fps * operating.decimation):
        return ""
    said = "no picture yet" if silent_s is None else f"no picture for {silent_s:.0f} s"
    return "; ".join([said, *(f"{one.part}: {one.reason}" for one in state.failed if one.part == "source")])


def _patience_s(fps: float) -> float:
    return _SILENT_S + 2 / fps


def boxes_age_s(
    detected_ns: int | None, *, newest_ns: int | None, resumed_ns: int, silent: bool, usual_s: float
) -> tuple[float | None, bool]:
    """`EdgeState.boxes_age_s`, and whether detection is slow; ``usual_s`` is the age if detection has its time.

    ``resumed_ns``: when the source last gave pictures again; before that there was nothing to search.
    """
    if newest_ns is None or detected_ns is None or silent:
        return None, False
    age_s = max(0, newest_ns - detected_ns) / SECOND_NS
    return age_s, min(age_s, (newest_ns - resumed_ns) / SECOND_NS) > usual_s


@dataclass(eq=False)
class Heartbeat:
    """Each second the frame loop mends the link and reports that it turns: to watchers, and to systemd's watchdog.

    A long wait in the loop turns it meanwhile: a clip waits for its ground, or for the next of a few frames a second;
    a lost camera yields steps without a frame. Only a loop that hangs reports nothing. ``clock`` is wall time, in
    lockstep too.
    """

    config: EdgeConfig
    _: KW_ONLY
    view: View
    operating: Operating
    counts: FrameCounts
    stills: StillStage
    link: EdgeLink
    inbox: FeedbackInbox
    failures: Failures
    clock: Callable[[], int]
    loop_clock: LoopClock

    def __post_init__(self) -> None:
        self.transmitter, self.backlog = self.stills.sender.transmitter, self.stills.sender.backlog
        self.ledger, self.session_id = self.transmitter.ledger, self.transmitter.session_id
        self._ground, self._since_ns = False, self.clock()
        self._due_ns = 0
        self.state: EdgeState | None = None
        """The newest state; None before the first. Any thread may read it."""

    @property
    def frames(self) -> FrameAccount:
        fps = self.config.nominal_fps / self.operating.now.decimation
        return self.counts.account(coded_fps=fps, auto_fps=self.config.auto_fps)

    def beat(self, phase: Phase) -> EdgeState:
        self._due_ns = self.clock() + SECOND_NS
        self.link.mend()
        self.state = self._made(phase)
        notify_systemd("WATCHDOG=1")
        return self.state

    def turn(self, phase: Phase) -> None:
        """Make a state if the last is a second old."""
        if self.clock() >= self._due_ns:
            self.beat(phase)

    def _made(self, phase: Phase) -> EdgeState:
        config, counts, ledger, analyzer = self.config, self.counts, self.ledger, self.stills.analyzer
        counts.measure_cpu(perception_ns=analyzer.spent_ns)
        now_ns, now, cores = self.clock(), self.operating.now, counts.cpu.now
        total_bps = self._bps(None)
        outcomes = Counter(ledger.outcomes("deferred")) + Counter(ledger.outcomes("dropped"))
        came_ns = counts.newest_came_ns
        silent_s = None if came_ns is None else max(0.0, (now_ns - came_ns) / SECOND_NS)
        lockstep = config.pace == "lockstep"
        # Twice the time between two detections, which wait for frames that are coded.
        frames = max(analyzer.detect_every, now.decimation)
        age_s, slow = boxes_age_s(
            analyzer.detected_ns,
            newest_ns=self.loop_clock() if lockstep else came_ns,
            resumed_ns=counts.resumed_ns,
            silent=not lockstep and (silent_s or 0.0) > _patience_s(config.nominal_fps),
            usual_s=max(_LEAST_OLD_S, 2 * frames / config.nominal_fps),
        )
        return EdgeState(
            at_ns=now_ns,
            version=__version__,
            schema_version=WIRE_VERSION,
            edge=config.edge_id,
            session=f"{self.session_id:08x}",
            state=phase,
            lockstep=lockstep,
            duration_s=counts.duration_s(config.nominal_fps),
            method=now.method,
            decisions=now.decisions,
            operating=OperatingState(
                source_size=self.view.source_size,
                base_size=self.view.base_size,
                fps=config.nominal_fps / now.decimation,
                decimation=now.decimation,
                profile=config.profile,
                preset=now.preset,
                preset_says=now.preset_says,
                budget_bps=now.budget_bps,
                allowed_bps=now.total_bps,
                base_budget_bps=now.base_bps,
            ),
            total_bps=total_bps,
            base_bps=self._bps(Account.BASE),
            roi_bps=self._bps(Account.ROI),
            backlog_bps=self._bps(Account.BACKLOG),
            meta_bps=self._bps(Account.META),
            budget_share=None if total_bps is None else total_bps / now.total_bps,
            frames=Frames(self.frames, encoded=counts.encoded, unanalyzed=counts.unanalyzed),
            source_silent_s=silent_s,
            keyframes=self.stills.keyframes.sent,
            keyframe_requests=self.stills.keyframes.served,
            stills_sent=sum(ledger.outcomes("sent").values()),
            stills_pending=len(self.stills.outbox),
            stills_in_flight=self.stills.outbox.unacknowledged,
            stills_not_sent=dict(outcomes),
            tracks=analyzer.tracks,
            encode_ms=counts.encode_ms if counts.encoded else None,
            perception_ms=analyzer.mean_ms if analyzer.frames else None,
            boxes_age_s=age_s,
            detection_slow=slow,
            cores_needed=None if cores == Cores() else cores.needed,
            cores_free=None if cores == Cores() else cores.free,
            link=self._link(now_ns),
            backlog=None if self.backlog is None else _backlog(self.backlog),
            failed=self.failures.now,
        )

    def _bps(self, account: Account | None) -> float | None:
        if not self.counts.encoded:
            return None
        return self.ledger.window_bytes(account, self.loop_clock()) * 8 * SECOND_NS / self.ledger.window_ns

    def _link(self, now_ns: int) -> LinkState:
        link, pacer, reported_ns = self.link, self.transmitter.pacer, self.inbox.received_ns
        ground = link.has_ground()
        if ground != self._ground:
            self._ground, self._since_ns = ground, now_ns
        measured = pacer if pacer is not None and pacer.measured_now(now_ns) else None
        return LinkState(
            ground=ground,
            since_ns=self._since_ns,
            watched=link.has_subscriber(Channel.BASE),
            trouble=link.trouble or None,
            reported_s=None if reported_ns is None else max(0, now_ns - reported_ns) / SECOND_NS,
            round_trip_ms=None if measured is None else measured.round_trip_ns / 1e6,
            rate_bps=None if measured is None else measured.rate_bps,
            unusable_messages=link.unusable,
        )


def _backlog(backlog: BacklogStage) -> BacklogState:
    return BacklogState(
        **asdict(backlog.worker.numbers),
        offline=backlog.offline,
        limit_bytes=backlog.max_bytes,
        disk_free_bytes=backlog.worker.disk_free_bytes,
        frames_stored=backlog.frames,
    )
