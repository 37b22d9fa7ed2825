"""From settings to stages: every part of an edge is built here, once, from what it needs. The parts form a tree."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, cast

from hvt_common.inference.detect import Detector, open_detector, warm_up
from hvt_common.inference.tiles import tiled
from hvt_common.protocol.channels import Channel
from hvt_common.protocol.ledger import Ledger
from hvt_common.runtime.reporting import check_writable
from hvt_common.tracking.bytetrack import ByteTracker, TrackerSettings, weak_confidence
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_common.values import View
from hvt_common.video.still_codecs import still_codec
from hvt_edge.backlog.disk import Folder, check_folder, default_folder
from hvt_edge.backlog.outage import BaseInFlight
from hvt_edge.backlog.stage import BacklogLink, BacklogStage
from hvt_edge.config import DEFAULT_SIZE, LEAST_FPS, EdgeConfig
from hvt_edge.control.commands import Commands
from hvt_edge.control.link_control import LinkControl
from hvt_edge.link.budget import BudgetSettings, RollingBudget
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.link.pacer import Pacer
from hvt_edge.link.publisher import EdgeLink
from hvt_edge.link.rate_control import RateController, RateSettings
from hvt_edge.link.tracks_channel import TrackReporter
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.operating.keyframes import KeyframeRequests, KeyframeSettings
from hvt_edge.operating.point import LoopClock, Operating
from hvt_edge.perception.analyzer import Analyzer, AnalyzerSettings
from hvt_edge.perception.candidates import Candidate, TrackMemory
from hvt_edge.perception.frame_ring import FrameRing, RingSettings
from hvt_edge.source.contract import BaseSize, Source
from hvt_edge.source.demo import write_truth_of
from hvt_edge.status import InfoReporter
from hvt_edge.stills.maker import StillMaker
from hvt_edge.stills.on_demand import OnDemand
from hvt_edge.stills.outbox import Outbox
from hvt_edge.stills.policy.base import Step
from hvt_edge.stills.policy.registry import method, tuning
from hvt_edge.stills.scheduler import Chooser, ChooserSettings
from hvt_edge.stills.sending import StillSender
from hvt_edge.stills.stage import StillStage
from hvt_edge.stills.suppression import Gate, Suppression
from hvt_edge.video.encoder_settings import encoder_settings, least_base_bps, payload_bps
from hvt_edge.video.frame_skip import FrameSkip, LimitedFrameSkip, MeasuredFrameSkip
from hvt_edge.video.keyframes import keyframe_interval_s
from hvt_edge.video.local_copy import BaseRecorder
from hvt_edge.video.rate_model import choose_base, most_decimation
from hvt_edge.video.reconfigure import EncoderReconfiguration, ReconfigurationSettings
from hvt_edge.video.regions import TrackRegions
from hvt_edge.video.share import Split, SplitSettings
from hvt_edge.video.stage import BaseStage
from hvt_edge.video.x265 import BaseEncoder

__all__ = [
    "SECOND_NS",
    "Stages",
    "base_size",
    "build_stages",
    "check_files",
    "make_detector",
    "make_link_settings",
    "warm_up_for",
]

SECOND_NS = 1_000_000_000
_MOST_ENCODER_THREADS = 4  # a 720p picture has twelve rows of blocks, each some steps behind the one above
_REST_S = 10.0
"""How often ``--fps auto`` may think again."""


# What is written, and who is talked to


def check_files(config: EdgeConfig) -> None:
    """Raise `UserError` for a file or folder that could not be written."""
    for path, name in (
        (config.summary, "--summary"),
        (config.truth, "--truth"),
        (config.record_base, "--record-base"),
    ):
        check_writable(path, name=name)
    if config.store and config.pace != "lockstep":
        check_folder(config.store_folder or default_folder(config.edge_id))


def make_link_settings(config: EdgeConfig) -> LinkSettings:
    """How the edge takes part in Zenoh."""
    return LinkSettings(
        role="edge",
        listen=config.listen,
        connect=config.connect,
        zenoh_config=config.zenoh_config,
        insecure=config.insecure,
        name=config.edge_id,
        links=2 if config.links == 2 else 1,
    )


# Perception


def make_detector(config: EdgeConfig) -> Detector:
    """Open the detector, with weak detections kept: they may carry a track on, though not start one."""
    detector = open_detector(
        config.detector,
        labels=config.labels,
        confidence=weak_confidence(config.confidence),
        nms_iou=config.nms_iou,
        threads=config.threads,
        provider=config.provider,
    )
    return tiled(detector, config.tiles) if config.candidates == "source" else detector


def warm_up_for(config: EdgeConfig, detector: Detector, view: View) -> None:
    """Run the detector once on what it will be given: a runtime may compile for each shape."""
    if config.candidates == "source":
        warm_up(detector, view.base_size if view.enlarges else view.source_size)
    else:
        warm_up(detector, view.base_size)


def make_analyzer(config: EdgeConfig, *, detector: Detector, view: View) -> Analyzer:
    """Decoder, detector and tracker of the edge's own stream."""
    settings = TrackerSettings.starting_at(
        config.confidence, camera_motion=cast('Literal["off", "flow", "ecc"]', config.camera_motion)
    )
    return Analyzer(
        detector,
        ByteTracker(settings, fps=config.nominal_fps),
        view=view,
        settings=AnalyzerSettings(
            detect_every=config.detect_every,
            candidates=cast('Literal["decoded", "source"]', config.candidates),
        ),
    )


