"""A whole flight in one process: the very edge and ground that fly, a simulated serial link between them, no clock.

The edge is `hvt_edge.app.Edge` with its borders replaced: where frames come from (`FrameSource`), where messages go
(`SerialLink`), and when feedback comes back. The ground is `GroundSession`. Media time is the only
time: a message acts at the ground when the link has delivered it and not before, and what the ground says of a still
is heard at the edge as much later as that still took to cross. The same input gives the same flight, always.

The ground's list is taken at every frame of the clip (15 a second), coded or not. At a frame that was not coded it is
taken as late after its capture as the last picture was.
"""

from __future__ import annotations

import hashlib
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from hvt_common.inference.detect import MOTION, Detector
from hvt_common.inference.tiles import tiled
from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.protocol.ledger import LedgerSummary, overhead_bytes
from hvt_common.protocol.messages import BaseHeader, Info, RoiHeader, Status, StillResult, TrackStep
from hvt_common.runtime.clock import SteadyClock
from hvt_common.transport.inbox import Received
from hvt_common.values import Fit, Frame
from hvt_edge.app import Edge
from hvt_edge.config import EdgeConfig
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.loop.lockstep import LockstepPace
from hvt_edge.source.contract import Source
from hvt_edge.source.resample import Resizer
from hvt_edge.wiring import base_size
from hvt_ground.config import GroundConfig
from hvt_ground.wiring import Models
from hvt_study.cache.cached_detector import CachedDetector
from hvt_study.datasets.clip import NOMINAL_FPS, Clip, FrameSource
from hvt_study.flights.flight_ground import GroundSide, InlineExecutor
from hvt_study.metrics.observed import ObservedFrame
from hvt_study.serial_link import LinkReport, SerialLink

__all__ = ["FlightPlan", "FlightReport", "coded_frames", "dry_run", "fly"]

_START_NS = 1_700_000_000_000_000_000
_SESSION = 1 << 40  # as many bytes on the wire as a random one
_SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class FlightPlan:
    """One flight; both configurations have been through their ``check``."""

    clip: Clip
    edge: EdgeConfig
    """Its pace is lockstep, and its frame rate one of those that `coded_frames` knows, or ``auto``."""
    ground: GroundConfig
    link_bps: int


@dataclass(frozen=True, slots=True)
class FlightReport:
    """What a flight cost and what it showed."""

    lists: tuple[ObservedFrame, ...]
    """The ground's list at every frame, source pixels."""
    account: LedgerSummary
    """The edge's ledger over the whole clip."""
    line_bytes: Mapping[str, int]
    """By row of the key table: payload, attachment and transport."""
    messages: Mapping[str, int]
    max_frame_bytes: int
    """The largest access unit."""
    link: LinkReport
    """Its delays are those of the base stream, from capture to arrival."""
    picture_age_p95_ms: float
    """How old the newest picture at the ground is, seen at every frame."""
    edge_cpu_ms: float
    """CPU of the edge's stages a frame, whatever the number of cores."""
    digest: str
    """Of all payloads: two flights that sent the same have the same."""
    back_bytes: int = 0
    """Line bytes from the ground to the edge: reports on stills. The questions of a server are in ``line_bytes``."""

    @property
    def duration_s(self) -> float:
        """Media time."""
        return len(self.lists) / NOMINAL_FPS

    def bps(self, *rows: str) -> int:
        """Line bits a second of these rows; of everything where none is named."""
        size_bytes = sum(self.line_bytes.get(row, 0) for row in rows or self.line_bytes)
        return round(size_bytes * 8 / self.duration_s)


def coded_frames(frames: int, fps: float) -> frozenset[int]:
    """Which frames a fixed frame rate codes: the first at or after each instant ``k / fps``."""
    count = math.ceil(frames * fps / NOMINAL_FPS)
    return frozenset(
        frame_index for k in range(count) if (frame_index := math.ceil(k * NOMINAL_FPS / fps)) < frames
    )


def fly(plan: FlightPlan, *, detector: Detector, models: Models) -> FlightReport:
    """Fly once; ``detector`` serves the edge, ``models`` the ground.

    Raises:
        UserError: the edge refuses its settings.
    """
    saved_s = detector.saved_cpu_s if isinstance(detector, CachedDetector) else 0.0
    edge = _Edge(plan, detector=detector, models=models)
    edge.run()
    edge.ground.close()
    if isinstance(detector, CachedDetector):
        saved_s = detector.saved_cpu_s - saved_s
    return edge.report(saved_cpu_s=saved_s)


def dry_run(plan: FlightPlan, *, detector: Detector) -> float:
    """Fly without a ground; return the line bits a second, headers and transport included.

    Where nothing that a ground says matters (methods without stills), that is to the bit what `fly` spends.

    Raises:
        UserError: the edge refuses its settings.
    """
    edge = _DryRun(plan, detector=detector)
    edge.run()
    return edge.line_bytes * 8 / (plan.clip.frame_count / NOMINAL_FPS)


