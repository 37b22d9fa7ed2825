"""Behind the entry point `hvt.encoders`: opens a camera whose own units are sent, checks it, builds its stage."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hvt_codecs.passthrough.sources import CodedLiveSource, CodedStreamGrabber, CodedVideoSource
from hvt_codecs.passthrough.stage import (
    CameraRates,
    LeastLink,
    PassthroughStage,
    about_keyframes,
    check_camera,
    measure_camera,
    needed_bps,
    unit_of,
)
from hvt_codecs.passthrough.stream import REENCODE, CameraStream
from hvt_common.errors import UserError
from hvt_common.runtime.log import START_LOGGER
from hvt_common.values import AccessUnit, Frame
from hvt_edge.config import EdgeConfig
from hvt_edge.source.contract import Source
from hvt_edge.source.opening import SourceKinds, is_demo, is_device, is_there, open_source, shown
from hvt_edge.video.encoder import Encoder, EncoderSettings
from hvt_edge.video.qualification import Allowed
from hvt_edge.video.reconfigure import EncoderReconfiguration
from hvt_edge.video.x265 import Region

_log = logging.getLogger(__name__)

_SAME_RATE = 0.02
"""Largest difference of a camera's rate from --fps: 29.97 is 30."""
_KINDS = SourceKinds(CodedStreamGrabber, CodedLiveSource, CodedVideoSource)


class Camera:
    """See `hvt_edge.wiring.Camera`. Raises `UserError` where its units cannot be the base stream."""

    def __init__(self, config: EdgeConfig, source: Source) -> None:
        name = shown(str(config.source))
        stream: CameraStream | None = getattr(source, "camera_stream", None)
        if stream is None:
            raise UserError(
                f"source {name} gives no video that is coded already, which --encoder passthrough takes: "
                f"{REENCODE}"
            )
        if not config.auto_fps and abs(config.nominal_fps / stream.fps - 1) > _SAME_RATE:
            raise UserError(
                f"source {name} gives {stream.fps:g} frames a second, --fps is {config.nominal_fps:g}, and "
                f"--encoder passthrough leaves none out: leave --fps out, or {REENCODE}"
            )
        self._config, self._name, self._stream = config, name, stream
        self._warning: str = getattr(source, "warning", "")
        measured = measure_camera(stream, window_s=config.window, edge_id=config.edge_id)
        self._surveyed_bytes = measured.window_bytes
        self.fps, self.keyframe_s = stream.fps, stream.keyframe_s
        self.needed_bps = needed_bps(
            self._surveyed_bytes, window_s=config.window, share=config.share, metadata_bps=config.metadata_bps
        )

    def qualify(self, limit: Allowed) -> None:
        config, stream, name = self._config, self._stream, self._name
        found = check_camera(name, stream, limit, budget_bps=config.budget_bps, edge_id=config.edge_id)
        logging.getLogger(START_LOGGER).info("%s", found)
        for warning in filter(None, (about_keyframes(name, stream), self._warning)):
            _log.warning("%s", warning)

    def make_stage(
        self,
        encoder: Encoder,
        reconfiguration: EncoderReconfiguration,
        *,
        pause: Callable[[int], int] | None,
        **parts: Any,
    ) -> PassthroughStage:
        config, pacer = self._config, reconfiguration.pacer
        in_flight, least_link = parts["transmitter"].in_flight, None
        if pacer is not None:
            least_link = LeastLink(
                config.floor_bps, unreported_bytes=lambda: in_flight.size_bytes if pacer.measures else 0
            )
        rates = CameraRates(
            reconfiguration,
            share=config.share,
            least_bps=config.min_budget_bps,
            surveyed_bytes=self._surveyed_bytes,
            window_s=config.window,
        )
        return PassthroughStage(encoder, rates=rates, least_link=least_link, pause=pause, **parts)


class Passthrough:
    """An `Encoder` that encodes nothing. The camera decides on keyframes, whatever is requested."""

    mean_qp = math.nan
    survey = Camera

    def __init__(self, settings: EncoderSettings) -> None:
        del settings

    def encode(self, frame: Frame, *, keyframe: bool = False, regions: Sequence[Region] = ()) -> AccessUnit:
        del keyframe, regions
        return unit_of(frame)

    @staticmethod
    def open_source(spec: str, **settings: Any) -> Source:
        """See `hvt_edge.source.opening.open_source`. Raises `UserError` for anything but coded video too."""
        kind = "the drawn demo" * is_demo(spec) or "a device" * is_device(spec)
        if kind := kind or "a folder" * is_there(spec, Path.is_dir):
            raise UserError(
                f"source {shown(spec)!r} is {kind}, and --encoder passthrough takes a video file or a stream that "
                f"is HEVC already: {REENCODE}"
            )
        return open_source(spec, kinds=_KINDS, **settings)
