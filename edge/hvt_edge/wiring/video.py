"""The base stream, from the settings: size, frame rate, encoder, regions, keyframes."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Protocol, cast

from hvt_common.config import AUTO
from hvt_common.runtime.log import START_LOGGER
from hvt_common.runtime.plug_ins import loaded, the_one
from hvt_common.units import SECOND_NS, bitrate_text
from hvt_common.values import Fit, Frame, View
from hvt_edge.config import DEFAULT_SIZE, LEAST_FPS, EdgeConfig, least_budget_bps
from hvt_edge.operating import Keyframes, KeyframeSettings, Operating, Rates
from hvt_edge.source.contract import BaseSize, Source, size_within
from hvt_edge.video.encoder import (
    ENCODERS,
    PASSTHROUGH,
    SLOWEST,
    X265,
    Encoder,
    EncoderPlan,
    keyframe_interval_s,
    keyframe_total_bps,
    payload_bps,
    usual_keyframe_bytes,
)
from hvt_edge.video.qualification import Allowed, allowed, headroom_of, run_frames
from hvt_edge.video.rate_model import (
    LEAST_SIDE_PX,
    PROMPT,
    SPARING,
    FrameSkip,
    MeasuredFrameSkip,
    choose_base,
    most_decimation,
    sizes_of,
)
from hvt_edge.video.reconfigure import EncoderReconfiguration
from hvt_edge.video.stage import BaseStage

_log = logging.getLogger(__name__)

_MOST_ENCODER_THREADS = 4  # a 720p picture has twelve rows of blocks, each some steps behind the one above
_AUTO_LEAST_FPS = 7.5
"""With ``--profile auto``: larger frames arrive later, and the user has not asked for delay. Fewer only where a
frame then still takes less time than a keyframe."""
_MOST_SILENT_S = 10
"""After this many seconds without a frame a live source has no scene to try an encoder on."""
_REST_S = 10.0
"""Least seconds between two decisions of ``--fps auto``."""
_AUTO_WINDOW_S = 1.0
"""Window of its measurement with ``--profile auto``."""


class Camera(Protocol):
    """A source whose own units are sent (``--encoder passthrough``), as it was surveyed before the flight."""

    fps: float
    keyframe_s: float
    """The longest time from one keyframe to the next."""
    needed_bps: int
    """The least rate of the link with which its fullest window has room."""

    def qualify(self, limit: Allowed) -> None:
        """Log the measurement. Raises `UserError` where it exceeds the limit."""

    def make_stage(
        self,
        encoder: Encoder,
        reconfiguration: EncoderReconfiguration,
        *,
        pause: Callable[[int], int] | None,
        **parts: Any,
    ) -> BaseStage:
        """The stage that sends the units; ``parts`` are those of every `BaseStage`."""
        ...


class Passthrough(Protocol):
    """The extra's entry point. Called with the `EncoderSettings` it makes an `Encoder`."""

    def open_source(self, spec: str, **settings: Any) -> Source:
        """As `hvt_edge.source.opening.open_source`; each frame has its `CameraUnit`."""
        ...

    def survey(self, config: EdgeConfig, source: Source) -> Camera:
        """Raises `UserError` where its units cannot be the base stream."""
        ...


def passthrough() -> Passthrough:
    entry = the_one(ENCODERS, PASSTHROUGH, what="encoder", built_in=False)
    assert entry is not None, "config.check() refuses an encoder that is not installed"
    return cast("Passthrough", loaded(entry, lambda found: found, what="encoder"))


def surveyed(config: EdgeConfig, source: Source) -> tuple[EdgeConfig, Camera | None]:
    """The settings with the camera's frame rate, and the camera; None where an encoder codes the frames."""
    if not config.passes_through:
        return config, None
    camera = passthrough().survey(config, source)
    return replace(config, fps=camera.fps), camera


def base_size(config: EdgeConfig) -> BaseSize:
    """The base stream's size, or the function that gives it from the source's size."""
    if config.fixed_size is not None:
        return config.fixed_size
    if config.passes_through:
        return lambda source_size: source_size
    if config.size is None:
        fit = cast("Fit", config.fit)
        return lambda source_size: _affordable(config, default_size(source_size, fit=fit))
    return lambda source_size: _affordable(config, _chosen(config, source_size, size=None)[0])


