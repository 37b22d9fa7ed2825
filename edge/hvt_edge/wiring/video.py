"""The base stream, from the settings: size, frame rate, encoder, regions, keyframes."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import cast

from hvt_common.units import SECOND_NS
from hvt_common.values import Fit
from hvt_edge.config import DEFAULT_SIZE, LEAST_FPS, EdgeConfig
from hvt_edge.operating.keyframes import KeyframeRequests, KeyframeSettings
from hvt_edge.source.contract import BaseSize, size_within
from hvt_edge.video.encoder_settings import encoder_settings, payload_bps
from hvt_edge.video.frame_skip import FrameSkip, MeasuredFrameSkip
from hvt_edge.video.keyframes import keyframe_interval_s
from hvt_edge.video.rate_model import choose_base, most_decimation
from hvt_edge.video.reconfigure import ReconfigurationSettings
from hvt_edge.video.regions import TrackRegions
from hvt_edge.video.x265 import BaseEncoder

_MOST_ENCODER_THREADS = 4  # a 720p picture has twelve rows of blocks, each some steps behind the one above
_AUTO_LEAST_FPS = 7.5
"""With ``--profile auto``: frames that are larger arrive later, and nobody asked for delay."""
_REST_S = 10.0
"""How often ``--fps auto`` may think again."""


def base_size(config: EdgeConfig) -> BaseSize:
    """The base stream's size, or how it follows from the source's."""
    if config.fixed_size is not None:
        return config.fixed_size
    if config.size is None:
        return lambda source_size: default_size(source_size, fit=cast("Fit", config.fit))
    return lambda source_size: _chosen(config, source_size, size=None)[0]


def default_size(source_size: tuple[int, int], *, fit: Fit) -> tuple[int, int]:
    """What ``--size`` is unless it is given: at most 1280x720, and never larger than the source.

    With ``letterbox`` it has the source's aspect ratio, which leaves no border; ``crop`` cuts to that of 1280x720.
    """
    box = (min(source_size[0], DEFAULT_SIZE[0]), min(source_size[1], DEFAULT_SIZE[1]))
    return size_within(source_size if fit == "letterbox" else DEFAULT_SIZE, box)


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
        least_fps=_least_fps(config),
    )


def _least_fps(config: EdgeConfig) -> float:
    """The lowest rate of coded frames that is chosen; a thin link may enforce less."""
    return _AUTO_LEAST_FPS if config.measures else LEAST_FPS


def make_frame_skip(config: EdgeConfig, decimation: int) -> FrameSkip:
    """Which source frames are coded."""
    if not config.auto_fps:
        return FrameSkip(decimation)
    most = most_decimation(config.nominal_fps, least_fps=_least_fps(config))
    return MeasuredFrameSkip(
        decimation, most_decimation=most, rest_frames=round(_REST_S * config.nominal_fps)
    )


def make_encoder(
    config: EdgeConfig, *, size: tuple[int, int], total_bps: int, base_bps: int, decimation: int
) -> BaseEncoder:
    """x265 at the rate that the budget leaves it; with several threads only where bytes need not repeat."""
    settings = encoder_settings(
        size=size,
        fps=config.nominal_fps / decimation,
        preset=config.preset,
        # What is kept for tracks may be the base's while none are sent.
        total_bps=max(total_bps - config.metadata_bps, base_bps),
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
