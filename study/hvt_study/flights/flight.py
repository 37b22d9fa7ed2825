"""A whole flight in one process: the very edge and ground that fly, a simulated serial link between them, no clock.

The edge is `hvt_edge.app.Edge` in another world: where frames come from (`FrameSource`), where messages go
(`SerialLink`), and when feedback comes back. The ground is `Session`. Media time is the only
time: a message acts at the ground when the link has delivered it and not before, and the answer to a still comes
back to the edge as much later as that still took to cross. The same input gives the same flight, always.

The ground's list is taken at every frame of the clip (15 a second), coded or not. At a frame that was not coded it is
taken as late after its capture as the last picture was.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from hvt_common.inference.detect import Detector
from hvt_common.inference.tiles import tiled
from hvt_common.protocol.ledger import LedgerSummary
from hvt_common.protocol.messages import Info, StillResult
from hvt_common.transport.inbox import Received
from hvt_common.values import Fit, Frame
from hvt_edge.app import Edge
from hvt_edge.config import EdgeConfig
from hvt_edge.link.publisher import EdgeLink
from hvt_edge.perception.shadow import Detected
from hvt_edge.source.resample import Resizer
from hvt_edge.wiring import base_size
from hvt_edge.world import World
from hvt_ground.config import GroundConfig
from hvt_ground.wiring import Models
from hvt_study.cache.results import CachedDetector
from hvt_study.datasets.sequence import NOMINAL_FPS, Clip, FrameSource
from hvt_study.flights import flight_link
from hvt_study.flights.flight_ground import GroundSide, InlineExecutor
from hvt_study.metrics.observed import ObservedFrame

_SESSION = 1 << 31  # as many bytes on the wire as a random one


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
    """The cost of a flight, and its lists."""

    lists: tuple[ObservedFrame, ...]
    """The ground's list at every frame, source pixels."""
    account: LedgerSummary
    line_bytes: Mapping[str, int]
    """By row of the key table: payload, attachment and transport."""
    messages: Mapping[str, int]
    max_frame_bytes: int
    link: flight_link.LinkReport
    """Its delays are those of the base stream, from capture to arrival."""
    picture_age_p95_ms: float
    """How old the newest picture at the ground is, seen at every frame."""
    edge_cpu_ms: float
    """CPU of the edge's stages a frame, whatever the number of cores."""
    digest: str
    """Digest of all payloads: two flights that sent the same have the same."""
    back_bytes: int = 0
    """Line bytes from the ground to the edge: reports on stills. The questions of a server are in ``line_bytes``."""

    @property
    def duration_s(self) -> float:
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


def picture_age_p95_ms(shown_ns: Sequence[tuple[int, int]], frames: int) -> float:
    """Age of the newest of the pictures, (arrival, capture), at each of ``frames`` from the first picture on.

    NaN where none came in time.
    """
    shown = np.array(shown_ns, np.int64).reshape(-1, 2)
    at_ns = np.array([flight_link.frame_ns(frame_index) for frame_index in range(frames)], np.int64)
    at_ns = at_ns[at_ns >= shown[0, 0]] if len(shown) else at_ns[:0]
    newest = shown[np.searchsorted(shown[:, 0], at_ns, side="right") - 1, 1]
    return float(np.percentile((at_ns - newest) / 1e6, 95)) if len(at_ns) else math.nan


def fly(plan: FlightPlan, *, detector: Detector, models: Models) -> FlightReport:
    """Fly once; ``detector`` serves the edge, ``models`` the ground.

    Raises `UserError` where the edge refuses its settings.
    """
    saved_s = detector.saved_cpu_s if isinstance(detector, CachedDetector) else 0.0
    flight = Flight(
        plan,
        detector=detector,
        make_ground=lambda info, link: GroundSide(info, config=plan.ground, models=models, link=link),
    )
    flight.run()
    if isinstance(detector, CachedDetector):
        saved_s = detector.saved_cpu_s - saved_s
    return flight.report(saved_cpu_s=saved_s)


def dry_run(plan: FlightPlan, *, detector: Detector) -> float:
    """Fly without a ground; return the line bits a second, headers and transport included.

    Where no answer of a ground matters (methods without stills), `fly` spends the same to the bit. Raises
    `UserError` where the edge refuses its settings.
    """
    flight = Flight(plan, detector=detector, make_ground=lambda _info, link: _NoGround(link))
    flight.run()
    return flight.line_bytes * 8 / (plan.clip.frame_count / NOMINAL_FPS)


class _SteppedSource(FrameSource):
    """A clip with the ground in step: after each frame, arrived messages are taken in."""

    def __init__(self, flight: Flight, resizer: Resizer, *, frames: frozenset[int]) -> None:
        super().__init__(flight.plan.clip, resizer, frames=frames)
        self._flight = flight

    def frames(self, *, start_ns: int) -> Iterator[Frame]:
        if self._flight.ground is None:  # the edge tries the scene before it begins
            yield from super().frames(start_ns=start_ns)
            return
        for frame in super().frames(start_ns=start_ns):
            began_s = self._flight.before_frame(frame)
            yield frame
            self._flight.after_frame(frame, began_s=began_s)


