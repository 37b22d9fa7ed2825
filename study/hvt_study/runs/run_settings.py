"""A run's settings as users of ``hvt-edge`` and ``hvt-ground`` would give them, and its flight."""

import json
from dataclasses import asdict, replace
from typing import Any

from hvt_common.config import load
from hvt_common.inference.labels import default_confidence
from hvt_edge.config import EdgeConfig
from hvt_edge.config import check as check_edge
from hvt_edge.profiles import REGIMES
from hvt_ground.config import GroundConfig
from hvt_ground.config import check as check_ground
from hvt_study.datasets.sequence import NOMINAL_FPS
from hvt_study.flights.flight import FlightPlan, FlightReport, dry_run, fly
from hvt_study.flights.flight_ground import SharedModels
from hvt_study.peers.dds import fly_dds
from hvt_study.peers.dds_regions import DdsSettings
from hvt_study.runs.methods import METHODS, Kind
from hvt_study.runs.run_context import RunContext
from hvt_study.runs.spec import ModelChoice, RunSpec
from hvt_study.runs.video_shape import VideoShape


def edge_flags(
    spec: RunSpec, *, budget_bps: int, shape: VideoShape, named: ModelChoice | None = None
) -> tuple[str, ...]:
    """The command line of ``hvt-edge`` without its source; a peer's settings in words of its own.

    The paths of ``spec`` can be opened from here: the detector's file says its default confidence. ``named`` is how
    the user named the models, to be used in the result; None: as ``spec`` does.
    """
    method = METHODS[spec.method]
    if method.kind is Kind.PEER:
        return (
            spec.method,
            f"{spec.size[0]}x{spec.size[1]}",
            f"{budget_bps}bps",
            str(_dds_settings(spec, shape.fps)),
        )
    width, height = shape.size or spec.size
    flags = [
        "--pace",
        "lockstep",
        "--detector",
        (named or spec.models).edge_detector,
        "--size",
        f"{width}x{height}",
    ]
    confidence = default_confidence(spec.models.edge_detector)
    flags += ["--budget", f"{budget_bps}bps", "--threads", "1", "--confidence", f"{confidence:g}"]
    flags += ["--provider", spec.models.provider, "--detect-every", f"{spec.detect_every}", *method.flags]
    if method.sends_stills:
        flags += ["--still-codec", spec.still_codec]
        if "--video-share" not in method.flags and spec.regime in REGIMES:
            flags += ["--video-share", f"{REGIMES[spec.regime].video_share:.6f}"]
    for parameter in spec.tune:
        flags += ["--tune", parameter]
    fps = shape.fps
    if fps is not None and fps != NOMINAL_FPS:
        # The budget's window has to hold two frames.
        flags += ["--fps", f"{fps:g}", "--window", f"{max(1.0, 2 / fps):g}s"]
    return tuple(flags)


def flight_plan(spec: RunSpec, context: RunContext, *, budget_bps: int, shape: VideoShape) -> FlightPlan:
    """The flight of this run at a budget; its link carries the rate of the regime, whatever the budget.

    Raises `UserError` where the edge does not take these settings.
    """
    flags = ["--source", context.sequence.clip.spec, *edge_flags(spec, budget_bps=budget_bps, shape=shape)]
    config, _ = load(EdgeConfig, flags, program="hvt-edge", description="")
    return FlightPlan(
        clip=context.sequence.clip,
        edge=check_edge(config),
        ground=_ground_config(spec),
        link_bps=spec.budget_bps,
    )


def flown(spec: RunSpec, context: RunContext, *, budget_bps: int, shape: VideoShape) -> FlightReport:
    if METHODS[spec.method].kind is Kind.PEER:
        return fly_dds(
            context.sequence.clip,
            budget_bps=budget_bps,
            link_bps=spec.budget_bps,
            size=spec.size,
            detector=context.detector,
            settings=_dds_settings(spec, shape.fps),
        )
    plan = flight_plan(spec, context, budget_bps=budget_bps, shape=shape)
    return fly(
        plan, detector=context.edge_detector, models=SharedModels(context.detector, context.classifier)
    )


def dry_run_bps(spec: RunSpec, context: RunContext, *, budget_bps: int, shape: VideoShape) -> float:
    """Line bits a second of a method that no ground's answer changes."""
    plan = flight_plan(spec, context, budget_bps=budget_bps, shape=shape)
    return dry_run(plan, detector=context.edge_detector)


def settings(
    spec: RunSpec, context: RunContext, *, budget_bps: int, shape: VideoShape, named: ModelChoice
) -> dict[str, Any]:
    """All settings of a flight, as JSON holds them, with its models as the user ``named`` them."""
    if METHODS[spec.method].kind is Kind.PEER:
        peer = {**asdict(_dds_settings(spec, shape.fps)), "budget_bps": budget_bps, "size": list(spec.size)}
        return {spec.method: peer}
    plan = flight_plan(spec, context, budget_bps=budget_bps, shape=shape)
    sides = {
        "edge": {**asdict(plan.edge), "detector": named.edge_detector},
        "ground": {**asdict(plan.ground), "detector": named.detector, "classifier": named.classifier},
    }
    known: dict[str, Any] = json.loads(json.dumps(sides, default=str))
    return known


def _dds_settings(spec: RunSpec, fps: float | None) -> DdsSettings:
    return DdsSettings(fps=fps or NOMINAL_FPS, confidence=default_confidence(spec.models.detector))


def _ground_config(spec: RunSpec) -> GroundConfig:
    return check_ground(
        replace(
            GroundConfig(),
            detector=spec.models.detector,
            classifier=spec.models.classifier,
            refine=spec.models.refine,
            confidence=default_confidence(spec.models.detector),
            detect_every=spec.detect_every,
            threads=1,
            provider=spec.models.provider,
        )
    )
