"""Every part of an edge, built once from the parts it needs. They form a tree."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

from hvt_common.inference.detect import FailingDetector
from hvt_common.inference.few_found import ViewTrust
from hvt_common.protocol.channels import Channel
from hvt_common.protocol.ledger import Ledger
from hvt_common.protocol.messages import fitted_class_names
from hvt_common.runtime.failures import Failures
from hvt_edge.backlog.outage import BaseInFlight
from hvt_edge.config import EdgeConfig
from hvt_edge.control.commands import Commands
from hvt_edge.control.link_control import LinkControl
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.link.publisher import Answers, EdgeLink
from hvt_edge.link.stills import StillReaders
from hvt_edge.link.tracks_channel import TrackReporter
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.loop.counts import FrameCounts, processors
from hvt_edge.loop.pose import PoseSource, PoseStage
from hvt_edge.operating import LoopClock, Operating, base_rate_bps
from hvt_edge.perception.cpu_budget import CpuBudget
from hvt_edge.report.state import Heartbeat
from hvt_edge.report.status import InfoReporter, StatusReporter
from hvt_edge.source.contract import Source
from hvt_edge.source.demo import write_truth_of
from hvt_edge.stills.outbox import Outbox
from hvt_edge.stills.stage import StillSender, StillStage
from hvt_edge.video.passthrough import PassthroughStage, VideoStage
from hvt_edge.video.rate_model import LimitedFrameSkip
from hvt_edge.video.reconfigure import EncoderReconfiguration
from hvt_edge.video.stage import BaseStage
from hvt_edge.wiring.link import (
    channels_of,
    make_budget,
    make_camera_rates,
    make_least_link,
    make_levers,
    make_pacer,
    make_split,
)
from hvt_edge.wiring.perception import make_analyzer, make_shadow
from hvt_edge.wiring.stills import make_method, make_stills
from hvt_edge.wiring.storing import make_backlog, open_local_copy
from hvt_edge.wiring.trial import Beginning
from hvt_edge.wiring.video import (
    encoder_opener,
    make_frame_skip,
    make_keyframes,
    make_presets,
    make_regions,
    reconfiguration_settings,
)


class Stages:
    """The stages of a frame, the ends that a ground reaches, and what reports of them."""

    def __init__(
        self,
        stack: ExitStack,
        config: EdgeConfig,
        *,
        source: Source,
        pose_source: PoseSource | None,
        detector: FailingDetector,
        link: EdgeLink,
        session_id: int,
        ledger: Ledger,
        counts: FrameCounts,
        inbox: FeedbackInbox,
        failures: Failures,
        clock: Callable[[], int],
        loop_clock: LoopClock,
        beginning: Beginning,
        headroom: float = 1.0,
    ) -> None:
        """Build every part once, each with all that it needs; files and threads end with ``stack``.

        ``beginning`` is what `try_scene` found.
        ``headroom`` is the share of its rate that the encoder is set to (`qualify_encoder`).
        Raises `UserError` where the encoder does not take the settings, or a file cannot be written.
        """
        view, class_names, decimation = source.view, detector.class_names, beginning.decimation
        lockstep = config.pace == "lockstep"
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
        self.keyframes = make_keyframes(config, source)
        pacer = make_pacer(config, source.camera_stream, view.base_size)
        presets = make_presets(config, self.operating)
        open_encoder = encoder_opener(
            config, self.operating, size=view.base_size, headroom=headroom, presets=presets
        )
        encoder = open_encoder(total_bps=config.budget_bps, base_bps=base_bps, decimation=decimation)
        budget = make_budget(config, base_bps=base_bps, decimation=decimation)
        # Files come after all that may be refused: a failed start leaves nothing behind.
        write_truth_of(source, config.truth, fps=config.nominal_fps)
        local_copy = None
        if config.record_base:
            local_copy = stack.enter_context(
                open_local_copy(config.record_base, failures=failures, wait=lockstep)
            )
        in_flight, outbox = BaseInFlight(), Outbox(reports=not lockstep)
        self.transmitter = Transmitter(
            link,
            ledger=ledger,
            budget=budget,
            edge_id=config.edge_id,
            session_id=session_id,
            lockstep=lockstep,
            wait_until=loop_clock.wait_until,
            pacer=pacer,
            in_flight=None if lockstep else in_flight,
            clock=None if lockstep else loop_clock,
        )
        self.reconfiguration = EncoderReconfiguration(
            self.operating,
            reconfiguration_settings(config, view.base_size),
            open_encoder=open_encoder,
            transmitter=self.transmitter,
            split=make_split(config, view.base_size, first_share=beginning.share),
            pacer=pacer,
            presets=presets,
        )
        still_readers = StillReaders(clock)
        chooser, on_demand = make_stills(
            config,
            outbox=outbox,
            transmitter=self.transmitter,
            view=view,
            class_names=class_names,
            offline=lambda: self.backlog is not None and self.backlog.offline,
            readable=still_readers.read,
            observe=self.reconfiguration.observe,
        )
        info = InfoReporter(
            config,
            session_id=session_id,
            operating=self.operating,
            view=view,
            class_names=fitted_class_names(class_names),
            channels=channels_of(config, live=source.live),
            still_codecs=lambda: chooser.maker.codec_names,
            clock=clock,
        )
        self.backlog = make_backlog(
            config,
            session_id=session_id,
            live=source.live,
            has_subscriber=partial(link.has_subscriber, Channel.BACKLOG),
            transmitter=self.transmitter,
            in_flight=in_flight,
            outbox=outbox,
            keyframes=self.keyframes,
            clock=clock,
            info=info.info,
            failures=failures,
        )
        if self.backlog is not None:
            stack.enter_context(self.backlog)
        still_sender = StillSender(
            outbox, maker=chooser.maker, transmitter=self.transmitter, backlog=self.backlog
        )
        stack.callback(lambda: still_sender.close(clock()))
        self.link_control = LinkControl(
            has_ground=link.has_ground,
            has_subscriber=partial(link.has_subscriber, Channel.BASE),
            session_id=session_id,
            transmitter=self.transmitter,
            keyframes=self.keyframes,
            inbox=inbox,
            reconfiguration=self.reconfiguration,
            clock=clock,
            pacer=pacer,
            in_flight=in_flight,
            outbox=outbox,
            stills=still_sender,
            backlog=self.backlog,
            failures=failures,
        )
        self.pose = None
        if pose_source is not None:
            self.pose = PoseStage(
                pose_source, session_id=session_id, sender=self.transmitter, failures=failures
            )
        if config.passes_through:
            assert source.camera_stream is not None, "checked by as_the_camera_is"
            rates = make_camera_rates(
                config,
                source.camera_stream,
                reconfiguration=self.reconfiguration,
                operating=self.operating,
                pacer=pacer,
            )
            self.base: VideoStage = PassthroughStage(
                self.keyframes,
                self.transmitter,
                failures=failures,
                local_copy=local_copy,
                reconfigure=rates,
                observe=rates.observe,
                least_link=make_least_link(config, pacer=pacer, in_flight=in_flight),
                admits=self.link_control.admits,
                holder=self.link_control.holder,
                pause=None if lockstep else loop_clock.pause,
                backlog=self.backlog,
            )
        else:
            self.base = BaseStage(
                encoder,
                encoder_name=config.encoder,
                keyframes=self.keyframes,
                transmitter=self.transmitter,
                local_copy=local_copy,
                first_keyframe_bytes=base_bps // 40,  # a fifth of a second: what the VBV lets through
                regions=make_regions(config, view.base_size),
                frame_skip=LimitedFrameSkip(
                    make_frame_skip(config, decimation, size=view.base_size),
                    self.reconfiguration.least_decimation,
                ),
                reconfigure=self.reconfiguration,
                keyframe_bytes=self.reconfiguration.keyframe_bytes,
                admits=self.link_control.admits,
                holder=self.link_control.holder,
                backlog=self.backlog,
                open_again=None if lockstep else self.reconfiguration.open_again,
                failures=failures,
            )
        levers = make_levers(config, self.operating, view)
        trust = (
            None if levers is None else ViewTrust(config.detector, hence="auto gives its tracks no credit")
        )
        cpu_budget = CpuBudget() if lockstep else CpuBudget(fps=config.nominal_fps, processors=processors())
        self.stills = StillStage(
            make_analyzer(config, detector=detector, view=view, trust=trust, cpu_budget=cpu_budget),
            chooser,
            outbox=outbox,
            sender=still_sender,
            transmitter=self.transmitter,
            keyframes=self.keyframes,
            tracks_used=config.tracks_used,
            reporter=TrackReporter(self.transmitter, session_id=session_id) if config.send_tracks else None,
            shadow=make_shadow(config, detector, before=beginning.shadow, cpu_budget=cpu_budget),
            levers=levers,
        )
        commands = Commands(
            config,
            operating=self.operating,
            session_id=session_id,
            keyframes=self.keyframes,
            on_demand=on_demand,
            chooser=chooser,
            make_method=lambda name: make_method(config, view, name=name),
            backlog=self.backlog,
            base_size=view.base_size,
            clock=clock,
            loop_clock=loop_clock,
        )
        self.answers = Answers(
            info=info.info,
            control=commands.answer,
            on_feedback=self.link_control.on_feedback,
            on_info_request=still_readers.on_request,
            reply=self.transmitter.reply,
        )
        self.heartbeat = Heartbeat(
            config,
            session_id=session_id,
            view=view,
            operating=self.operating,
            ledger=ledger,
            counts=counts,
            keyframes=self.keyframes,
            transmitter=self.transmitter,
            stills=self.stills,
            backlog=self.backlog,
            link=link,
            inbox=inbox,
            failures=failures,
            clock=clock,
            loop_clock=loop_clock,
        )
        self.status = StatusReporter(self.heartbeat)