# Stills


def make_suppression(config: EdgeConfig) -> Suppression:
    """Which tracks pause, and for how long."""
    return Suppression.for_cooldown(config.cooldown, min_gain=config.min_gain)


def make_chooser(
    config: EdgeConfig,
    *,
    outbox: Outbox,
    view: View,
    class_names: tuple[str, ...],
    most_bytes: int,
    on_outcome: Callable[[str, str], None],
    observe: Callable[[Sequence[Candidate], Step], None],
    on_demand: OnDemand,
) -> Chooser:
    """Method, suppression, gate and maker; ``most_bytes`` is the largest payload the budget ever admits."""
    return Chooser(
        method(config.method, **tuning(config.tune)),
        suppression=make_suppression(config),
        outbox=outbox,
        maker=make_still_maker(config),
        memory=TrackMemory(padding=config.padding),
        view=view,
        class_names=class_names,
        settings=ChooserSettings(
            fps=config.nominal_fps,
            most_bytes=most_bytes,
            gate=Gate(psnr_y_db=config.gate),
            share=config.group_stills,
            from_source=config.candidates == "source",
        ),
        on_outcome=on_outcome,
        observe=observe,
        on_demand=on_demand,
    )


def make_on_demand(
    config: EdgeConfig,
    *,
    outbox: Outbox,
    view: View,
    class_names: tuple[str, ...],
    most_bytes: Callable[[], int],
) -> OnDemand:
    """The ring of source frames, and who serves stills from it."""
    ring = FrameRing(RingSettings(max_bytes=config.ring, max_age_ns=round(config.ring_time * SECOND_NS)))
    return OnDemand(
        ring,
        outbox=outbox,
        maker=make_still_maker(config),
        view=view,
        class_names=class_names,
        most_bytes=most_bytes,
    )


def make_still_maker(config: EdgeConfig) -> StillMaker:
    """Codec, quality and fallback of stills."""
    codec = still_codec(config.still_codec)
    return StillMaker(
        codec=codec,
        fallback=still_codec(config.fallback_codec) if codec.needs_base else None,
        quality_pct=config.jpeg_quality,
        fidelity_db=config.fidelity,
        padding=config.padding,
    )


# Bits


def base_size(config: EdgeConfig) -> BaseSize:
    """The base stream's size, or how it follows from the source's."""
    if config.fixed_size is not None:
        return config.fixed_size
    return lambda source_size: _chosen(config, source_size, size=None)[0]


def first_decimation(config: EdgeConfig, size: tuple[int, int]) -> int:
    """Each n-th source frame is coded at the start."""
    return _chosen(config, size, size=size)[1]


def _chosen(
    config: EdgeConfig, source_size: tuple[int, int], *, size: tuple[int, int] | None
) -> tuple[tuple[int, int], int]:
    rate_bps = payload_bps(
        config.base_bps,
        size=size or min(source_size, DEFAULT_SIZE),
        fps=config.nominal_fps,
        edge_id=config.edge_id,
    )
    return choose_base(
        rate_bps,
        source_size,
        size=size,
        fps=None if config.auto_fps else config.nominal_fps,
        most_fps=config.nominal_fps,
        least_fps=LEAST_FPS,
    )


def make_frame_skip(config: EdgeConfig, decimation: int) -> FrameSkip:
    """Which source frames are coded."""
    if not config.auto_fps:
        return FrameSkip(decimation)
    most = most_decimation(config.nominal_fps, least_fps=LEAST_FPS)
    return MeasuredFrameSkip(
        decimation, most_decimation=most, rest_frames=round(_REST_S * config.nominal_fps)
    )


def make_budget(config: EdgeConfig, *, decimation: int) -> RollingBudget:
    """B_tot and B_v over the rolling window."""
    return RollingBudget(
        BudgetSettings(
            total_bps=config.budget_bps,
            base_bps=config.base_bps,
            fps=config.nominal_fps / decimation,
            window_ns=round(config.window * SECOND_NS),
            metadata_bps=config.metadata_bps,
            borrow_unused=config.borrow_unused,
        )
    )


