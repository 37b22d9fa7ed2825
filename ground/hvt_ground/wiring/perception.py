"""A session's perception: pipeline, tracker and reader of stills, from the settings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, cast

from hvt_common.inference.classify import Classifier
from hvt_common.inference.detect import FailingDetector, detect_every, detect_still_every
from hvt_common.inference.retried import RetriedDetector
from hvt_common.inference.scale_search import ScaleSearch
from hvt_common.inference.store import EMBEDDED_DETECTOR
from hvt_common.inference.tiles import searches_scale
from hvt_common.inference.view_trust import ViewTrust
from hvt_common.protocol.messages import Info
from hvt_common.tracking.bytetrack import ByteTracker, TrackerSettings
from hvt_ground.backlog.perception import BacklogPerception
from hvt_ground.config import DETECTOR, GroundConfig
from hvt_ground.events import Event
from hvt_ground.perception.fusion.camera_path import CameraPath
from hvt_ground.perception.fusion.fuse import Fusion, unified_names
from hvt_ground.perception.guesses import Guesses
from hvt_ground.perception.models import Models
from hvt_ground.perception.pipeline import Pipeline, PipelineParts
from hvt_ground.perception.stills.classify import CropReader, NoReader, Redetection, StillReader
from hvt_ground.perception.stills.refine import Refiner, ViewTilt
from hvt_ground.perception.stills.vocabulary import Vocabulary


class SessionPerception:
    """Makes what perceives one session, live and from its backlog: both trust the view alike."""

    def __init__(self, config: GroundConfig, models: Models, info: Info) -> None:
        self._config, self._models, self._info = config, models, info
        self._trust = ViewTrust(config.detector, hence="are drawn thin and unnamed")
        self._tilt = ViewTilt(vague_kinds=config.detector == EMBEDDED_DETECTOR)

    def pipeline(self, emit: Callable[[Event], None]) -> Pipeline:
        """Make the pipeline; waits for the models."""
        config, models, info = self._config, self._models, self._info
        detector, classifier = models.take()
        reader = self._reader(detector, classifier)
        names, edge_classes = unified_names(detector.class_names, info.class_names)
        vocabulary = Vocabulary(names, reader.class_names, kinds=config.refine == "replace")
        path = CameraPath(ahead_frames=max(1, round(info.fps)))
        parts = PipelineParts(
            detector=detector,
            tracker=self._tracker(),
            reader=reader,
            refiner=Refiner(
                cast('Literal["replace", "fuse"]', config.refine),
                fps=info.fps,
                vocabulary=vocabulary,
                calibrated=models.facts.stills_calibrated,
                tilt=self._tilt,
            ),
            vocabulary=vocabulary,
            fusion=Fusion(
                fps=info.fps, edge_classes=edge_classes, path=path, base_per_source=info.view.scale
            ),
            path=path,
            detector_thread=models.detector_thread,
            trust=self._trust,
            guesses=self._guesses(),
            search=self._scale_search(detector),
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

    def stored(self) -> BacklogPerception:
        """Make the analyzer of stored video and stills."""
        return BacklogPerception(
            self._info,
            take_models=self._models.take,
            tracker_of=self._tracker,
            reader_of=self._reader,
            detect_every=detect_every(self._config.detect_every, fps=self._info.fps),
            trust=self._trust,
            tilt=self._tilt,
            guesses_of=self._guesses,
        )

    def _guesses(self) -> Guesses | None:
        return Guesses(fps=self._info.fps) if self._models.facts.calibrated else None

    def _scale_search(self, detector: FailingDetector) -> ScaleSearch | None:
        # What it promises are sums of probabilities. The hint that little is found counts pictures, not their parts.
        facts = self._models.facts
        if not facts.calibrated or not searches_scale(self._config.tiles, pace=self._info.pace):
            return None
        detect = detector.detect_whole if isinstance(detector, RetriedDetector) else detector.detect
        return ScaleSearch(detect, confidence=facts.track_confidence)

    def _tracker(self) -> ByteTracker:
        motion = cast('Literal["off", "flow"]', self._config.camera_motion)
        confidence = self._models.facts.track_confidence
        settings = TrackerSettings.starting_at(confidence, camera_motion=motion)
        return ByteTracker(settings, fps=self._info.fps)

    def _reader(self, detector: FailingDetector, classifier: Classifier | None) -> StillReader:
        view = self._info.view
        if classifier is not None:
            return CropReader(classifier, view=view)
        if self._config.classifier == DETECTOR:
            return Redetection(detector, view=view)
        return NoReader()
