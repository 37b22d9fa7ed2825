"""The state of a ground at one moment, as one value.

Made once a second (`StateMaker`). Status line, page, metrics and ``hvt-ground status`` read it and nothing else, so
that all of them say the same. An unknown value is None, never 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import KW_ONLY, asdict, dataclass, field, fields
from typing import Any, Literal

from hvt_common import __version__
from hvt_common.protocol.edge_words import FrameAccount
from hvt_common.protocol.messages import WIRE_VERSION, Health, Status
from hvt_common.runtime.failures import FailedPart, Failures
from hvt_common.units import SECOND_NS
from hvt_ground.backlog.edge_backlog import EdgeBacklog
from hvt_ground.events import Traffic
from hvt_ground.session.edge_sessions import EdgeSessions
from hvt_ground.session.session import Session
from hvt_ground.session.subscribe import Elsewhere, Group
from hvt_ground.sinks import Outputs

LinkState = Literal["waiting", "up", "thin", "lost", "ended"]
"""``waiting`` for a keyframe to begin with; ``up``; ``thin``: the edge leaves frames out that the link does not
carry; ``lost``: nothing has come for `LOST_NS`; ``ended``: the edge said so, or stayed away."""

LOST_NS = 3 * SECOND_NS
"""A report comes once a second: a pause of three is no accident."""
_THIN_S = 5.0
"""The link counts as thin for this long after the last frame that it did not carry."""


@dataclass(frozen=True, slots=True)
class PoseState:
    """The camera's last reported pose."""

    latitude_deg: float
    longitude_deg: float
    height_m: float | None
    """Above the ground."""
    age_s: float
    """Age of the newest pose; in lockstep at the newest picture. A pose is used for pictures up to 10 s later."""


@dataclass(frozen=True, slots=True)
class _Moment:
    session: Session
    backlog: EdgeBacklog
    now_ns: int
    traffic: Traffic | None
    """None while no picture comes."""
    health: Health | None
    """None while no report comes."""
    status: Status | None
    """The newest, however old."""


def _of(read: Callable[[_Moment], Any]) -> Any:
    # A field, and how it is read.
    return field(metadata={"read": read})


def _live(read: Callable[[Session, Traffic], Any]) -> Any:
    return _of(lambda at: None if at.traffic is None else read(at.session, at.traffic))


def _edge(read: Callable[[Health], Any]) -> Any:
    return _of(lambda at: None if at.health is None else read(at.health))


def _counted(read: Callable[[Status], Any]) -> Any:
    return _of(lambda at: None if at.status is None else read(at.status))


def _delay_ms(percent: int) -> Any:
    def read(session: Session, _: Traffic) -> float | None:
        came = session.reception
        return came.overlay_latency.percentile(percent) if came.knows_delay else None

    return _live(read)


def _picture_age_s(at: _Moment) -> float | None:
    came = at.session.reception
    if came.lockstep or not came.frames:
        return None
    return max(0.0, (at.now_ns - came.capture_clock.to_local_ns(came.newest_capture_ns)) / SECOND_NS)


def _pose(at: _Moment) -> PoseState | None:
    session, newest = at.session, at.session.poses.newest
    if newest is None:
        return None
    age_ns = session.reception.newest_capture_ns - newest.capture_ns
    if not session.lockstep:  # the camera may be gone, and flies on
        age_ns = at.now_ns - session.reception.pose_clock.to_local_ns(newest.capture_ns)
    age_s = max(0.0, age_ns / SECOND_NS)
    return PoseState(newest.latitude_deg, newest.longitude_deg, newest.height_m, age_s)


def _failed_at_edge(at: _Moment) -> tuple[FailedPart, ...]:
    since = {
        one: at.session.reception.clock_offset.to_local_ns(since_ns)
        for one, since_ns in at.session.reception.edge_failing.items()
    }
    failed = () if at.status is None else (one for one in at.status.failed if one.part in since)
    return tuple(FailedPart(one.part, one.reason, min(at.now_ns, since[one.part])) for one in failed)