def make_split(config: EdgeConfig, size: tuple[int, int]) -> Split | None:
    """Who moves the base's share of the budget; None where it is fixed."""
    if not isinstance(config.video_share, str):
        return None
    fps = LEAST_FPS if config.auto_fps else config.nominal_fps
    return Split(
        SplitSettings(
            total_bps=config.budget_bps,
            least_base_bps=least_base_bps(size, fps, edge_id=config.edge_id),
            metadata_bps=config.metadata_bps,
        )
    )


def make_encoder(
    config: EdgeConfig, *, size: tuple[int, int], total_bps: int, base_bps: int, decimation: int
) -> BaseEncoder:
    """x265 at the rate that the budget leaves it; with several threads only where bytes need not repeat."""
    settings = encoder_settings(
        size=size,
        fps=config.nominal_fps / decimation,
        preset=config.preset,
        total_bps=total_bps - config.metadata_bps,
        base_bps=base_bps,
        edge_id=config.edge_id,
        side_data=config.roi_depth > 0,
    )
    threads = 1 if config.pace == "lockstep" else min(_MOST_ENCODER_THREADS, os.cpu_count() or 1)
    return BaseEncoder(replace(settings, threads=threads))


def reconfiguration_settings(config: EdgeConfig, size: tuple[int, int]) -> ReconfigurationSettings:
    """What bounds the rates in flight."""
    return ReconfigurationSettings(
        size=size,
        nominal_fps=config.nominal_fps,
        least_fps=LEAST_FPS,
        edge_id=config.edge_id,
        metadata_bps=config.metadata_bps,
        min_budget_bps=config.min_budget_bps,
    )


def make_regions(config: EdgeConfig, size: tuple[int, int]) -> TrackRegions | None:
    """Which regions of the base get more bits; None for none."""
    return TrackRegions(size, depth=config.roi_depth) if config.roi_depth else None


def make_keyframes(config: EdgeConfig) -> KeyframeRequests:
    """Where keyframes are requested, on a long schedule and on demand."""
    interval_s = config.keyframe_interval
    if isinstance(interval_s, str):
        interval_s = keyframe_interval_s(config.fixed_size or DEFAULT_SIZE, config.base_bps)
    return KeyframeRequests(KeyframeSettings(interval_ns=round(interval_s * SECOND_NS)))


def make_pacer(config: EdgeConfig) -> Pacer | None:
    """What tracks the link's rate; None where the budget is to stay as it is."""
    if not config.adapts:
        return None
    return Pacer(RateController(RateSettings(ceiling_bps=config.budget_bps, floor_bps=config.floor_bps)))


# Storing


def make_backlog(
    config: EdgeConfig,
    *,
    session_id: int,
    live: bool,
    has_subscriber: Callable[[], bool],
    transmitter: Transmitter,
    in_flight: BaseInFlight,
    outbox: Outbox,
    keyframes: KeyframeRequests,
    clock: Callable[[], int],
    info: Callable[[], bytes],
) -> BacklogStage | None:
    """Who stores what the link cannot carry away; None where nobody does. Starts a thread: to be closed."""
    if not config.store or config.pace == "lockstep":
        return None
    path = config.store_folder or default_folder(config.edge_id)
    oldest_ns = max(0, clock() - round(config.store_age * SECOND_NS))
    return BacklogStage(
        lambda: Folder(path, max_bytes=config.store, session_id=session_id, info=info, oldest_ns=oldest_ns),
        session_id=session_id,
        live=live,
        link=BacklogLink(
            has_subscriber=has_subscriber,
            allowance_bytes=lambda now_ns, reserve: transmitter.backlog_allowance_bytes(
                now_ns, reserve=reserve
            ),
            send=lambda chunk, now_ns: transmitter.backlog(chunk, now_ns=now_ns),
            round_trip_ns=lambda: transmitter.round_trip_ns,
            total_bps=lambda: transmitter.total_bps,
            stills_pending=lambda: outbox.any_pending,
            stills_in_flight=lambda: outbox.unacknowledged,
        ),
        in_flight=in_flight,
        keyframes=keyframes,
        clock=clock,
        on_outcome=transmitter.outcome,
    )


# All together


@dataclass(frozen=True, slots=True)
class Stages:
    """What a frame goes through, and what a ground reaches."""

    base: BaseStage
    stills: StillStage
    transmitter: Transmitter
    link_control: LinkControl
    commands: Commands
    reconfiguration: EncoderReconfiguration
    operating: Operating
    keyframes: KeyframeRequests
    backlog: BacklogStage | None
    info: InfoReporter