class _FlightWorld(World):
    """A clip of frames, a simulated link, a detector that is open already, and media time alone."""

    def __init__(self, flight: Flight, detector: Detector) -> None:
        super().__init__()
        self._flight = flight
        self._detector = detector
        self.session_id = _SESSION
        self.clock = flight_link.MediaClock()
        self.inbox = flight.inbox
        self.executor = InlineExecutor()

    def open_detector(self, config: EdgeConfig) -> Detector:
        return tiled(self._detector, config.tiles) if config.candidates == "source" else self._detector

    def warm_up(self, *_: Any) -> None:
        """It is open already."""

    def open_source(self, config: EdgeConfig) -> FrameSource:
        clip = self._flight.plan.clip
        # With --fps auto the edge sees every frame, and leaves out frames by itself.
        fps = NOMINAL_FPS if isinstance(config.fps, str) else config.fps
        resizer = Resizer(clip.source_size, base_size(config), fit=cast("Fit", config.fit))
        return _SteppedSource(self._flight, resizer, frames=coded_frames(clip.frame_count, fps))

    def open_link(self, stack: ExitStack, config: EdgeConfig) -> EdgeLink:  # noqa: ARG002
        return self._flight.outlet


class Flight:
    """The edge's own app over a clip and a simulated link; ``make_ground`` makes its other end."""

    def __init__(
        self,
        plan: FlightPlan,
        *,
        detector: Detector,
        make_ground: Callable[[Info, flight_link.SerialLink[Received]], Any],
    ) -> None:
        self.plan = plan
        self.inbox = flight_link.FlightInbox()
        self._link: flight_link.SerialLink[Received] = flight_link.SerialLink(rate_bps=plan.link_bps)
        self._make_ground = make_ground
        self.outlet = flight_link.FlightOutlet(
            self._link, edge_id=plan.edge.edge_id, on_listen=self._open_ground
        )
        self._edge = Edge(
            replace(plan.edge, quiet=True), stop=threading.Event(), world=_FlightWorld(self, detector)
        )
        self._next_frame = 0
        self._cpu_s = 0.0
        self.ground: Any = None
        """From the moment at which the edge answers grounds."""

    def run(self) -> None:
        """Fly to the end of the clip; `UserError` where the edge refuses its settings."""
        self._edge.run()
        self._pass_over(self.plan.clip.frame_count)
        self.ground.close()

    @property
    def line_bytes(self) -> int:
        """All that left, with headers and transport."""
        return sum(self.outlet.line_bytes.values())

    def report(self, *, saved_cpu_s: float) -> FlightReport:
        frames, outlet = self.plan.clip.frame_count, self.outlet
        return FlightReport(
            lists=tuple(self.ground.lists[frame_index] for frame_index in range(frames)),
            account=self._edge.ledger.summary(frames / NOMINAL_FPS),
            line_bytes=dict(outlet.line_bytes),
            messages=dict(outlet.messages),
            max_frame_bytes=outlet.max_frame_bytes,
            link=flight_link.LinkReport.of(self.ground.base_delays_ns, self.ground.arrivals),
            picture_age_p95_ms=picture_age_p95_ms(self.ground.shown_ns, frames),
            edge_cpu_ms=1e3 * (self._cpu_s + saved_cpu_s) / frames,
            digest=outlet.digest,
            back_bytes=self.ground.back_bytes,
        )

    def before_frame(self, frame: Frame) -> float:
        """The edge is about to take this frame; return its CPU time so far."""
        self.inbox.now_ns = frame.capture_ns
        return time.process_time()

    def after_frame(self, frame: Frame, *, began_s: float) -> None:
        """The edge has done with this frame: the ground takes in arrived messages."""
        self._cpu_s += time.process_time() - began_s
        self._pass_over(frame.index)
        if self.outlet.last_frame != frame.index:
            self.ground.pass_over(frame.index, capture_ns=frame.capture_ns)
        self._next_frame = frame.index + 1
        self.ground.advance(frame.capture_ns)
        self.inbox.due += self.ground.results
        self.inbox.due_detected += self.ground.detected
        self.ground.results.clear()
        self.ground.detected.clear()

    def _open_ground(self, answer: bytes) -> None:
        info = replace(Info.parse(answer), fps=NOMINAL_FPS, started_ns=flight_link.START_NS)
        self.ground = self._make_ground(info, self._link)

    def _pass_over(self, until_frame: int) -> None:
        """The source did not give the frames before this one."""
        for frame_index in range(self._next_frame, until_frame):
            self.ground.pass_over(frame_index, capture_ns=flight_link.frame_ns(frame_index))
        self._next_frame = max(self._next_frame, until_frame)


class _NoGround:
    """A ground that takes all messages and analyzes nothing."""

    def __init__(self, link: flight_link.SerialLink[Received]) -> None:
        self._link = link
        self.results: deque[tuple[int, StillResult]] = deque()
        self.detected: deque[tuple[int, Detected]] = deque()

    def pass_over(self, frame_index: int, *, capture_ns: int) -> None:
        """Nothing is listed."""

    def advance(self, now_ns: int | None) -> None:
        self._link.arrived(now_ns)

    def close(self) -> None:
        """Nothing is open."""
