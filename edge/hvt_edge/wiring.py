"""From settings to stages: everything at the edge that is made once and needs no network."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal, cast

from hvt_common.inference.detect import Detector, open_detector, warm_up
from hvt_common.inference.tiles import tiled
from hvt_common.runtime.reporting import check_writable
from hvt_common.tracking.bytetrack import ByteTracker, TrackerSettings, weak_confidence
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_common.values import Still, View
from hvt_common.video.still_codecs import still_codec
from hvt_edge.backlog.disk import Folder, check_folder, default_folder
from hvt_edge.backlog.stage import BacklogStage, Link
from hvt_edge.config import DEFAULT_SIZE, LEAST_FPS, EdgeConfig, parse_grid
from hvt_edge.link.budget import BudgetSettings, RollingBudget
from hvt_edge.link.pacer import Pacer
from hvt_edge.link.rate_control import RateController, RateSettings
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.operating.keyframes import KeyframePlan, KeyframeSettings, keyframe_interval_s
from hvt_edge.perception.analyzer import Analyzer, AnalyzerSettings
from hvt_edge.perception.candidates import Candidate, TrackMemory
from hvt_edge.perception.frame_ring import FrameRing, RingSettings
from hvt_edge.source.resample import BaseSize
from hvt_edge.stills.gate import Gate
from hvt_edge.stills.maker import StillMaker
from hvt_edge.stills.on_demand import OnDemand
from hvt_edge.stills.policy.base import Step
from hvt_edge.stills.policy.registry import method, tuning
from hvt_edge.stills.scheduler import Asked, Chooser, ChooserSettings
from hvt_edge.stills.suppression import Suppression
from hvt_edge.video.frame_skip import FrameSkip, MeasuredFrameSkip
from hvt_edge.video.least_rate import encoder_settings, least_base_bps, payload_bps
from hvt_edge.video.quality_refresh import RefreshPlan, RegionPlan, RollingRefreshPlan, TrackRegions, combined
from hvt_edge.video.rate_model import choose_base, most_decimation
from hvt_edge.video.share import Split, SplitSettings
from hvt_edge.video.x265 import BaseEncoder

__all__ = [
    "SECOND_NS",
    "base_size",
    "check_files",
    "first_decimation",
    "make_analyzer",
    "make_backlog",
    "make_budget",
    "make_chooser",
    "make_detector",
    "make_encoder",
    "make_frame_skip",
    "make_keyframes",
    "make_link_settings",
    "make_on_demand",
    "make_pacer",
    "make_regions",
    "make_split",
    "make_suppression",
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


# Seeing


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


# Choosing


def make_suppression(config: EdgeConfig) -> Suppression:
    """Which tracks rest, and for how long."""
    return Suppression.for_cooldown(config.cooldown, min_gain=config.min_gain)


def make_chooser(
    config: EdgeConfig,
    *,
    view: View,
    class_names: tuple[str, ...],
    most_bytes: int,
    on_outcome: Callable[[str, str], None],
    observe: Callable[[Sequence[Candidate], Step], None] = lambda _candidates, _step: None,
    asked: Asked | None = None,
    overdue: Callable[[int], Sequence[tuple[Still, float]]] = lambda _now_ns: (),
) -> Chooser:
    """Method, suppression, queue and still stage; ``most_bytes`` is the largest payload the budget ever admits."""
    return Chooser(
        method(config.method, **tuning(config.tune)),
        suppression=make_suppression(config),
        maker=_still_maker(config),
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
        asked=asked,
        overdue=overdue,
    )


def make_on_demand(
    config: EdgeConfig, *, view: View, class_names: tuple[str, ...], most_bytes: Callable[[], int]
) -> OnDemand:
    """The ring of source frames, and who serves stills from it."""
    ring = FrameRing(RingSettings(max_bytes=config.ring, max_age_ns=round(config.ring_time * SECOND_NS)))
    return OnDemand(
        ring, maker=_still_maker(config), view=view, class_names=class_names, most_bytes=most_bytes
    )


def _still_maker(config: EdgeConfig) -> StillMaker:
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
    """Each n-th tick is coded at the start."""
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
    """Which ticks are coded."""
    if not config.auto_fps:
        return FrameSkip(decimation)
    most = most_decimation(config.nominal_fps, least_fps=LEAST_FPS)
    return MeasuredFrameSkip(decimation, most_decimation=most, rest_ticks=round(_REST_S * config.nominal_fps))


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


def make_encoder(config: EdgeConfig, *, size: tuple[int, int], decimation: int, base_bps: int) -> BaseEncoder:
    """x265 at the rate that the budget leaves it; with several threads only where bytes need not repeat."""
    settings = encoder_settings(
        size=size,
        fps=config.nominal_fps / decimation,
        preset=config.preset,
        total_bps=config.budget_bps - config.metadata_bps,
        base_bps=base_bps,
        edge_id=config.edge_id,
        side_data=bool(config.roi_depth or parse_grid(config.rolling_refresh)),
        refreshes=config.refresh > 0,
    )
    threads = 1 if config.pace == "lockstep" else min(_MOST_ENCODER_THREADS, os.cpu_count() or 1)
    return BaseEncoder(replace(settings, threads=threads))


def make_regions(config: EdgeConfig, size: tuple[int, int]) -> RegionPlan | None:
    """Which regions of the base get more bits; None for none."""
    grid = parse_grid(config.rolling_refresh)
    refresh = rolling_refresh = tracks = None
    if config.refresh:
        period = max(1, round(config.refresh * config.nominal_fps))
        refresh = RefreshPlan(size, period_ticks=period, depth=config.refresh_depth)
    if grid is not None:
        rolling_refresh = RollingRefreshPlan(
            size, columns=grid[0], rows=grid[1], depth=config.rolling_refresh_depth
        )
    if config.roi_depth:
        tracks = TrackRegions(size, depth=config.roi_depth)
    return combined(refresh, rolling_refresh, tracks)


def make_keyframes(config: EdgeConfig) -> KeyframePlan:
    """Keyframes on a long schedule and on demand."""
    interval_s = config.keyframe_interval
    if isinstance(interval_s, str):
        interval_s = keyframe_interval_s(config.fixed_size or DEFAULT_SIZE, config.base_bps)
    return KeyframePlan(KeyframeSettings(interval_ns=round(interval_s * SECOND_NS)))


def make_pacer(config: EdgeConfig) -> Pacer | None:
    """What follows the link's rate; None where the budget is to stay as it is."""
    if not config.adapts:
        return None
    return Pacer(RateController(RateSettings(ceiling_bps=config.budget_bps, floor_bps=config.floor_bps)))


# Keeping


def make_backlog(
    config: EdgeConfig,
    *,
    session_id: int,
    live: bool,
    link: Link,
    sender: Transmitter,
    keyframes: KeyframePlan,
    clock: Callable[[], int],
    info: Callable[[], bytes],
) -> BacklogStage | None:
    """Who keeps what the link cannot carry away; None where nobody does. Starts a thread: to be closed."""
    if not config.store or config.pace == "lockstep":
        return None
    path = config.store_folder or default_folder(config.edge_id)
    oldest_ns = max(0, clock() - round(config.store_age * SECOND_NS))
    return BacklogStage(
        lambda: Folder(path, max_bytes=config.store, session_id=session_id, info=info, oldest_ns=oldest_ns),
        session_id=session_id,
        live=live,
        link=link,
        sender=sender,
        keyframes=keyframes,
        clock=clock,
        on_outcome=sender.outcome,
    )