@dataclass(frozen=True, slots=True)
class SessionState:
    """The session of an edge that is open."""

    session: str = _of(lambda at: f"{at.session.info.session_id:08x}")
    """Its id, hexadecimal."""
    software: str = _of(lambda at: at.session.info.software)
    """The edge's."""
    method: str = _of(lambda at: at.session.reception.method)
    decisions: str = _of(lambda at: at.session.reception.decisions)
    """The choices of ``--profile auto`` beside the video, with the reasons; empty without."""
    lockstep: bool = _of(lambda at: at.session.lockstep)
    duration_s: float = _of(lambda at: at.session.reception.duration_s)
    source_size: tuple[int, int] = _of(lambda at: at.session.info.source_size)
    base_size: tuple[int, int] = _of(lambda at: at.session.info.base_size)
    fps: float = _of(lambda at: at.session.info.fps)
    budget_bps: int = _of(lambda at: at.session.reception.budget_bps)
    """As it is now, like the method; a command shows within half a minute."""
    total_bps: float | None = _live(lambda _, now: now.total_bps)
    """Over the budget's window, all that crossed the line; None while no picture comes, like all that is of now."""
    budget_share: float | None = _live(lambda one, now: now.total_bps / one.reception.budget_bps)
    """The same as a share of the budget."""
    base_bps: float | None = _live(lambda _, now: now.base_bps)
    roi_bps: float | None = _live(lambda _, now: now.roi_bps)
    delay_p50_ms: float | None = _delay_ms(50)
    """Capture to overlay over the session; None in lockstep, before the first, while no picture comes, and where the
    camera's clock cannot be right."""
    delay_p95_ms: float | None = _delay_ms(95)
    picture_age_s: float | None = _of(_picture_age_s)
    """Since the newest picture was captured, or came where the camera's clock cannot be right; None in lockstep."""
    pose: PoseState | None = _of(_pose)  # noqa: RUF009 - a dataclass field, not a default
    """None where none ever came."""
    frames_received: int = _of(lambda at: at.session.reception.frames)
    frames_decoded: int = _of(lambda at: at.session.frames_decoded)
    frames_untracked: int = _of(lambda at: at.session.worker.untracked)
    """Decoded, and passed over by detection and tracking for want of time."""
    gaps: int = _of(lambda at: at.session.reception.counters.gaps)
    lost: int = _of(lambda at: at.session.reception.counters.lost)
    """Messages."""
    corrupt: int = _of(lambda at: at.session.reception.counters.corrupt)
    keyframe_requests: int = _of(lambda at: at.session.reception.counters.keyframe_requests)
    stills_received: int = _of(lambda at: at.session.reception.stills)
    stills_pending: int = _of(
        lambda at: at.session.worker.stills_queued + at.session.perceived.stills_pending
    )
    """For their turn or their base frame."""
    still_outcomes: Mapping[str, int] = _of(lambda at: dict(at.session.perceived.outcomes))
    """The outcomes of the objects in them."""
    stills_not_sent: Mapping[str, int] = _of(lambda at: dict(at.session.reception.not_sent))
    """Why candidates have no still: the edge's counts, by reason."""
    tracks: int = _of(lambda at: at.session.perceived.tracks)
    tracks_refined: int = _of(lambda at: at.session.perceived.refined)
    tracks_doubted: int | None = _live(lambda one, _: one.perceived.doubted)
    """Shown now, and doubted: by stills, or in a view unknown to the detector; None while no picture comes."""
    view_trust: float | None = _live(lambda one, _: one.perceived.view_trust)
    """Mean confidence of the ground detector's boxes, 0…1; None for another than the embedded one, before there were
    enough, and while no picture comes."""
    view_unlike: bool = _of(lambda at: at.traffic is not None and at.session.perceived.view_unlike)
    """It is so low that the detector does not know the view: boxes are thin and unnamed."""
    class_changes: int = _of(lambda at: at.session.perceived.class_changes)
    detections: int = _of(lambda at: at.session.perceived.detections_run)
    backlog_stills: int = _of(lambda at: at.session.backlog.totals.stills)
    """That came after an outage; `backlog_video_s` likewise."""
    backlog_video_s: float = _of(lambda at: at.session.backlog.totals.video_s)
    backlog_working: int = _of(lambda at: at.backlog.working)
    """Objects of the backlog that have come and are not where they belong yet."""
    edge_frames: FrameAccount | None = _counted(  # noqa: RUF009 - likewise
        lambda status: status.frame_account if status.frames else None
    )
    """The outcomes of the edge's source frames, counted; None also where an earlier edge does not say."""
    edge_frames_dropped: int | None = _counted(lambda status: status.health.frames_dropped)
    """At the edge before encoding, all; None before its first report, as all below."""
    edge_frames_dropped_cpu: int | None = _counted(lambda status: status.health.frames_dropped_cpu)
    edge_encode_ms: float | None = _edge(lambda health: health.encode_ms or None)
    """None where nothing was encoded (on the wire 0), or no report comes, as the two below."""
    edge_detect_ms: float | None = _edge(lambda health: health.detect_ms or None)
    edge_still_queue: int | None = _edge(lambda health: health.still_queue)
    edge_failed: tuple[FailedPart, ...] = _of(_failed_at_edge)


@dataclass(frozen=True, slots=True)
class EdgeState:
    """One edge, as this ground sees it."""

    edge: str
    link: LinkState
    link_since_ns: int
    """Unix time."""
    silent_s: float
    """For how long nothing has come."""
    unusable_messages: int
    """Damaged, foreign, or of another version."""
    sessions_ended: int
    session: SessionState | None
    failed: tuple[FailedPart, ...]
    """The parts of this edge's reception that failed."""


