"""Live video in simulated time: an edge's own parts from its settings, a link with a queue, a ground that reports.

The parts are the real ones, built as `hvt_edge.wiring` builds them: budget, pacer, transmitter, reconfiguration,
frame decimation, base stage and link control. Simulated are the link, the ground and, unless there are pictures, x265
(its sizes).
"""

import heapq
import itertools
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import numpy as np

from hvt_codecs.passthrough.camera import Camera
from hvt_codecs.passthrough.stream import CameraStream, SeenUnit
from hvt_common.protocol.channels import Channel
from hvt_common.protocol.ledger import Ledger
from hvt_common.protocol.messages import BaseHeader
from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS
from hvt_common.values import AccessUnit, CameraUnit, Frame, Image
from hvt_edge.backlog.disk import Store
from hvt_edge.backlog.stage import BacklogStage
from hvt_edge.config import EdgeConfig, check, check_rate
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.loop.realtime import LinkControl
from hvt_edge.operating import Keyframes, KeyframeSettings, Rates
from hvt_edge.stills.maker import StillMaker
from hvt_edge.stills.outbox import Outbox
from hvt_edge.stills.stage import StillSender
from hvt_edge.video.encoder import Encoder, encoder_settings, keyframe_floor_bytes, minimum_bps
from hvt_edge.video.reconfigure import OpenEncoder, encoder_opener
from hvt_edge.video.stage import Action
from hvt_edge.wiring.link import make_budget, make_pacer
from hvt_edge.wiring.video import encoder_plan, first_decimation, first_rates, make_encoder, make_frame_skip
from rigs.kept import INFO
from rigs.messages import feedback
from rigs.world import make_base_stage, make_operating, make_reconfiguration, make_transmitter

_REPORT_NS, _IDLE_REPORT_NS = SECOND_NS // 8, SECOND_NS // 2
_PIXELS = np.zeros((8, 8, 3), np.uint8)
_START_NS = 1_790_000_000 * SECOND_NS
_CAMERA_SIZE = (1280, 720)


@dataclass
class SteppedLink:
    """A link of pieces, (from second, bits a second), with a queue before it.

    With ``loses`` it loses what is sent while it carries nothing; else that waits. ``cross`` is what another one
    sends into the same queue, (from second, to second, bits a second).
    """

    steps: Sequence[tuple[float, float]]
    loses: bool = False
    cross: tuple[float, float, float] = (0.0, 0.0, 0.0)
    _free_ns: int = 0
    _seen_ns: int = 0

    def bps(self, second: float) -> float:
        at_ns = round(second * SECOND_NS)
        return next(rate for begin, rate in reversed(self.steps) if at_ns >= round(begin * SECOND_NS))

    def carry(self, size_bytes: int, *, at_ns: int) -> int | None:
        """When the last bit of it has left; None where it is lost. Nanoseconds since the start."""
        begin, end, cross_bps = self.cross
        since_ns, self._seen_ns = max(self._seen_ns, round(begin * SECOND_NS)), at_ns
        if (since_s := min(end, at_ns / SECOND_NS) - since_ns / SECOND_NS) > 0:
            self.carry(round(cross_bps * since_s / 8), at_ns=since_ns)
            self._seen_ns = at_ns
        if self.loses and not self.bps(at_ns / SECOND_NS):
            return None
        now_ns, bits = max(self._free_ns, at_ns), 8.0 * size_bytes
        ends_ns = [at_ns for begin, _ in self.steps if (at_ns := round(begin * SECOND_NS)) > now_ns]
        for end_ns in [*ends_ns, None]:
            rate = self.bps(now_ns / SECOND_NS)
            if end_ns is None or (rate and bits * SECOND_NS / rate <= end_ns - now_ns):
                assert rate, "a link that ends away carries nothing any more"
                self._free_ns = now_ns + round(bits * SECOND_NS / rate)
                return self._free_ns
            bits, now_ns = bits - rate * (end_ns - now_ns) / SECOND_NS, end_ns
        raise AssertionError


