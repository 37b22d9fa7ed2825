"""What one process of a comparison does: label some ticks, or fly one flight. Models stay open between them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from hvt_common.config import load
from hvt_common.errors import UserError
from hvt_common.inference.detect import MOTION, Detector, open_detector
from hvt_common.tracking.bytetrack import weak_confidence
from hvt_edge.config import EdgeConfig
from hvt_edge.config import check as check_edge
from hvt_edge.source.resample import Resizer
from hvt_ground.config import GroundConfig
from hvt_ground.config import check as check_ground
from hvt_study.cache.cached_detector import CachedDetector
from hvt_study.datasets.clip import Clip
from hvt_study.flights.flight import FlightPlan, FlightReport, fly
from hvt_study.flights.flight_ground import SharedModels
from hvt_study.metrics.list_score import Listed

__all__ = ["Job", "Refused", "RunContext", "class_names", "fly_job", "label_job", "prepare"]

_CONFIDENCE = 0.25
"""From which a detection counts, at the edge, at the ground and as a reference label."""


@dataclass(frozen=True, slots=True)
class RunContext:
    """What all jobs share."""

    clip: Clip
    cache: Path
    """A folder for detections."""
    detector: str
    edge_detector: str
    provider: str
    size: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Job:
    """One flight."""

    rate_bps: int
    flags: tuple[str, ...]
    fps: float | None = None
    """A fixed frame rate other than what the flags say."""


@dataclass(frozen=True, slots=True)
class Refused:
    """The edge does not take these settings."""

    reason: str


def prepare() -> None:
    """Once in each process: there are as many processes as cores to use."""
    cv2.setNumThreads(1)


def class_names(shop: RunContext) -> tuple[str, ...]:
    """Those of the ground's detector."""
    return _ground_detector(shop).class_names


def label_job(shop: RunContext, first: int, count: int) -> tuple[Listed, ...]:
    """Reference labels of some ticks, source pixels."""
    detector = _ground_detector(shop)
    resizer = Resizer(shop.clip.source_size, shop.size, fit="letterbox")
    labels = []
    for image in islice(shop.clip.images(), first, first + count):
        found = detector.detect(resizer.frame(np.asarray(image), index=0, capture_ns=0).base_bgr)
        sure = found.confidences >= _CONFIDENCE
        names = tuple(detector.class_names[kind] for kind in found.class_ids[sure].tolist())
        labels.append(Listed(resizer.view.to_source(found.boxes_xyxy_px[sure]), names))
    return tuple(labels)


def fly_job(shop: RunContext, job: Job) -> FlightReport | Refused:
    """Fly; what the edge cannot do is an answer, too."""
    try:
        plan = FlightPlan(
            clip=shop.clip, edge=edge_config(shop, job), ground=ground_config(shop), link_bps=job.rate_bps
        )
        return fly(plan, detector=_edge_detector(shop), models=SharedModels(_ground_detector(shop)))
    except UserError as error:
        return Refused(str(error))


def edge_config(shop: RunContext, job: Job) -> EdgeConfig:
    """The settings that a user of ``hvt-edge`` would give."""
    width, height = shop.size
    flags = ["--source", shop.clip.spec, "--pace", "lockstep", "--detector", shop.edge_detector]
    flags += ["--size", f"{width}x{height}", "--budget", f"{job.rate_bps}bps", "--threads", "1"]
    flags += ["--confidence", f"{_CONFIDENCE:g}", "--provider", shop.provider, *job.flags]
    if job.fps is not None:
        # The budget's window has to hold two frames.
        flags += ["--fps", f"{job.fps:g}", "--window", f"{max(1.0, 2 / job.fps):g}s"]
    config, _ = load(EdgeConfig, flags, program="hvt-edge", description="")
    return check_edge(config)


def ground_config(shop: RunContext) -> GroundConfig:
    """The ground of every flight: re-detection reads the stills, which are weighed with the votes of the base."""
    classifier = "none" if shop.detector == MOTION else "detector"
    return check_ground(
        replace(
            GroundConfig(),
            detector=shop.detector,
            classifier=classifier,
            refine="fuse",
            confidence=_CONFIDENCE,
            threads=1,
            provider=shop.provider,
        )
    )


def _ground_detector(shop: RunContext) -> Detector:
    return _open(shop.detector, shop.provider, shop.cache, "ground")


def _edge_detector(shop: RunContext) -> Detector:
    return _open(shop.edge_detector, shop.provider, shop.cache, "edge")


def _open(spec: str, provider: str, cache: Path, role: str) -> Detector:
    if spec == MOTION:  # it remembers pictures: a new one for each flight
        return open_detector(spec, confidence=weak_confidence(_CONFIDENCE))
    return _open_once(spec, provider, cache, role)


@lru_cache(maxsize=2)
def _open_once(spec: str, provider: str, cache: Path, role: str) -> Detector:
    """``role`` keeps the two sides' accounts apart where both run the same model; they share what is remembered."""
    del role
    return CachedDetector(spec, confidence=weak_confidence(_CONFIDENCE), provider=provider, folder=cache)
