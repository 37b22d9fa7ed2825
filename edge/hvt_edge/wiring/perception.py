"""Perception and stills, from the settings: the detector, the analyzer, and the parts that choose and code stills."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Literal, cast

import numpy as np

from hvt_common.errors import UserError, foreign
from hvt_common.inference.detect import (
    Detector,
    FailingDetector,
    detect_every,
    detect_still_every,
    open_detector,
    warm_up,
)
from hvt_common.inference.labels import declared_class_names, default_confidence, is_calibrated, uncalibrated
from hvt_common.inference.retried import without_tiles
from hvt_common.inference.scale_search import ScaleSearch
from hvt_common.inference.store import MOTION
from hvt_common.inference.tiles import parse_tiles, searches_scale, tiled
from hvt_common.inference.view_trust import ViewTrust
from hvt_common.runtime.failures import Failures, reason_of
from hvt_common.tracking.bytetrack import ByteTracker
from hvt_common.tracking.settings import TrackerSettings, weak_confidence
from hvt_common.values import Detections, Image, View
from hvt_common.video.still_codecs import still_codec
from hvt_edge.config import EdgeConfig
from hvt_edge.perception.analyzer import Analyzer
from hvt_edge.perception.cpu_budget import CpuBudget
from hvt_edge.perception.shadow import UNMEASURED, Shadow, ShadowGround
from hvt_edge.stills.maker import StillMaker
from hvt_edge.stills.policy.base import Method
from hvt_edge.stills.policy.registry import METHODS, method, tuning
from hvt_edge.stills.scheduler import Suppression

_log = logging.getLogger(__name__)

_UNKNOWN = ("object",)
_TRIAL_PX = 48
_LEAST_STILL_BYTES = 400
_DETAIL = "detail_weight"
_FINER = 0.5
"""Limit of `_hidden_pixels`."""
_DETAIL_WEIGHT = 5.0
"""If the base has none of the source's pixels, details count for more than a class (docs/legibility.md)."""


def make_detector(config: EdgeConfig, failures: Failures | None = None) -> Detector:
    """Open the detector, with weak detections included: they may carry a track on, though not start one."""
    detector = open_detector(
        config.detector,
        labels=config.labels,
        confidence=weak_confidence(track_confidence(config)),
        nms_iou=config.nms_iou,
        head=config.head,
        threads=config.threads,
        # By speed auto may choose one provider this time and another the next, and their answers differ a little.
        provider="cpu" if config.pace == "lockstep" and config.provider == "auto" else config.provider,
        failures=failures,
    )
    return tiled(detector, config.tiles) if config.candidates == "source" else detector


def open_for_flight(
    config: EdgeConfig, open_detector: Callable[[], Detector], warm_up: Callable[[Detector], None]
) -> Detector:
    """Open the detector and warm it up; or put that off to its first use, if it may never be used.

    A method without stills needs no tracks, unless they are sent, or a ground requests them in flight.
    """
    needed = config.tracks_used or not method(config.method).video_only or config.labels is not None
    class_names = None if needed else declared_class_names(config.detector)
    if class_names is not None:
        return _OpenedOnUse(open_detector, class_names)
    detector = open_detector()
    warm_up(detector)
    return detector


def unopened(config: EdgeConfig, open_detector: Callable[[], Detector]) -> Detector:
    """A stand-in for a detector that is still being opened when the flight ends: nothing is searched any more."""
    return _OpenedOnUse(open_detector, declared_class_names(config.detector) or _UNKNOWN)


def warm_up_for(config: EdgeConfig, detector: Detector, view: View) -> None:
    """Run the detector once on a picture of the flight's shape: a runtime may compile for each shape.

    Raises `UserError` where it does not run.
    """
    if config.detector != MOTION and not is_calibrated(config.detector, role="detector"):
        _log.warning("%s", uncalibrated("detector", config.detector))
    whole = config.candidates == "source" and not view.enlarges
    try:
        works, why = (
            warm_up(detector, view.source_size if whole else view.base_size),
            "none of its networks does",
        )
    except UserError:
        raise
    except foreign() as error:
        works, why = False, reason_of(error)
    if not works:
        raise UserError(f"detector {config.detector} does not run ({why}): choose another with --detector")


def make_analyzer(
    config: EdgeConfig,
    *,
    detector: FailingDetector,
    view: View,
    trust: ViewTrust | None = None,
    cpu_budget: CpuBudget | None = None,
) -> Analyzer:
    """Decoder, detector and tracker of the edge's own stream; without ``cpu_budget``, as in a trial, unlimited."""
    still_every = detect_still_every(config.detect_every, fps=config.nominal_fps)
    settings = TrackerSettings.starting_at(
        track_confidence(config), camera_motion=cast('Literal["off", "flow"]', config.camera_motion)
    )
    return Analyzer(
        detector,
        ByteTracker(settings, fps=config.nominal_fps),
        view=view,
        detect_every=detect_every(config.detect_every, fps=config.nominal_fps),
        candidates=cast('Literal["decoded", "source"]', config.candidates),
        detect_still_every=0 if cpu_budget is None else still_every,
        trust=trust,
        search=_scale_search(config, detector),
        cpu_budget=cpu_budget,
        reduces=parse_tiles(config.tiles) in {"auto", "off"},  # tiles of one's own are meant
    )


