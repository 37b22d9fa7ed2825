"""The detector and the analyzer, from the settings."""

from __future__ import annotations

from typing import Literal, cast

from hvt_common.inference.detect import Detector, open_detector, warm_up
from hvt_common.inference.tiles import tiled
from hvt_common.tracking.bytetrack import ByteTracker, TrackerSettings, weak_confidence
from hvt_common.values import View
from hvt_edge.config import EdgeConfig
from hvt_edge.perception.analyzer import Analyzer, AnalyzerSettings, FailingDetector


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


def make_analyzer(config: EdgeConfig, *, detector: FailingDetector, view: View) -> Analyzer:
    """Decoder, detector and tracker of the edge's own stream."""
    settings = TrackerSettings.starting_at(
        config.confidence, camera_motion=cast('Literal["off", "flow"]', config.camera_motion)
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