class _MediaClock(SteadyClock):
    def __call__(self) -> int:
        return _START_NS


class _Inbox(FeedbackInbox):
    """What the ground said, when the link has brought it back; nobody ever waits for more."""

    def __init__(self) -> None:
        super().__init__()
        self.now_ns = _START_NS
        self.due: deque[tuple[int, StillResult]] = deque()

    def take(self) -> list[StillResult]:
        heard = [one for at_ns, one in self.due if at_ns <= self.now_ns]
        self.due = deque((at_ns, one) for at_ns, one in self.due if at_ns > self.now_ns)
        return heard

    def take_up_to(self, sequence: int) -> list[StillResult]:  # noqa: ARG002 - time decides here
        return self.take()

    def wait_for(self, **_: Any) -> bool:
        return True

    def wait_for_end(self, **_: Any) -> bool:
        return True


class _Outlet:
    """The edge's end of the link: `hvt_edge.link.publisher.EdgeLink` without Zenoh."""

    unusable = 0

    def __init__(self, link: SerialLink[Received], *, edge_id: str) -> None:
        self._link = link
        self._keys = EdgeKeys(edge_id)
        self._digest = hashlib.sha256()
        self.line_bytes: Counter[str] = Counter()
        self.messages: Counter[str] = Counter()
        self.max_frame_bytes = 0
        self.last_frame = -1
        """Index of the newest frame sent."""

    def heard(self) -> bool:
        return True

    def put(
        self, row: Channel, payload: bytes, *, attachment: bytes | None = None, encoding: str = ""
    ) -> None:
        """Hand over one message at the time that it says itself."""
        attached = attachment or b""
        key = self._keys.key(row)
        size_bytes = (
            len(payload)
            + len(attached)
            + overhead_bytes(len(payload), len(attached), key=key, encoding=encoding)
        )
        self.line_bytes[row] += size_bytes
        self.messages[row] += 1
        if row is not Channel.STATUS:  # it counts what the machine did
            self._digest.update(payload)
        self._link.put(
            Received(key, payload, attached, encoding, 0),
            size_bytes=size_bytes,
            enter_ns=self._enter_ns(row, payload, attached),
            urgent=row is Channel.BASE,
        )

    @property
    def digest(self) -> str:
        return self._digest.hexdigest()

    def _enter_ns(self, row: Channel, payload: bytes, attachment: bytes) -> int:
        if row is Channel.BASE:
            header = BaseHeader.parse(attachment, payload)
            self.last_frame = header.frame_index
            self.max_frame_bytes = max(self.max_frame_bytes, len(payload))
            return header.send_ns
        if row is Channel.ROI:
            return RoiHeader.parse(attachment, payload).send_ns
        if row is Channel.TRACKS:
            return TrackStep.parse(payload).send_ns
        assert row is Channel.STATUS, f"the edge sends no {row}"
        return Status.parse(payload).send_ns


class _Pace(LockstepPace):
    """The lockstep of the edge with the ground in step: after each frame, what has arrived by then is taken in."""

    def __init__(
        self, *stages: Any, inbox: _Inbox, ground: GroundSide, outlet: _Outlet, **named: Any
    ) -> None:
        super().__init__(*stages, inbox=inbox, **named)
        self._worker = InlineExecutor()
        self._feedback, self._ground, self._outlet = inbox, ground, outlet
        self._next_frame = 0
        self.cpu_s = 0.0

    def step(self, frame: Frame) -> None:
        began_s = time.process_time()
        self._feedback.now_ns = frame.capture_ns
        super().step(frame)
        self.cpu_s += time.process_time() - began_s
        self.pass_over(frame.index)
        if self._outlet.last_frame != frame.index:
            self._ground.pass_over(frame.index, capture_ns=frame.capture_ns)
        self._next_frame = frame.index + 1
        self._ground.advance(frame.capture_ns)
        self._feedback.due += self._ground.results
        self._ground.results.clear()

    def pass_over(self, until_frame: int) -> None:
        """The source did not give the frames before this one."""
        for frame_index in range(self._next_frame, until_frame):
            self._ground.pass_over(
                frame_index, capture_ns=_START_NS + round(frame_index * _SECOND_NS / NOMINAL_FPS)
            )
        self._next_frame = max(self._next_frame, until_frame)