@dataclass(frozen=True, slots=True)
class GroundState:
    """All edges, and the ground's own parts."""

    at_ns: int
    """Unix time."""
    version: str
    schema_version: int
    """Version of the messages on the wire."""
    detector: str
    classifier: str
    loading: bool
    """They are not open yet: video is recorded and shown, without boxes of this ground."""
    calibrated: bool
    """Whether a still's probability of a class is one: it was fitted to how often it is right."""
    recorded: bool
    """Sessions are, as far as nothing of it has failed."""
    edges: tuple[EdgeState, ...]
    member: str | None
    """This ground in its ``--group``; None without."""
    elsewhere: Mapping[str, Elsewhere]
    """By edge, the other member of the group that serves it."""
    failed: tuple[FailedPart, ...]
    """Models, recordings and other sinks."""
    behind_s: Mapping[str, float]
    """By recording or other output that is late: the age of its oldest event that is not written."""

    @property
    def behind(self) -> list[str]:
        return [f"{part} is behind by {late_s:.0f} s" for part, late_s in self.behind_s.items()]

    def as_dict(self) -> dict[str, Any]:
        found = asdict(self)
        for one, made in zip(self.edges, found["edges"], strict=True):
            if one.session is not None and one.session.edge_frames is not None:
                made["session"]["edge_frames"] = one.session.edge_frames.as_dict()
        return found


@dataclass(eq=False)
class StateMaker:
    """Makes states, and remembers since when each link is as it is. ``clock`` is Unix time without steps."""

    clock: Callable[[], int]
    _: KW_ONLY
    detector: str = ""
    classifier: str = ""
    calibrated: bool = False
    failures: Failures | None = None
    outputs: Outputs | None = None
    loading: Callable[[], bool] = lambda: False
    recorded: bool = True
    group: Group | None = None

    def __post_init__(self) -> None:
        self._links: dict[str, tuple[LinkState, int]] = {}
        self._left_out: dict[str, tuple[str, int, int]] = {}
        """By edge: session, frames that the link did not carry, and when that last rose."""

    def make(self, edges: Iterable[tuple[str, EdgeSessions]]) -> GroundState:
        now_ns = self.clock()
        made = tuple(self._edge(edge, sessions, now_ns) for edge, sessions in edges)
        known = {one.edge for one in made}
        for memory in (self._links, self._left_out):
            for edge in memory.keys() - known:
                del memory[edge]
        return GroundState(
            at_ns=now_ns,
            version=__version__,
            schema_version=WIRE_VERSION,
            detector=self.detector,
            classifier=self.classifier,
            loading=self.loading(),
            calibrated=self.calibrated,
            recorded=self.recorded,
            edges=made,
            member=None if self.group is None else self.group.member,
            elsewhere={} if self.group is None else self.group.elsewhere,
            failed=() if self.failures is None else self.failures.now,
            behind_s={} if self.outputs is None else self.outputs.behind_s,
        )

    def _edge(self, edge: str, sessions: EdgeSessions, now_ns: int) -> EdgeState:
        session, silent_ns = sessions.session, sessions.receiver.silent_ns  # it may end meanwhile
        link = self._link(edge, sessions, session, now_ns)
        before, since_ns = self._links.get(edge, (None, now_ns))
        if link != before:
            since_ns = now_ns - silent_ns if link == "lost" else now_ns
            self._links[edge] = link, since_ns
        return EdgeState(
            edge=edge,
            link=link,
            link_since_ns=since_ns,
            silent_s=silent_ns / SECOND_NS,
            unusable_messages=sessions.receiver.unusable,
            sessions_ended=sessions.ended,
            session=None if session is None else _session(session, sessions, link=link, now_ns=now_ns),
            failed=sessions.failures.now,
        )

    def _link(self, edge: str, sessions: EdgeSessions, session: Session | None, now_ns: int) -> LinkState:
        if session is None:
            return ("lost" if sessions.disconnected else "ended") if sessions.ended else "waiting"
        if sessions.receiver.silent_ns > LOST_NS and not session.lockstep:
            return "lost"
        left_out = _left_out(session.reception.last_status)
        key = f"{session.info.session_id:08x}"
        known_key, known, rose_ns = self._left_out.get(edge, (key, left_out, 0))
        if known_key != key or left_out < known:
            known, rose_ns = left_out, 0
        if left_out > known:
            rose_ns = now_ns
        self._left_out[edge] = key, left_out, rose_ns
        return "thin" if now_ns - rose_ns < _THIN_S * SECOND_NS else "up"


def _left_out(status: Status | None) -> int:
    # Frames that the link did not carry; of an earlier edge, which does not tell, none.
    return 0 if status is None else status.frame_account.groups.get("link", 0)


def _session(session: Session, sessions: EdgeSessions, *, link: LinkState, now_ns: int) -> SessionState:
    traffic = None if link == "lost" else session.reception.traffic(now_ns)
    status, health = session.reception.last_status, session.reception.health(now_ns)
    at = _Moment(session, sessions.backlog, now_ns, traffic, health, status)
    return SessionState(**{one.name: one.metadata["read"](at) for one in fields(SessionState)})