def build_stages(
    stack: ExitStack,
    config: EdgeConfig,
    *,
    source: Source,
    detector: Detector,
    link: EdgeLink,
    session_id: int,
    ledger: Ledger,
    inbox: FeedbackInbox,
    clock: Callable[[], int],
    loop_clock: LoopClock,
    wait_until: Callable[[int], None],
) -> Stages:
    """Build every part once, each with all that it needs; files and threads end with ``stack``.

    Raises:
        UserError: x265 does not take the settings, or a file cannot be written.
    """
    view, class_names = source.view, detector.class_names
    lockstep = config.pace == "lockstep"
    decimation = first_decimation(config, view.base_size)
    operating = Operating(
        budget_bps=config.budget_bps,
        video_share=config.fixed_share,
        base_bps=config.base_bps,
        method=config.method,
        decimation=decimation,
    )
    keyframes, pacer = make_keyframes(config), make_pacer(config)
    open_encoder = partial(make_encoder, config, size=view.base_size)
    encoder = open_encoder(total_bps=config.budget_bps, base_bps=config.base_bps, decimation=decimation)
    budget = make_budget(config, decimation=decimation)
    # Files come after all that may be refused: a failed start leaves nothing behind.
    write_truth_of(source, config.truth, fps=config.nominal_fps)
    recorder = stack.enter_context(BaseRecorder(config.record_base)) if config.record_base else None
    in_flight, outbox = BaseInFlight(), Outbox(reports=not lockstep)
    transmitter = Transmitter(
        link,
        ledger=ledger,
        budget=budget,
        edge_id=config.edge_id,
        session_id=session_id,
        lockstep=lockstep,
        wait_until=wait_until,
        pacer=pacer,
        in_flight=None if lockstep else in_flight,
    )
    reconfiguration = EncoderReconfiguration(
        operating,
        reconfiguration_settings(config, view.base_size),
        open_encoder=open_encoder,
        transmitter=transmitter,
        split=make_split(config, view.base_size),
        pacer=pacer,
    )
    info = InfoReporter(
        config,
        session_id=session_id,
        operating=operating,
        view=view,
        class_names=class_names,
        clock=clock,
    )
    backlog = make_backlog(
        config,
        session_id=session_id,
        live=source.live,
        has_subscriber=partial(link.has_subscriber, Channel.BACKLOG),
        transmitter=transmitter,
        in_flight=in_flight,
        outbox=outbox,
        keyframes=keyframes,
        clock=clock,
        info=info.info,
    )
    if backlog is not None:
        stack.enter_context(backlog)
    still_sender = StillSender(
        outbox, maker=make_still_maker(config), transmitter=transmitter, backlog=backlog
    )
    stack.callback(lambda: still_sender.close(clock()))
    link_control = LinkControl(
        has_ground=link.has_ground,
        session_id=session_id,
        transmitter=transmitter,
        keyframes=keyframes,
        inbox=inbox,
        reconfiguration=reconfiguration,
        clock=clock,
        pacer=pacer,
        in_flight=in_flight,
        outbox=outbox,
        stills=still_sender,
        backlog=backlog,
    )
    base = BaseStage(
        encoder,
        keyframes=keyframes,
        transmitter=transmitter,
        recorder=recorder,
        first_keyframe_bytes=config.base_bps // 40,  # a fifth of a second: what the VBV lets through
        regions=make_regions(config, view.base_size),
        frame_skip=LimitedFrameSkip(make_frame_skip(config, decimation), reconfiguration.least_decimation),
        reconfigure=reconfiguration,
        admits=link_control.admits,
        backlog=backlog,
    )
    on_demand = make_on_demand(
        config, outbox=outbox, view=view, class_names=class_names, most_bytes=transmitter.most_still_bytes
    )
    chooser = make_chooser(
        config,
        outbox=outbox,
        view=view,
        class_names=class_names,
        most_bytes=transmitter.most_still_bytes(),
        on_outcome=transmitter.outcome,
        observe=reconfiguration.observe,
        on_demand=on_demand,
    )
    stills = StillStage(
        make_analyzer(config, detector=detector, view=view),
        chooser,
        outbox=outbox,
        sender=still_sender,
        transmitter=transmitter,
        keyframes=keyframes,
        reporter=TrackReporter(transmitter, session_id=session_id) if config.send_tracks else None,
    )
    commands = Commands(
        config,
        operating=operating,
        session_id=session_id,
        keyframes=keyframes,
        on_demand=on_demand,
        chooser=chooser,
        backlog=backlog,
        base_size=view.base_size,
        clock=clock,
        loop_clock=loop_clock,
    )
    return Stages(
        base,
        stills,
        transmitter,
        link_control,
        commands,
        reconfiguration,
        operating,
        keyframes,
        backlog,
        info,
    )