def say_size(config: EdgeConfig, view: View) -> None:
    """Log it where the budget has made the picture smaller than its default."""
    if config.size is not None or config.passes_through:
        return
    usual = default_size(view.source_size, fit=cast("Fit", config.fit))
    if view.base_size != usual:
        least_bps = least_budget_bps(config, usual, share=config.share)
        logging.getLogger(START_LOGGER).info(
            "video is %dx%d: %dx%d takes a --budget of at least %s",
            *view.base_size,
            *usual,
            bitrate_text(least_bps),
        )


def _affordable(config: EdgeConfig, size: tuple[int, int]) -> tuple[int, int]:
    # This size, or the largest below it that the budget carries; the smallest where it carries none.
    if config.budget_bps >= least_budget_bps(config, size, share=config.share) or min(size) < LEAST_SIDE_PX:
        return size
    smaller = [one for one in sizes_of(size) if one[0] * one[1] < size[0] * size[1]] or [size]
    affordable = (
        one for one in smaller if config.budget_bps >= least_budget_bps(config, one, share=config.share)
    )
    return next(affordable, smaller[-1])


def default_size(source_size: tuple[int, int], *, fit: Fit) -> tuple[int, int]:
    """The default of ``--size``: at most 1280x720, and never larger than the source.

    With ``letterbox`` it has the source's aspect ratio, which leaves no border; ``crop`` cuts to that of 1280x720.
    """
    box = (min(source_size[0], DEFAULT_SIZE[0]), min(source_size[1], DEFAULT_SIZE[1]))
    return size_within(source_size if fit == "letterbox" else DEFAULT_SIZE, box)


def first_decimation(config: EdgeConfig, size: tuple[int, int]) -> int:
    """The n at the start: each n-th source frame is coded."""
    return _chosen(config, size, size=size)[1]


def _chosen(
    config: EdgeConfig, source_size: tuple[int, int], *, size: tuple[int, int] | None
) -> tuple[tuple[int, int], int]:
    likely_size = size or min(source_size, DEFAULT_SIZE)
    rate_bps = payload_bps(config.base_bps, size=likely_size, fps=config.nominal_fps, edge_id=config.edge_id)
    return choose_base(
        rate_bps,
        source_size,
        size=size,
        fps=None if config.auto_fps else config.nominal_fps,
        most_fps=config.nominal_fps,
        least_fps=_least_fps(config, likely_size),
    )


def _least_fps(config: EdgeConfig, size: tuple[int, int]) -> float:
    # The lowest rate of coded frames that is chosen; a thin link may enforce less.
    if not config.measures:
        return LEAST_FPS
    keyframes_fps = config.budget_bps / (8 * usual_keyframe_bytes(size))
    return max(LEAST_FPS, min(_AUTO_LEAST_FPS, keyframes_fps))


def make_frame_skip(
    config: EdgeConfig, decimation: int, *, size: tuple[int, int], least_decimation: Callable[[], int]
) -> FrameSkip:
    if not config.auto_fps:
        return FrameSkip(decimation, least_decimation=least_decimation)
    most = most_decimation(config.nominal_fps, least_fps=_least_fps(config, size))
    return MeasuredFrameSkip(
        decimation,
        most_decimation=most,
        rest_frames=round(_REST_S * config.nominal_fps),
        window_frames=round((_AUTO_WINDOW_S if config.measures else _REST_S) * config.nominal_fps),
        band=PROMPT if config.measures else SPARING,
        own_keyframes=config.measures,
        least_decimation=least_decimation,
    )


def first_rates(config: EdgeConfig, decimation: int) -> Rates:
    """The rates at the start, where each n-th source frame is coded."""
    return Rates(config.budget_bps, config.base_bps, decimation)


def encoder_plan(config: EdgeConfig, size: tuple[int, int], *, headroom: float = 1.0) -> EncoderPlan:
    """The settings with which encoders are opened; several threads only where bytes need not repeat."""
    return EncoderPlan(
        name=config.encoder,
        size=size,
        nominal_fps=config.nominal_fps,
        edge_id=config.edge_id,
        window_s=config.window,
        metadata_bps=config.metadata_bps,
        threads=1 if config.pace == "lockstep" else min(_MOST_ENCODER_THREADS, os.cpu_count() or 1),
        headroom=headroom,
    )


