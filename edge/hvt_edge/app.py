"""The edge's story: source, stages, link; then one frame after the other until the source ends."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from typing import Any

from hvt_common.errors import FlightError, UserError
from hvt_common.inference.detect import FailingDetector
from hvt_common.inference.retried import RetriedDetector
from hvt_common.protocol.channels import Channel
from hvt_common.protocol.ledger import Account, Ledger
from hvt_common.runtime.failures import Awaited
from hvt_common.runtime.log import START_LOGGER
from hvt_common.runtime.plug_ins import health_server
from hvt_common.runtime.process import give_back_holes, notify_systemd, with_lower_priority
from hvt_common.runtime.reporting import StatusLine
from hvt_common.transport.zenoh_config import configure
from hvt_common.units import SECOND_NS
from hvt_common.values import Frame
from hvt_edge.config import EdgeConfig, check_rate
from hvt_edge.link.publisher import EdgeLink
from hvt_edge.loop.counts import FrameCounts
from hvt_edge.loop.lockstep import LockstepPace
from hvt_edge.loop.realtime import RealtimePace, wait_for_ground
from hvt_edge.operating import LoopClock
from hvt_edge.report.state import Heartbeat, lacks
from hvt_edge.report.status import status_text, summary
from hvt_edge.source.contract import DrawnSource, Source
from hvt_edge.source.live import SOURCE_PART
from hvt_edge.wiring import (
    Flight,
    Stages,
    check_codecs,
    check_files,
    check_store,
    make_link_settings,
    open_for_flight,
    qualify_encoder,
    say_size,
    surveyed,
    try_scene,
    unopened,
)
from hvt_edge.world import World

_PART = "flight"
_GOODBYE_S = 1.5
_STUCK_S = 5.0
"""A loop that has not turned for this long, and two frames longer, hangs."""


class Edge:
    """One run of one edge: build it, `run` it once.

    ``on_started()`` is called once all checks have passed; ``world`` supplies frames and carries messages
    away.
    """

    def __init__(
        self,
        config: EdgeConfig,
        *,
        stop: threading.Event,
        on_started: Callable[[], None] = lambda: None,
        world: World | None = None,
    ) -> None:
        self._config = config
        self._stop = stop
        self._on_started = on_started
        self._world = world or World()
        self._lockstep = config.pace == "lockstep"
        self._loop_clock = LoopClock(self._world.clock, lockstep=self._lockstep, wait=stop.wait)
        self._counts = FrameCounts()
        self._failures = self._world.failures
        self._heartbeat: Heartbeat | None = None
        """None before the parts are built."""
        self._reached = False
        """Whether any program has subscribed to the video."""
        self.ledger = Ledger(window_ns=config.window_ns)

    def run(self) -> dict[str, Any]:
        """Play the source to its end or until ``stop`` is set; return the summary.

        Raises `UserError` before anything is sent, where a setting, a file or a port cannot be used, and
        `FlightError` with the summary after that.
        """
        config, world = self._config, self._world
        check_files(config)
        configure(make_link_settings(config))  # a wrong endpoint is said before models are open
        check_codecs(config)
        with ExitStack() as stack:
            if config.metrics is not None:
                stack.enter_context(self._health_server(config.metrics))
            source = stack.enter_context(self._source_when_there())
            for note in source.notes:
                logging.getLogger(START_LOGGER).info("source: %s", note)
            config, camera = surveyed(config, source)
            self._config = config
            pose_source = world.open_pose(config, source)
            if pose_source is not None:
                stack.callback(pose_source.close)
                for note in pose_source.notes:
                    logging.getLogger(START_LOGGER).info("pose: %s", note)
            if config.truth is not None and not isinstance(source, DrawnSource):
                raise UserError(
                    f"--truth {config.truth} is for --source demo: no other source knows its truth"
                )
            check_store(config, live=source.live)
            check_rate(config, source.view.base_size)
            say_size(config, source.view)
            headroom = qualify_encoder(config, source, camera, clock=world.clock, stop=self._stop)
            detector = self._open_detector(config, source)
            beginning = try_scene(config, source, detector=detector, clock=world.clock, stop=self._stop)
            line = stack.enter_context(StatusLine(quiet=config.quiet, as_json=config.log_format == "json"))
            link = world.open_link(stack, config)
            flight = Flight(
                stack=stack,
                config=config,
                source=source,
                detector=detector,
                ends=link,
                session_id=world.session_id,
                ledger=self.ledger,
                counts=self._counts,
                inbox=world.inbox,
                failures=self._failures,
                clock=world.clock,
                loop_clock=self._loop_clock,
                beginning=beginning,
                headroom=headroom,
                camera=camera,
            )
            stages = Stages(flight, pose_source=pose_source)
            self._heartbeat = stages.heartbeat
            link.listen(stages.answers)
            self._on_started()
            notify_systemd("READY=1")
            if not source.live:
                wait_for_ground(
                    link.has_ground,
                    edge_id=config.edge_id,
                    wait_s=config.wait,
                    stop=self._stop,
                    note=line.note,
                    turn=lambda: stages.heartbeat.turn("waiting"),
                )
            stages.link.operating.set(started_ns=world.clock())
            broken: Exception | None = None
            try:
                self._play(source, stages, link, line)
            except (UserError, FlightError) as error:
                if not self._counts.encoded:
                    raise
                broken = error
                self._failures.failed(_PART, str(error), said=True)
            finally:
                stages.stills.chooser.close()
                self._say_goodbye(stages, link)
        if broken is not None:
            raise FlightError(str(broken), summary=self._summary(stages.heartbeat)) from broken
        return self._summary(stages.heartbeat)

    def in_hand(self) -> frozenset[tuple[str, int]]:
        """As of `Failures`; for another thread."""
        return self._failures.in_hand()

    def given_up(self) -> FlightError:
        """The end of a run that hangs after ``stop`` was set; for another thread."""
        reason = self._failures.hanging
        self._failures.failed(_PART, reason, said=True)
        return FlightError(reason, summary=self._heartbeat and self._summary(self._heartbeat))

    def _summary(self, heartbeat: Heartbeat) -> dict[str, Any]:
        unreached = "" if self._reached else heartbeat.link.trouble or "nobody subscribed to its video"
        return summary(heartbeat, unreached=unreached)

    def _play(self, source: Source, stages: Stages, link: EdgeLink, line: StatusLine) -> None:
        next_status_ns = restarts = 0
        heartbeat = stages.heartbeat
        self._counts.begin(source)
        with self._make_pace(source, stages, link) as pace:
            for frame in pace.steps(source.steps(start_ns=stages.link.operating.now.started_ns)):
                if self._stop.is_set():
                    break
                stages.status.send_pending()
                if source.restarts != restarts:  # another picture than the last
                    restarts, self._counts.resumed_ns = source.restarts, self._world.clock()
                    stages.link.keyframes.require(self._loop_clock())
                if frame is not None:
                    self._counts.newest_came_ns = self._world.clock()
                pace.step(frame, missed=source.missed)
                self._counts.note_source(source)
                self._step_pose(stages, frame)
                del frame  # 9 MB at 1080p, while the next is read
                now_ns = self._loop_clock()
                if now_ns >= next_status_ns:
                    next_status_ns = now_ns + SECOND_NS
                    give_back_holes()
                    stages.stills.note_load(self._counts.cpu.now.taken, now_ns=now_ns)
                    stages.status.send("running")
                    self._reached |= link.has_subscriber(Channel.BASE)
                    if heartbeat.state is not None:
                        line.show(status_text(heartbeat.state, paused_s=self._counts.slow_ns / SECOND_NS))
                    more_frames = stages.base.wants_keyframe(self._counts.last_index)
                    if more_frames or stages.link.reconfiguration.wants_keyframe(now_ns):
                        stages.link.keyframes.require(now_ns)
                heartbeat.turn("running")  # in lockstep a second of the stream may take longer
        if not source.live:
            stages.link_control.finish(
                stop=self._stop, note=line.note, turn=lambda: heartbeat.turn("running")
            )

    def _step_pose(self, stages: Stages, frame: Frame | None) -> None:
        # A slow machine plays a clip longer, and its poses come later.
        if stages.pose is None or frame is None:
            return
        stages.pose.step(
            frame.capture_ns - stages.link.operating.now.started_ns,
            capture_ns=frame.capture_ns + self._counts.paused_ns,
            now_ns=self._loop_clock(),
        )

    def _make_pace(self, source: Source, stages: Stages, link: EdgeLink) -> LockstepPace | RealtimePace:
        if self._lockstep:
            return LockstepPace(
                stages.base,
                stages.stills,
                inbox=self._world.inbox,
                keyframes=stages.link.keyframes,
                clock=self._loop_clock,
                fps=source.fps,
                counts=self._counts,
                has_ground=link.has_ground,
                stop=self._stop,
                executor=self._world.executor,
                has_viewer=partial(link.has_subscriber, Channel.BASE),
            )
        return RealtimePace(
            stages.base,
            stages.stills,
            inbox=self._world.inbox,
            clock=self._world.clock,
            fps=source.fps,
            live=source.live,
            counts=self._counts,
            stop=self._stop,
            failures=self._failures,
            before_frame=stages.link_control.before_frame,
            has_viewer=partial(link.has_subscriber, Channel.BASE),
        )

    def _source_when_there(self) -> Source:
        # Wait for a camera that starts after us; `FlightError` where we are stopped before.
        awaited = Awaited(partial(self._world.open_source, self._config), SOURCE_PART, self._failures)
        source = awaited.wait(self._stop)
        if source is None:
            raise FlightError(f"stopped before the source was there: {awaited.error}")
        return source

    def _open_detector(self, config: EdgeConfig, source: Source) -> FailingDetector:
        # In real time a detector that fails is opened anew.
        world = self._world
        opened = partial(
            open_for_flight,
            config,
            lambda: world.open_detector(config),
            lambda detector: world.warm_up(config, detector, source),
        )
        if self._lockstep:  # a detector opened anew would give another result
            return opened()
        first = with_lower_priority(opened, stop=self._stop)
        if first is None:  # stopped before it is open
            return unopened(config, lambda: world.open_detector(config))
        # A failed detector is not kept beside the one opened in its place: each holds 100 MB.
        ready = [first]
        return RetriedDetector(
            lambda: ready.pop() if ready else world.open_detector(config),
            "detector",
            self._failures,
            clock=world.clock,
        )

    def _health_server(self, address: str) -> AbstractContextManager[object]:
        return health_server(
            "edge",
            address,
            lambda: None if self._heartbeat is None else self._heartbeat.state,
            clock=self._world.clock,
            stuck_s=_STUCK_S + 2 / self._config.nominal_fps,
            failures=self._failures,
            lacks=lacks,
        )

    def _say_goodbye(self, stages: Stages, link: EdgeLink) -> None:
        transmitter = stages.link.transmitter
        if stages.backlog is not None:
            stages.backlog.worker.send_no_more()  # the last report gives the totals
        stages.status.send("ended")
        self._reached |= link.has_subscriber(Channel.BASE)
        if link.has_ground():  # messages still in a queue would be lost with the session
            until_ns = self._world.clock() + round(_GOODBYE_S * SECOND_NS)
            self._world.inbox.wait_for_end(
                base=self.ledger.messages(Account.BASE),
                roi=transmitter.still_sequence + 1,
                frame_index=self._counts.last_index,
                still_sequence=transmitter.still_sequence,
                timeout_s=_GOODBYE_S,
            )
            if stages.backlog is not None:
                left_ns = max(0, until_ns - self._world.clock())
                stages.backlog.wait_for_end(timeout_s=left_ns / SECOND_NS)