@dataclass
class _Encoder:
    """Sizes as x265 gives them: what rate and VBV allow, and ``texture`` of a textured picture's least."""

    size: tuple[int, int]
    fps: float
    bitrate_bps: float
    vbv_s: float
    texture: float
    chance: random.Random
    mean_qp: float = 35.0

    def encode(self, frame: Frame, *, keyframe: bool = False, regions: Sequence[Any] = ()) -> AccessUnit:
        mean = self.bitrate_bps / 8 / self.fps
        if keyframe:
            least = self.texture * keyframe_floor_bytes(self.size)
            wanted = min(8 * mean, 0.9 * self.vbv_s * self.bitrate_bps / 8)
        else:
            least = self.texture * minimum_bps(self.size, self.fps) / 8 / self.fps
            wanted = min(
                0.95 * mean * self.chance.uniform(0.75, 1.25), 0.9 * self.vbv_s * self.bitrate_bps / 8
            )
        return AccessUnit(frame.index, frame.capture_ns, bytes(max(20, round(max(least, wanted)))), keyframe)


@dataclass
class _Ground:
    """What has arrived, and what can be shown of it."""

    last: int = -1
    held_since_ns: int = 0
    messages: int = 0
    lost: int = 0
    whole: bool = False
    shown: list[tuple[float, float]] = field(default_factory=list)
    """(second of arrival, second of capture) of each frame that builds on what was shown before."""
    news: bool = False
    number: int = 0
    asked_ns: int = -(10**18)

    def take(self, header: BaseHeader, *, now_ns: int) -> None:
        if header.sequence <= self.last:
            return
        gap = header.sequence - self.last - 1
        self.lost += gap if self.messages else 0
        self.messages += 1
        self.last, self.held_since_ns, self.news = header.sequence, now_ns, True
        self.whole = header.keyframe or (self.whole and not gap)
        if self.whole:
            self.shown.append((now_ns / SECOND_NS, (header.capture_ns - _START_NS) / SECOND_NS))


