"""From settings to stages: everything at the edge that is made once and needs no network."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from typing import Literal, cast

from hvt_common.values import View
from hvt_common.vision.detect import Detector, open_detector, warm_up
from hvt_common.vision.still_codecs import JpegCodec
from hvt_common.vision.track import ByteTracker, TrackerSettings, weak_confidence
from hvt_edge.budget import BudgetSettings, RollingBudget
from hvt_edge.candidates import TrackMemory
from hvt_edge.choose import Chooser, ChooserSettings
from hvt_edge.config import EdgeConfig
from hvt_edge.encode import BaseEncoder
from hvt_edge.keyframes import KeyframePlan, KeyframeSettings
from hvt_edge.methods.registry import method
from hvt_edge.rate import encoder_settings
from hvt_edge.sight import Sight, SightSettings
from hvt_edge.still import StillMaker
from hvt_edge.suppress import Suppression

__all__ = [
    "SECOND_NS",
    "make_budget",
    "make_chooser",
    "make_detector",
    "make_encoder",
    "make_keyframes",
    "make_sight",
    "make_suppression",
]

SECOND_NS = 1_000_000_000
_MOST_ENCODER_THREADS = 4  # a 720p picture has twelve rows of blocks, each some steps behind the one above


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
    if config.candidates == "decoded":
        warm_up(detector, config.size)
    return detector


def make_sight(config: EdgeConfig, *, detector: Detector, view: View) -> Sight:
    """Decoder, detector and tracker of the edge's own stream."""
    settings = TrackerSettings.starting_at(
        config.confidence, camera_motion=cast('Literal["off", "flow", "ecc"]', config.camera_motion)
    )
    return Sight(
        detector,
        ByteTracker(settings, fps=config.fps),
        view=view,
        settings=SightSettings(
            detect_every=config.detect_every,
            candidates=cast('Literal["decoded", "source"]', config.candidates),
        ),
    )


def make_suppression(config: EdgeConfig) -> Suppression:
    """Which tracks rest, and for how long."""
    return Suppression.for_cooldown(config.cooldown, min_gain=config.min_gain)


def make_chooser(
    config: EdgeConfig,
    *,
    view: View,
    class_names: tuple[str, ...],
    most_bytes: int,
    on_fate: Callable[[str, str], None],
) -> Chooser:
    """Method, suppression, queue and still stage; ``most_bytes`` is the largest payload the budget ever admits."""
    return Chooser(
        method(config.method),
        suppression=make_suppression(config),
        maker=StillMaker(codec=JpegCodec(), quality_pct=config.jpeg_quality, padding=config.padding),
        memory=TrackMemory(padding=config.padding),
        view=view,
        class_names=class_names,
        settings=ChooserSettings(fps=config.fps, most_bytes=most_bytes),
        on_fate=on_fate,
    )


def make_budget(config: EdgeConfig) -> RollingBudget:
    """B_tot and B_v over the rolling window."""
    return RollingBudget(
        BudgetSettings(
            total_bps=config.budget_bps,
            base_bps=config.base_bps,
            fps=config.fps,
            window_ns=round(config.window * SECOND_NS),
        )
    )


def make_encoder(config: EdgeConfig) -> BaseEncoder:
    """x265 at the rate that the budget leaves it; with several threads only where bytes need not repeat."""
    settings = encoder_settings(
        size=config.size,
        fps=config.fps,
        preset=config.preset,
        total_bps=config.budget_bps,
        base_bps=config.base_bps,
        edge_id=config.edge_id,
    )
    threads = 1 if config.pace == "lockstep" else min(_MOST_ENCODER_THREADS, os.cpu_count() or 1)
    return BaseEncoder(replace(settings, threads=threads))


def make_keyframes(config: EdgeConfig) -> KeyframePlan:
    """Keyframes on a long schedule and on demand."""
    return KeyframePlan(KeyframeSettings(interval_ns=round(config.keyframe_interval * SECOND_NS)))
