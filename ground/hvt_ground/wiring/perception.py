"""A session's perception: pipeline, tracker and reader of stills, from the settings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, cast

from hvt_common.inference.classify import Classifier
from hvt_common.inference.detect import FailingDetector, detect_every, detect_still_every
from hvt_common.inference.few_found import ViewTrust
from hvt_common.inference.retried import RetriedDetector
from hvt_common.inference.scale_search import ScaleSearch
from hvt_common.inference.store import EMBEDDED_DETECTOR
from hvt_common.inference.tiles import searches_scale
from hvt_common.protocol.messages import Info
from hvt_common.tracking.bytetrack import ByteTracker, TrackerSettings
from hvt_ground.backlog.perception import BacklogPerception
from hvt_ground.config import DETECTOR, GroundConfig
from hvt_ground.events import Event
from hvt_ground.perception.fusion.camera_path import CameraPath
from hvt_ground.perception.fusion.fuse import Fusion, unified_names
from hvt_ground.perception.guesses import Guesses
from hvt_ground.perception.models import ModelFacts, Models
from hvt_ground.perception.pipeline import Pipeline, PipelineParts
from hvt_ground.perception.stills.classify import CropReader, NoReader, Redetection, StillReader
from hvt_ground.perception.stills.refine import Refiner, ViewTilt
from hvt_ground.perception.stills.vocabulary import Vocabulary


def make_pipeline(
    config: GroundConfig,
    models: Models,
    *,
    info: Info,
    emit: Callable[[Event], None],
    trust: ViewTrust | None = None,
    tilt: ViewTilt | None = None,
) -> Pipeline:
    """The pipeline of one session; ``trust`` and ``tilt`` are of its view, and of what is stored of it too."""
    detector, classifier = models.take()
    reader = _reader(config, detector, classifier, info=info)
    names, edge_classes = unified_names(detector.class_names, info.class_names)
    vocabulary = Vocabulary(names, reader.class_names, kinds=config.refine == "replace")
    path = CameraPath(ahead_frames=max(1, round(info.fps)))
    parts = PipelineParts(
        detector=detector,
        tracker=_tracker(config, models.facts, info),
        reader=reader,
        refiner=Refiner(
            cast('Literal["replace", "fuse"]', config.refine),
            fps=info.fps,
            vocabulary=vocabulary,
            calibrated=models.facts.stills_calibrated,
            tilt=tilt or make_tilt(config),
        ),
        vocabulary=vocabulary,
        fusion=Fusion(fps=info.fps, edge_classes=edge_classes, path=path, base_per_source=info.view.scale),
        path=path,
        detector_thread=models.detector_thread,
        trust=trust or make_trust(config),
        guesses=_guesses(models.facts, info),
        search=_scale_search(config, models.facts, detector, info),
    )
    return Pipeline(
        parts,
        view=info.view,
        fps=info.fps,
        detect_every=detect_every(config.detect_every, fps=info.fps),
        detect_still_every=detect_still_every(
            config.detect_every, fps=info.fps, lockstep=info.pace == "lockstep"
        ),
        emit=emit,
        wants_base=isinstance(reader, Redetection),
    )


def make_trust(config: GroundConfig) -> ViewTrust:
    """How far the view of one session can be trusted."""
    return ViewTrust(config.detector, hence="are drawn thin and unnamed")


def make_tilt(config: GroundConfig) -> ViewTilt:
    """How the camera looks in one session."""
    return ViewTilt(vague_kinds=config.detector == EMBEDDED_DETECTOR)


def make_backlog_perception(
    config: GroundConfig, models: Models, *, info: Info, trust: ViewTrust, tilt: ViewTilt | None = None
) -> BacklogPerception:
    """Make the analyzer of the stored video and stills of a session."""
    return BacklogPerception(
        info,
        take_models=models.take,
        tracker_of=lambda: _tracker(config, models.facts, info),
        reader_of=lambda detector, classifier: _reader(config, detector, classifier, info=info),
        detect_every=detect_every(config.detect_every, fps=info.fps),
        trust=trust,
        tilt=tilt or make_tilt(config),
        guesses_of=lambda: _guesses(models.facts, info),
    )


def _guesses(facts: ModelFacts, info: Info) -> Guesses | None:
    return Guesses(fps=info.fps) if facts.calibrated else None


def _scale_search(
    config: GroundConfig, facts: ModelFacts, detector: FailingDetector, info: Info
) -> ScaleSearch | None:
    # What it promises are sums of probabilities. The hint that little is found counts pictures, not their parts.
    if not facts.calibrated or not searches_scale(config.tiles, pace=info.pace):
        return None
    detect = detector.detect_whole if isinstance(detector, RetriedDetector) else detector.detect
    return ScaleSearch(detect, confidence=facts.track_confidence)


def _tracker(config: GroundConfig, facts: ModelFacts, info: Info) -> ByteTracker:
    motion = cast('Literal["off", "flow"]', config.camera_motion)
    settings = TrackerSettings.starting_at(facts.track_confidence, camera_motion=motion)
    return ByteTracker(settings, fps=info.fps)


def _reader(
    config: GroundConfig, detector: FailingDetector, classifier: Classifier | None, *, info: Info
) -> StillReader:
    if classifier is not None:
        return CropReader(classifier, view=info.view)
    if config.classifier == DETECTOR:
        return Redetection(detector, view=info.view)
    return NoReader()