class LiveFlight:
    """One flight. Seconds count from its first frame.

    ``late_s(second)`` is how much later a report comes that is made then, None: not at all. ``way_s(second)`` is how
    long a message is under way, ``ahead_s(second)`` how far ahead the ground's clock. ``joins_s`` is when the ground
    comes. ``commands`` are ``(second, budget)``. ``store`` is a folder for what is stored while the link is
    away. To code a frame takes about ``coding_s``, a keyframe ``keyframe_times`` as long. The real x265 codes
    ``pictures``, one after the other, for ever. ``camera`` are units that are passed through, of a camera that took
    ``surveyed`` when the flight began.
    """

    def __init__(
        self,
        link: SteppedLink,
        *,
        late_s: Callable[[float], float | None] = lambda _second: 0.0,
        way_s: Callable[[float], float] = lambda _second: 0.02,
        ahead_s: Callable[[float], float] = lambda _second: 0.0,
        joins_s: float = 0.0,
        commands: Sequence[tuple[float, int]] = (),
        store: Path | None = None,
        texture: float = 1.0,
        track_bytes: int = 250,
        pose_bytes: int = 60,
        coding_s: float = 0.0,
        keyframe_times: float = 1.0,
        keyframe_s: float = 60.0,
        pictures: Sequence[Image] = (),
        camera: Sequence[CameraUnit] = (),
        surveyed: Sequence[CameraUnit] = (),
        loss: float = 0.0,
        seed: int = 0,
        **settings: Any,
    ) -> None:
        self.config = config = check(EdgeConfig(**{"source": "demo"} | settings))
        size = config.fixed_size or _CAMERA_SIZE
        if not camera:
            check_rate(config, size)
        self.camera = camera
        self.link, self.loss, self.late_s, self.joins_s = link, loss, late_s, joins_s
        self.way_s, self.ahead_s = way_s, ahead_s
        self.commands, self.pictures = list(commands), pictures or [_PIXELS]
        self.coding_s, self.keyframe_times, self.held = coding_s, keyframe_times, 0
        self.track_bytes, self.pose_bytes = track_bytes, pose_bytes
        self.chance, self.texture = random.Random(seed), texture
        self.now_ns = _START_NS
        self.ground, self.ledger = _Ground(), Ledger(window_ns=config.window_ns)
        self.sent: list[float] = []
        """Seconds at which an access unit went out."""
        self.rates: list[tuple[float, int]] = []
        self.opened: list[float] = []
        """Seconds at which an encoder was opened."""
        self._left: list[tuple[float, float, int]] = []
        """(second at which a message was sent, second at which it had left, its bytes)."""
        self.surveyed = None
        if camera:
            fps = config.nominal_fps
            seen = (SeenUnit(n / fps, len(one.data), one.keyframe) for n, one in enumerate(surveyed))
            source: Any = SimpleNamespace(camera_stream=CameraStream(tuple(seen), fps))
            self.surveyed = Camera(config, source)
            keyframe_s = 0
        every_s = None if self.surveyed is None else self.surveyed.keyframe_s
        self.keyframes = Keyframes(
            KeyframeSettings(interval_ns=round(keyframe_s * SECOND_NS), camera_every_s=every_s)
        )
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._count = itertools.count()
        self._in_loop = False
        self._build(size, store)

    def _build(self, size: tuple[int, int], store: Path | None) -> None:
        config = self.config
        decimation = 1 if self.camera else first_decimation(config, size)
        self.operating = make_operating(config, decimation=decimation)
        self.pacer = make_pacer(config, self.surveyed, size)
        outbox = Outbox()
        self.failures = Failures(self._clock)
        self.transmitter = make_transmitter(
            self,
            ledger=self.ledger,
            budget=make_budget(config, base_bps=config.base_bps, decimation=decimation),
            wait_until=self._wait_until,
            pacer=self.pacer,
        )
        open_encoder: OpenEncoder = partial(self._opened, size)
        if self.camera:
            open_encoder = encoder_opener(encoder_plan(config, size), self.operating)
        encoder = open_encoder(first_rates(config, decimation))
        reconfiguration = make_reconfiguration(
            self.operating, config, size, self.transmitter, open_encoder=open_encoder, pacer=self.pacer
        )
        self.backlog = None
        if store is not None:
            self.backlog = BacklogStage(
                Store(store, max_bytes=50_000_000, session_id=1, info=INFO.pack),
                self.transmitter,
                live=True,
                has_subscriber=lambda: False,  # so that no thread sends chunks at times of its own
                stills_pending=lambda: False,
                stills_in_flight=lambda: 0,
                keyframes=self.keyframes,
                clock=self._clock,
                failures=self.failures,
            )
        self.link_control = LinkControl(
            has_ground=lambda: self.second >= self.joins_s,
            has_subscriber=lambda: False,
            keyframes=self.keyframes,
            inbox=FeedbackInbox(),
            reconfiguration=reconfiguration,
            clock=self._clock,
            stills=StillSender(
                outbox, maker=StillMaker(), transmitter=self.transmitter, backlog=self.backlog
            ),
            failures=self.failures,
        )
        self.stage: Any
        if self.surveyed is not None:
            self.stage = self.surveyed.make_stage(
                encoder,
                reconfiguration,
                keyframes=self.keyframes,
                transmitter=self.transmitter,
                failures=self.failures,
                admits=self.link_control.admits,
                pause=self._pause,
            )
            return
        self.stage = make_base_stage(
            encoder,
            self.transmitter,
            keyframes=self.keyframes,
            first_keyframe_bytes=config.base_bps // 40,
            frame_skip=make_frame_skip(
                config, decimation, size=size, least_decimation=reconfiguration.least_decimation
            ),
            reconfigure=reconfiguration,
            keyframe_bytes=reconfiguration.keyframe_bytes,
            admits=self.link_control.admits,
            holder=self.link_control.holder,
            backlog=self.backlog,
            failures=self.failures,
        )

    @property
    def second(self) -> float:
        return (self.now_ns - _START_NS) / SECOND_NS

    @property
    def _way_ns(self) -> int:
        return round(self.way_s(self.second) * SECOND_NS)

    def _clock(self) -> int:
        return self.now_ns

    def _opened(self, size: tuple[int, int], rates: Rates) -> Encoder:
        config = self.config
        self.opened.append(self.second)
        if self.pictures[0] is not _PIXELS:
            return make_encoder(config, rates, size=size, preset="ultrafast")
        asked = encoder_settings(
            size=size,
            fps=config.nominal_fps / rates.decimation,
            preset=config.preset,
            total_bps=max(rates.total_bps - config.metadata_bps, rates.base_bps),
            base_bps=rates.base_bps,
            edge_id=config.edge_id,
            window_s=config.window,
        )
        return _Encoder(size, asked.fps, asked.bitrate_bps, asked.vbv_s, self.texture, self.chance)

    # What goes out

    def put(
        self, channel: Channel, payload: bytes, *, attachment: bytes | None = None, encoding: str = ""
    ) -> None:
        if self.second < self.joins_s:
            return
        size_bytes = len(payload) + len(attachment or b"") + 60
        left_ns = self.link.carry(size_bytes, at_ns=self.now_ns - _START_NS)
        if left_ns is not None:
            self._left.append((self.second, left_ns / SECOND_NS, size_bytes))
        if channel is not Channel.BASE:
            return
        self.sent.append(self.second)
        if left_ns is None or self.chance.random() < self.loss:
            return
        header = BaseHeader.parse(attachment or b"", payload)
        at_ns = _START_NS + left_ns + self._way_ns
        self._at(at_ns, lambda: self.ground.take(header, now_ns=at_ns - _START_NS))

    def _wait_until(self, at_ns: int) -> None:
        if self._in_loop and at_ns > self.now_ns:
            self._pass(at_ns)

    # Time

    def _pause(self, pause_ns: int) -> int:
        self._pass(self.now_ns + max(0, pause_ns))
        return self.now_ns

    def _at(self, at_ns: int, call: Callable[[], None]) -> None:
        heapq.heappush(self._events, (at_ns, next(self._count), call))

    def _pass(self, until_ns: int) -> None:
        while self._events and self._events[0][0] <= until_ns:
            at_ns, _, call = heapq.heappop(self._events)
            self.now_ns = max(self.now_ns, at_ns)
            call()
        self.now_ns = max(self.now_ns, until_ns)

    def _each(self, period_ns: int, call: Callable[[], object], *, first_ns: int = 0) -> None:
        def turn(at_ns: int) -> None:
            call()
            self._at(at_ns + period_ns, lambda: turn(at_ns + period_ns))

        self._at(_START_NS + first_ns, lambda: turn(_START_NS + first_ns))

    def fly(self, seconds: float) -> Self:
        sender = self.transmitter
        if self.track_bytes:
            self._each(
                SECOND_NS // 3,
                lambda: sender.metadata(
                    Channel.TRACKS, lambda _: bytes(self.track_bytes), now_ns=self.now_ns
                ),
            )
        if self.pose_bytes:
            self._each(
                SECOND_NS,
                lambda: sender.metadata(Channel.POSE, lambda _: bytes(self.pose_bytes), now_ns=self.now_ns),
            )
        self._each(_REPORT_NS, self._report)
        status_ns = _START_NS
        for bps, second in ((bps, second) for second, bps in self.commands):
            self._at(_START_NS + round(second * SECOND_NS), lambda bps=bps: self._command(bps))  # type: ignore[misc]
        try:
            for index in range(round(seconds * self.config.nominal_fps)):
                taken_ns = _START_NS + round(index * SECOND_NS / self.config.nominal_fps)
                if not self.camera and taken_ns < self.now_ns - SECOND_NS / self.config.nominal_fps:
                    continue  # the loop was held up: a camera's frames are gone, its units wait
                self._pass(taken_ns)
                picture = self.pictures[index % len(self.pictures)]
                unit = self.camera[index] if self.camera else None
                self._frame(Frame(index, taken_ns, picture, picture, camera_unit=unit))
                if self.now_ns >= status_ns:
                    status_ns = self.now_ns + SECOND_NS
                    self._status()
        finally:
            if self.backlog is not None:
                self.backlog.close()
        return self

    def _frame(self, frame: Frame) -> None:
        self._in_loop = True
        self.link_control.before_frame(self.now_ns)
        decision = self.stage.decide(frame, now_ns=self.now_ns)
        self.held += decision.action is Action.HOLD
        unit = self.stage.encode(frame, decision, now_ns=self.now_ns)
        if unit is not None:
            coding_s = self.coding_s * (self.keyframe_times if unit.keyframe else 1)
            self._pass(self.now_ns + round(coding_s * self.chance.uniform(0.7, 1.3) * SECOND_NS))
            self.stage.send(unit, decision, now_ns=self.now_ns)
        self._in_loop = False
        if self.pacer is not None:
            self.rates.append((self.second, self.pacer.rate_bps))

    def _status(self) -> None:
        self.transmitter.metadata(Channel.STATUS, lambda _: bytes(330), now_ns=self.now_ns)

    def _command(self, budget_bps: int) -> None:
        self.operating.set(budget_bps=budget_bps)
        self.keyframes.require(self.now_ns)

    # What comes back

    def _report(self) -> None:
        ground, second = self.ground, self.second
        if second < self.joins_s or not self.link.bps(second):
            return
        if not ground.news and self.now_ns - ground.asked_ns < _IDLE_REPORT_NS:
            return
        ground.news, ground.asked_ns = False, self.now_ns
        ground.number += 1
        said = feedback(
            session_id=1,
            receiver_id=1,
            sequence=ground.number,
            send_ns=self.now_ns + round(self.ahead_s(second) * SECOND_NS),
            base_messages=ground.messages,
            lost=ground.lost,
            base_sequence=ground.last,
            base_held_us=max(0, self.now_ns - _START_NS - ground.held_since_ns) // 1000,
            still_sequence=-1,
            missing_stills=(),
            backlog=(),
        )
        late_s = self.late_s(second)
        if late_s is None:
            return
        at_ns = self.now_ns + self._way_ns + round(late_s * SECOND_NS)
        wants = ground.messages > 0 and not ground.whole
        self._at(at_ns, lambda: self._on_report(said, wants=wants))

    def _on_report(self, said: Any, *, wants: bool) -> None:
        self.link_control.on_feedback(said)
        if wants:
            self.keyframes.request(self.now_ns)

    # What came of it

    def drained(self, second: float) -> float:
        """The second at which the link had carried what was sent before this one."""
        return max((left for sent, left, _ in self._left if sent < second), default=second)

    def carried_bps(self, begin: float, end: float) -> float:
        return 8 * sum(size for _, left, size in self._left if begin <= left < end) / (end - begin)

    def rate_between(self, begin: float, end: float) -> list[int]:
        return [rate for second, rate in self.rates if begin <= second < end]

    def delays_between(self, begin: float, end: float) -> list[float]:
        """How old what came then was, of what could be shown; seconds."""
        return [at - taken for at, taken in self.ground.shown if begin <= at < end]

    def longest_hole(self, begin: float, end: float) -> float:
        """The longest time without a frame that was shown, within these seconds."""
        times = [begin, *(at for at, _ in self.ground.shown if begin < at < end), end]
        return max(after - before for before, after in itertools.pairwise(times))

    def back_after(self, second: float) -> float:
        """How long after this second the ground shows a frame that was taken after it."""
        return min((at - second for at, taken in self.ground.shown if taken >= second), default=float("inf"))