class _Edge(Edge):
    """The edge's own app over a clip of frames and a simulated link."""

    def __init__(self, plan: FlightPlan, *, detector: Detector, models: Models | None) -> None:
        # The detector is open already: the app is told of one that costs nothing to open.
        super().__init__(replace(plan.edge, quiet=True, detector=MOTION, tiles="off"), stop=threading.Event())
        self._plan = plan
        self._detector = detector
        self._models = models
        self._session_id = _SESSION
        self._clock = _MediaClock()
        self._inbox: _Inbox = _Inbox()
        self._pace: _Pace | None = None
        self.ground: GroundSide

    def report(self, *, saved_cpu_s: float) -> FlightReport:
        """After `run`."""
        frames, outlet, pace = self._plan.clip.frame_count, self._outlet, self._pace
        assert pace is not None, "run() makes it"
        return FlightReport(
            lists=tuple(self.ground.lists[frame_index] for frame_index in range(frames)),
            account=self._ledger.summary(frames / NOMINAL_FPS),
            line_bytes=dict(outlet.line_bytes),
            messages=dict(outlet.messages),
            max_frame_bytes=outlet.max_frame_bytes,
            link=LinkReport.of(self.ground.base_delays_ns, self.ground.arrivals),
            picture_age_p95_ms=self._picture_age_p95_ms(),
            edge_cpu_ms=1e3 * (pace.cpu_s + saved_cpu_s) / frames,
            digest=outlet.digest,
            back_bytes=self.ground.back_bytes,
        )

    def _make_flow(self, stack: ExitStack, source: Source, detector: Detector) -> Any:  # noqa: ARG002
        config = self._plan.edge
        own = tiled(self._detector, config.tiles) if config.candidates == "source" else self._detector
        return super()._make_flow(stack, source, own)

    def _open_source(self) -> FrameSource:
        config, clip = self._plan.edge, self._plan.clip
        # With --fps auto the edge sees every frame, and leaves out by itself what it does not code.
        fps = NOMINAL_FPS if isinstance(config.fps, str) else config.fps
        resizer = Resizer(clip.source_size, base_size(config), fit=cast("Fit", config.fit))
        return FrameSource(clip, resizer, frames=coded_frames(clip.frame_count, fps))

    def _open_link(self, stack: ExitStack, source: Source, class_names: tuple[str, ...]) -> Any:  # noqa: ARG002
        link: SerialLink[Received] = SerialLink(rate_bps=self._plan.link_bps)
        info = Info.parse(self._info(source, class_names, _START_NS))
        self._outlet = _Outlet(link, edge_id=self._config.edge_id)
        self.ground = self._make_ground(replace(info, fps=NOMINAL_FPS, started_ns=_START_NS), link)
        return self._outlet

    def _make_ground(self, info: Info, link: SerialLink[Received]) -> GroundSide:
        assert self._models is not None, "only the scales do without"
        return GroundSide(info, config=self._plan.ground, models=self._models, link=link)

    def _wait_for_ground(self, *_: Any) -> None:
        """It is there."""

    def _make_pace(self, flow: Any, source: Source) -> LockstepPace:  # noqa: ARG002
        self._pace = _Pace(
            flow.base,
            flow.stills,
            inbox=self._inbox,
            ground=self.ground,
            outlet=self._outlet,
            keyframes=self._keyframes,
            fps=NOMINAL_FPS,  # frame indices count frames
            counts=self._counts,
            heard=self._outlet.heard,
            stop=self._stop,
        )
        return self._pace

    def _say_goodbye(self, flow: Any) -> None:
        super()._say_goodbye(flow)
        if self._pace is not None:
            self._pace.pass_over(self._plan.clip.frame_count)

    def _picture_age_p95_ms(self) -> float:
        """Over the frames from the first picture on."""
        shown = np.array(self.ground.shown_ns, np.int64).reshape(-1, 2)
        at_ns = _START_NS + np.round(
            np.arange(self._plan.clip.frame_count) * _SECOND_NS / NOMINAL_FPS
        ).astype(np.int64)
        at_ns = at_ns[at_ns >= shown[0, 0]]
        newest = shown[np.searchsorted(shown[:, 0], at_ns, side="right") - 1, 1]
        return float(np.percentile((at_ns - newest) / 1e6, 95)) if len(at_ns) else 0.0


class _Nobody:
    """A ground that takes what comes and looks at nothing."""

    def __init__(self, link: SerialLink[Received]) -> None:
        self._link = link
        self.results: deque[tuple[int, StillResult]] = deque()

    def pass_over(self, frame_index: int, *, capture_ns: int) -> None:
        """Nothing is listed."""

    def advance(self, now_ns: int | None) -> None:
        """Let go of what has arrived."""
        self._link.arrived(now_ns)


class _DryRun(_Edge):
    """The same edge, of which only the bytes are of interest."""

    def __init__(self, plan: FlightPlan, *, detector: Detector) -> None:
        super().__init__(plan, detector=detector, models=None)

    @property
    def line_bytes(self) -> int:
        return sum(self._outlet.line_bytes.values())

    def _make_ground(self, info: Info, link: SerialLink[Received]) -> Any:  # noqa: ARG002
        return _Nobody(link)