def make_encoder(
    config: EdgeConfig, rates: Rates, *, size: tuple[int, int], preset: str = "", headroom: float = 1.0
) -> Encoder:
    """One encoder, with the ``preset`` of the settings unless another is given; with ``auto`` the slowest."""
    plan = encoder_plan(config, size, headroom=headroom)
    return plan.open(rates, preset=preset or (SLOWEST if config.preset == AUTO else config.preset))


def _allowed(config: EdgeConfig, size: tuple[int, int], rates: Rates) -> Allowed:
    return allowed(
        size=size,
        fps=config.nominal_fps / rates.decimation,
        total_bps=max(rates.total_bps - config.metadata_bps, rates.base_bps),
        base_bps=rates.base_bps,
        window_s=config.window,
    )


def qualify_encoder(
    config: EdgeConfig,
    source: Source,
    camera: Camera | None,
    *,
    clock: Callable[[], int],
    stop: threading.Event,
) -> float:
    """The share of its rate to set at the encoder, from three seconds of the scene; 1 for x265, without a run.

    A passed-through camera was surveyed when it was opened.
    Raises `UserError` with the measurement where it would exceed the budget. A clip begins anew after it.
    """
    if config.encoder == X265:
        return 1.0
    size = source.view.base_size
    if camera is not None:
        camera.qualify(_allowed(config, size, first_rates(config, 1)))
        return 1.0
    rates = first_rates(config, decimation := first_decimation(config, size))
    limit = _allowed(config, size, rates)
    count = run_frames(config.nominal_fps / decimation, limit)
    headroom = headroom_of(
        config.encoder,
        open_at=lambda share: make_encoder(config, rates, size=size, headroom=share),
        scene=lambda: scene(source, decimation=decimation, count=count, clock=clock, stop=stop),
        frames=count,
        limit=limit,
        edge_id=config.edge_id,
    )
    if headroom < 1:
        _log.warning(
            "encoder %s overshoots: it is set to %.0f %% of its rate", config.encoder, 100 * headroom
        )
    return headroom


def scene(
    source: Source, *, decimation: int, count: int, clock: Callable[[], int], stop: threading.Event
) -> Iterator[Frame]:
    """The first ``count`` of each n-th frame, to try an encoder on. A clip begins anew after it."""
    silent = coded = 0
    for frame in source.steps(start_ns=clock()):
        silent += frame is None
        if frame is not None and frame.index % decimation == 0:
            coded += 1
            yield frame
        if stop.is_set() or coded == count or silent > _MOST_SILENT_S:
            return


def make_reconfiguration(
    config: EdgeConfig, operating: Operating, size: tuple[int, int], **parts: Any
) -> EncoderReconfiguration:
    """Make the part that changes rates in flight; ``parts`` are the further parts that it needs."""
    return EncoderReconfiguration(
        operating,
        size=size,
        nominal_fps=config.nominal_fps,
        least_fps=LEAST_FPS,
        edge_id=config.edge_id,
        metadata_bps=config.metadata_bps,
        min_budget_bps=least_rate_bps(config, size),
        **parts,
    )


def least_rate_bps(config: EdgeConfig, size: tuple[int, int]) -> int:
    """The floor of the link's rate, unless the budget itself is lower.

    No keyframe can be smaller than `keyframe_floor_bytes`. If the rate fell below a keyframe's need, none would be
    sent; then nothing arrives, and a rate that grows with arrivals never grows again. The need of a camera's own
    units is measured (`Camera.needed_bps`).
    """
    if config.passes_through:
        return config.min_budget_bps
    needed_bps = keyframe_total_bps(
        size, window_s=config.window, metadata_bps=config.metadata_bps, edge_id=config.edge_id
    )
    return max(config.min_budget_bps, needed_bps)


def make_keyframes(config: EdgeConfig, camera: Camera | None) -> Keyframes:
    """The control of keyframes, on a long schedule and on demand; a camera makes its own."""
    if camera is not None:
        return Keyframes(KeyframeSettings(interval_ns=0, camera_every_s=camera.keyframe_s))
    interval_s = config.keyframe_interval
    if isinstance(interval_s, str):
        interval_s = keyframe_interval_s(config.fixed_size or DEFAULT_SIZE, config.base_bps)
    return Keyframes(KeyframeSettings(interval_ns=round(interval_s * SECOND_NS)))
