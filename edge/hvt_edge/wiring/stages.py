"""Every part of an edge, built once: `Link`, then `Stills`, then `Video`, each from the parts before it.

`Stages` holds them, and the ends that a ground's messages reach.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import Any

from hvt_common.inference.detect import FailingDetector
from hvt_common.inference.view_trust import ViewTrust, trust_from
from hvt_common.protocol.channels import Channel
from hvt_common.protocol.ledger import Ledger
from hvt_common.protocol.messages import fitted_class_names
from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS
from hvt_edge.backlog.disk import Store
from hvt_edge.backlog.stage import BacklogStage
from hvt_edge.config import EdgeConfig
from hvt_edge.control import Commands
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.link.publisher import Answers, EdgeLink
from hvt_edge.link.stills import StillReaders
from hvt_edge.link.tracks_channel import TrackReporter
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.loop.counts import FrameCounts, processors
from hvt_edge.loop.pose import PoseSource, PoseStage
from hvt_edge.loop.realtime import LinkControl
from hvt_edge.operating import LoopClock, Operating, Rates, base_rate_bps
from hvt_edge.perception.auto import AutoControl
from hvt_edge.perception.candidates import TrackMemory
from hvt_edge.perception.cpu_budget import CpuBudget
from hvt_edge.perception.frame_ring import FrameRing
from hvt_edge.report.state import Heartbeat
from hvt_edge.report.status import InfoReporter, StatusReporter
from hvt_edge.source.contract import DrawnSource, Source
from hvt_edge.stills.on_demand import OnDemand
from hvt_edge.stills.outbox import Outbox
from hvt_edge.stills.scheduler import Chooser, Gate
from hvt_edge.stills.stage import StillSender, StillStage
from hvt_edge.video.rate_model import PresetControl, share_of
from hvt_edge.video.reconfigure import encoder_opener
from hvt_edge.video.stage import BaseStage, LocalCopy
from hvt_edge.video.x265 import TrackRegions
from hvt_edge.wiring.link import auto_settings, channels_of, make_budget, make_pacer, make_split
from hvt_edge.wiring.perception import make_analyzer, make_maker, make_method, make_shadow, make_suppression
from hvt_edge.wiring.storing import open_local_copy, store_folder
from hvt_edge.wiring.trial import Beginning
from hvt_edge.wiring.video import Camera, encoder_plan, make_frame_skip, make_keyframes, make_reconfiguration


@dataclass(frozen=True, slots=True, kw_only=True)
class Flight:
    """The objects from which all parts of one flight are built."""

    stack: ExitStack
    """Closes files and threads at the end."""
    config: EdgeConfig
    source: Source
    detector: FailingDetector
    ends: EdgeLink
    session_id: int
    ledger: Ledger
    counts: FrameCounts
    inbox: FeedbackInbox
    failures: Failures
    clock: Callable[[], int]
    loop_clock: LoopClock
    beginning: Beginning
    headroom: float = 1.0
    """The share of its rate that the encoder is set to (`qualify_encoder`)."""
    camera: Camera | None = None
    """None where an encoder codes the frames."""

    @property
    def lockstep(self) -> bool:
        return self.config.pace == "lockstep"


class Link:
    """The rates, the encoder that is opened for them, budget and pacer, and the transmitter."""

    def __init__(self, flight: Flight) -> None:
        """Raises `UserError` where the encoder refuses the settings."""
        config, beginning, lockstep = flight.config, flight.beginning, flight.lockstep
        size, decimation = flight.source.view.base_size, beginning.decimation
        base_bps = base_rate_bps(config.budget_bps, beginning.share, metadata_bps=config.metadata_bps)
        self.operating = Operating(
            budget_bps=config.budget_bps,
            video_share=config.fixed_share,
            base_bps=base_bps,
            method=config.method,
            decimation=decimation,
            preset=beginning.preset.preset,
            preset_says=beginning.preset.says,
        )
        self.keyframes = make_keyframes(config, flight.camera)
        self.pacer = make_pacer(config, flight.camera, size)
        presets = None
        if config.auto_preset:
            presets = PresetControl(
                self.operating, nominal_fps=config.nominal_fps, most_cores=share_of(processors())
            )
        plan = encoder_plan(config, size, headroom=flight.headroom)
        open_encoder = encoder_opener(plan, self.operating, presets=presets)
        self.encoder = open_encoder(Rates(config.budget_bps, base_bps, decimation))
        budget = make_budget(config, base_bps=base_bps, decimation=decimation)
        self.transmitter = Transmitter(
            flight.ends,
            ledger=flight.ledger,
            budget=budget,
            edge_id=config.edge_id,
            session_id=flight.session_id,
            lockstep=lockstep,
            wait_until=flight.loop_clock.wait_until,
            pacer=self.pacer,
            clock=None if lockstep else flight.loop_clock,
            class_names=fitted_class_names(flight.detector.class_names),
        )
        self.split = make_split(config, size, first_share=beginning.share)
        self.reconfiguration = make_reconfiguration(
            config,
            self.operating,
            size,
            open_encoder=open_encoder,
            budget=budget,
            split=self.split,
            pacer=self.pacer,
            presets=presets,
        )


class Stills:
    """Perception, the parts that choose and code stills, and the store for an outage."""

    def __init__(self, flight: Flight, link: Link) -> None:
        config, view, clock = flight.config, flight.source.view, flight.clock
        class_names, outbox = flight.detector.class_names, Outbox(reports=not flight.lockstep)
        self.readers = StillReaders(clock)
        maker = make_maker(config, readable=self.readers.read)
        on_demand = OnDemand(
            FrameRing(max_bytes=config.ring, max_age_ns=round(config.ring_time * SECOND_NS)),
            outbox=outbox,
            maker=maker,
            view=view,
            class_names=class_names,
            line=link.transmitter,
            offline=lambda: self.backlog is not None and self.backlog.offline,
        )
        chooser = Chooser(
            make_method(config, view),
            suppression=make_suppression(config),
            memory=TrackMemory(padding=config.padding),
            fps=config.nominal_fps,
            most_bytes=link.transmitter.most_still_bytes(),
            gate=Gate(psnr_y_db=config.gate),
            share=config.group_stills,
            from_source=config.candidates == "source",
            on_outcome=link.transmitter.outcome,
            on_demand=on_demand,
            observe=None if link.split is None else link.split.observe,
        )
        self.info = InfoReporter(
            config,
            session_id=flight.session_id,
            operating=link.operating,
            view=view,
            class_names=link.transmitter.class_names,
            channels=channels_of(config, live=flight.source.live),
            still_codecs=lambda: maker.codec_names,
            clock=clock,
        )
        self.backlog = None
        if max_bytes := config.store_bytes(live=flight.source.live):
            self.backlog = BacklogStage(
                Store(
                    store_folder(config),
                    max_bytes=max_bytes,
                    session_id=flight.session_id,
                    info=self.info.info,
                    oldest_ns=max(0, clock() - round(config.store_age * SECOND_NS)),
                    clock=clock,
                ),
                link.transmitter,
                live=flight.source.live,
                has_subscriber=partial(flight.ends.has_subscriber, Channel.BACKLOG),
                stills_pending=lambda: outbox.any_pending,
                stills_in_flight=lambda: outbox.unacknowledged,
                keyframes=link.keyframes,
                clock=clock,
                failures=flight.failures,
            )
            flight.stack.callback(self.backlog.close)
        sender = StillSender(outbox, maker=maker, transmitter=link.transmitter, backlog=self.backlog)
        flight.stack.callback(lambda: sender.close(clock()))
        auto = trust = reporter = None
        if config.measures:
            auto = AutoControl(link.operating, auto_settings(config, view))
            trust = ViewTrust(trust_from(config.detector), hence="auto gives its tracks no credit")
        if config.send_tracks:
            reporter = TrackReporter(link.transmitter, session_id=flight.session_id)
        cpu_budget = CpuBudget()
        if not flight.lockstep:
            cpu_budget = CpuBudget(fps=config.nominal_fps, processors=processors())
        self.stage = StillStage(
            make_analyzer(config, detector=flight.detector, view=view, trust=trust, cpu_budget=cpu_budget),
            chooser,
            sender=sender,
            keyframes=link.keyframes,
            tracks_used=config.tracks_used,
            reporter=reporter,
            shadow=make_shadow(
                config, flight.detector, before=flight.beginning.shadow, cpu_budget=cpu_budget
            ),
            auto=auto,
        )


class Video:
    """The base stream: the stage that codes it or passes it through, and the control that admits its frames."""

    def __init__(self, flight: Flight, link: Link, stills: Stills, *, local_copy: LocalCopy | None) -> None:
        config, failures = flight.config, flight.failures
        self.control = LinkControl(
            has_ground=flight.ends.has_ground,
            has_subscriber=partial(flight.ends.has_subscriber, Channel.BASE),
            keyframes=link.keyframes,
            inbox=flight.inbox,
            reconfiguration=link.reconfiguration,
            clock=flight.clock,
            stills=stills.stage.sender,
            failures=failures,
        )
        parts: dict[str, Any] = {
            "keyframes": link.keyframes,
            "transmitter": link.transmitter,
            "failures": failures,
            "local_copy": local_copy,
            "admits": self.control.admits,
            "holder": self.control.holder,
            "backlog": stills.backlog,
        }
        if flight.camera is not None:
            pause = None if flight.lockstep else flight.loop_clock.pause
            self.stage = flight.camera.make_stage(link.encoder, link.reconfiguration, pause=pause, **parts)
            return
        size = flight.source.view.base_size
        self.stage = BaseStage(
            link.encoder,
            encoder_name=config.encoder,
            first_keyframe_bytes=link.operating.now.base_bps // 40,  # .2 s: the limit of the VBV
            regions=TrackRegions(size, depth=config.roi_depth) if config.roi_depth else None,
            frame_skip=make_frame_skip(
                config,
                flight.beginning.decimation,
                size=size,
                least_decimation=link.reconfiguration.least_decimation,
            ),
            reconfigure=link.reconfiguration,
            keyframe_bytes=link.reconfiguration.keyframe_bytes,
            open_again=None if flight.lockstep else link.reconfiguration.open_again,
            **parts,
        )


class Stages:
    """The stages of a frame, the ends that a ground's messages reach, and their reporters."""

    def __init__(self, flight: Flight, *, pose_source: PoseSource | None) -> None:
        """Raises `UserError` where the encoder refuses the settings, or a file cannot be written."""
        config, view = flight.config, flight.source.view
        self.link = link = Link(flight)
        # Files are made after all checks that may refuse the settings: a failed start leaves nothing behind.
        if config.truth is not None and isinstance(flight.source, DrawnSource):
            flight.source.write_truth(config.truth, fps=config.nominal_fps)
        local_copy = None
        if config.record_base:
            copy = open_local_copy(config.record_base, failures=flight.failures, wait=flight.lockstep)
            local_copy = flight.stack.enter_context(copy)
        stills = Stills(flight, link)
        video = Video(flight, link, stills, local_copy=local_copy)
        self.stills, self.backlog = stills.stage, stills.backlog
        self.base, self.link_control = video.stage, video.control
        self.pose = None
        if pose_source is not None:
            self.pose = PoseStage(
                pose_source, session_id=flight.session_id, sender=link.transmitter, failures=flight.failures
            )
        commands = Commands(
            config,
            operating=link.operating,
            session_id=flight.session_id,
            keyframes=link.keyframes,
            chooser=self.stills.chooser,
            make_method=lambda name: make_method(config, view, name=name),
            backlog=self.backlog,
            base_size=view.base_size,
            clock=flight.clock,
            loop_clock=flight.loop_clock,
        )
        self.answers = Answers(
            info=stills.info.info,
            control=commands.answer,
            on_feedback=self.link_control.on_feedback,
            on_info_request=stills.readers.on_request,
            reply=link.transmitter.reply,
        )
        self.heartbeat = Heartbeat(
            config,
            view=view,
            operating=link.operating,
            counts=flight.counts,
            stills=self.stills,
            link=flight.ends,
            inbox=flight.inbox,
            failures=flight.failures,
            clock=flight.clock,
            loop_clock=flight.loop_clock,
        )
        self.status = StatusReporter(self.heartbeat)