def _scale_search(config: EdgeConfig, detector: FailingDetector) -> ScaleSearch | None:
    # The gain that a scale promises is a sum of probabilities.
    if not searches_scale(config.tiles, pace=config.pace) or not is_calibrated(
        config.detector, role="detector"
    ):
        return None
    return ScaleSearch(without_tiles(detector), confidence=track_confidence(config))


def make_shadow(
    config: EdgeConfig,
    detector: FailingDetector,
    *,
    before: Shadow = UNMEASURED,
    cpu_budget: CpuBudget | None = None,
) -> ShadowGround | None:
    """The shadow ground, which measures how much of the source the base shows; None where nothing depends on it.

    It continues from the measurements of ``before``.

    `MOTION` remembers the pictures of one stream, and the base's pictures are another stream.
    """
    if not config.measures or config.detector == MOTION:
        return None
    return ShadowGround(
        without_tiles(detector), confidence=track_confidence(config), before=before, cpu_budget=cpu_budget
    )


def track_confidence(config: EdgeConfig) -> float:
    """Confidence at which a detection starts a track: as given, else as the detector's file says."""
    return default_confidence(config.detector) if config.confidence is None else config.confidence


def check_codecs(config: EdgeConfig) -> None:
    """Code a picture once: raises `UserError` if a library behind a codec does not work."""
    ramp = np.arange(_TRIAL_PX, dtype=np.uint8)
    crop = np.stack(np.broadcast_arrays(4 * ramp[:, None], 4 * ramp, np.uint8(90)), axis=2)
    for flag, name in (("still-codec", config.still_codec), ("fallback-codec", config.fallback_codec)):
        codec = still_codec(name)
        base = crop // 2 if codec.needs_base else None
        try:
            coded = codec.encode(crop, quality_pct=config.jpeg_quality, base_bgr=base)
            codec.decode(coded.data, size=(_TRIAL_PX, _TRIAL_PX), parameters=coded.parameters, base_bgr=base)
        except foreign() as error:
            raise UserError(
                f"--{flag} {name} does not work here ({error}): choose another, such as jpeg"
            ) from error
        if not still_codec(config.still_codec).needs_base:
            return  # no fallback is used


def make_method(config: EdgeConfig, view: View, *, name: str | None = None) -> Method:
    """The method of the settings, or another by its name.

    With auto, details count in proportion to the pixels that the base lacks. Raises `UserError` for an unknown name.
    """
    own = method(config.method)
    policy = own if name is None else method(name)
    parameters = tuning(config.tune) if policy.name == own.name else {}
    if config.measures and _DETAIL in METHODS[policy.name].parameters:
        parameters.setdefault(_DETAIL, _DETAIL_WEIGHT * _hidden_pixels(view))
    return method(policy.name, **parameters)


def shows_details(config: EdgeConfig, view: View) -> bool:
    """Whether stills are worth sending for pixels that the base does not have."""
    return _hidden_pixels(view) > _FINER and getattr(make_method(config, view), _DETAIL, 0) > 0


def _hidden_pixels(view: View) -> float:
    # 0…1: the share of the source's pixels that have no pixel of their own in the base.
    return max(0.0, 1 - view.scale**2)


def make_suppression(config: EdgeConfig) -> Suppression:
    return Suppression.for_cooldown(config.cooldown, min_gain=config.min_gain)


def make_maker(config: EdgeConfig, *, readable: Callable[[str], bool]) -> StillMaker:
    codec = still_codec(config.still_codec)
    return StillMaker(
        codec=codec,
        fallback=still_codec(config.fallback_codec) if codec.needs_base else None,
        quality_pct=config.jpeg_quality,
        fidelity_db=config.fidelity,
        padding=config.padding,
        # Other codecs have a lowest quality; a codec that builds on the base would fit any number of bytes.
        least_bytes=_LEAST_STILL_BYTES if codec.needs_base else 0,
        readable=readable,
    )


class _OpenedOnUse:
    # A detector that is opened at its first use, for edges that may never use it; its class names are known.

    def __init__(self, open_detector: Callable[[], Detector], class_names: tuple[str, ...]) -> None:
        self._open = open_detector
        self._opened: Detector | None = None
        self.class_names = class_names

    def detect(self, image_bgr: Image) -> Detections:
        self._opened = self._opened or self._open()
        return self._opened.detect(image_bgr)
