"""A session's perception, from the settings: live, and of stored video.

Both trust the view alike. Stored video touches neither the tracks of the open session nor a detector's memory.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, cast

import numpy as np
import numpy.typing as npt

from hvt_common.inference.detect import FailingDetector, detect_every, detect_still_every
from hvt_common.inference.retried import RetriedDetector
from hvt_common.inference.scale_search import ScaleSearch
from hvt_common.inference.store import EMBEDDED_DETECTOR
from hvt_common.inference.tiles import searches_scale
from hvt_common.inference.view_trust import ViewTrust
from hvt_common.protocol.messages import Info
from hvt_common.runtime.failures import Turns
from hvt_common.tracking.bytetrack import ByteTracker
from hvt_common.tracking.settings import TrackerSettings
from hvt_common.values import Detections, Image
from hvt_ground.config import GroundConfig
from hvt_ground.events import Event, Overlay, Refinement
from hvt_ground.perception.fusion.entity import CameraPath
from hvt_ground.perception.fusion.fuse import Fusion, unified_names
from hvt_ground.perception.guesses import Guesses
from hvt_ground.perception.history import History
from hvt_ground.perception.models import Models
from hvt_ground.perception.pipeline import Pipeline
from hvt_ground.perception.stills.classify import CropReader, NoReader, StillReader
from hvt_ground.perception.stills.decode import ReceivedStill
from hvt_ground.perception.stills.refine import Refiner, ViewTilt
from hvt_ground.perception.stills.stage import Progress, StillStage
from hvt_ground.perception.stills.vocabulary import Vocabulary

FIRST_TRACK_ID = 1_000_001
"""Id of the first track in stored video: these tracks are others than those of the live stream."""

Emit = Callable[[Event], None]


class SessionPerception:
    """Makes one session's `pipeline` for live messages; `track` and `read` take stored ones, in one thread."""

    def __init__(self, config: GroundConfig, models: Models, info: Info) -> None:
        self._config, self._models, self._info = config, models, info
        self._trust = ViewTrust(models.facts.trust_from, hence="are drawn thin and unnamed")
        self.tilt = ViewTilt(vague_kinds=config.detector == EMBEDDED_DETECTOR)
        """Whether the view is steep or aslant."""
        self._detect_every = detect_every(config.detect_every, fps=info.fps)
        self._next_id = FIRST_TRACK_ID

    def pipeline(self, emit: Emit) -> Pipeline:
        config, models, info = self._config, self._models, self._info
        detector, reader = self._taken()
        names, edge_classes = unified_names(detector.class_names, info.class_names)
        return Pipeline(
            detector=detector,
            detector_thread=models.detector_thread,
            tracker=self._tracker(),
            reader=reader,
            refiner=Refiner(
                cast('Literal["replace", "fuse"]', config.refine),
                fps=info.fps,
                vocabulary=Vocabulary(names, reader.class_names, kinds=config.refine == "replace"),
                calibrated=models.facts.stills_calibrated,
                tilt=self.tilt,
            ),
            fusion=self._fusion(edge_classes, CameraPath(ahead_frames=max(1, round(info.fps)))),
            trust=self._trust,
            view=info.view,
            fps=info.fps,
            detect_every=self._detect_every,
            detect_still_every=detect_still_every(config.detect_every, fps=info.fps),
            emit=emit,
            edge_alike=info.class_names == detector.class_names,
            guesses=self._guesses(),
            search=self._scale_search(detector),
            turns=Turns(f"perception of {info.edge}", models.failures),
        )

    def track(self, emit: Emit) -> Callable[[int, int, Image], None]:
        """A function that detects and tracks along one stretch of video, given frame index, capture time and picture.

        Tracks that would be doubted live are doubted there.
        """
        (detector, _), tracker, guesses = self._taken(), self._tracker(), self._guesses()
        every, before = self._detect_every, self._next_id - 1
        detected: int | None = None

        def analyze(frame_index: int, capture_ns: int, image_bgr: Image) -> None:
            nonlocal detected
            if detected is None or frame_index - detected >= every:
                detected = frame_index
                found = detector.detect(image_bgr) or Detections.none()
                self._trust.take(found)
                tracks = tracker.update(found, frame_index=frame_index, image=image_bgr)
                self.tilt.take(tracks, detector.class_names, height_px=image_bgr.shape[0])
            else:
                tracks = tracker.predict(frame_index=frame_index, image=image_bgr)
            ids = tracks.ids + before
            self._next_id = max(self._next_id, int(ids.max(initial=0)) + 1)
            names = tuple(detector.class_names[class_id] for class_id in tracks.class_ids)
            doubted = np.full(len(tracks), self._trust.unlike)
            vague = np.array([self.tilt.is_vague(name) for name in names], np.bool_)
            if guesses is not None:
                guesses.update(tracks, names, tracker.camera_step)
                doubted |= guesses.among(tracks.ids)
                vague &= ~guesses.agreed(tracks.ids, names, aslant=self.tilt.aslant)
            emit(
                Overlay(
                    frame_index=frame_index,
                    capture_ns=capture_ns,
                    track_ids=ids,
                    boxes_base_px=tracks.boxes_xyxy_px,
                    base_classes=names,
                    classes=names,
                    confidences=tracks.confidences,
                    refined=np.zeros(len(tracks), np.bool_),
                    stored=True,
                    doubted=doubted,
                    vague=vague,
                )
            )

        return analyze

    def read(self, still: ReceivedStill, *, emit: Emit) -> None:
        """Decode, name and give out a still of a session that is over: no track of it is here to be matched."""
        info, guesses = self._info, self._guesses()
        detector, reader = self._taken()
        names, edge_classes = unified_names(detector.class_names, info.class_names)
        alike = info.class_names == detector.class_names

        def doubting(event: Event) -> None:
            if guesses is not None and isinstance(event, Refinement):
                event = guesses.doubting(event, unlike=alike and self._trust.unlike)
            emit(event)

        stage = StillStage(
            reader,
            Refiner("fuse", fps=info.fps, vocabulary=Vocabulary(names, reader.class_names), tilt=self.tilt),
            history=History(),
            fusion=self._fusion(edge_classes, CameraPath(ahead_frames=1)),
            view=info.view,
            gap_frames=1,
            emit=doubting,
        )
        header = still.header
        moment = Progress(header.frame_index, header.capture_ns, picture_index=header.frame_index)
        stage.take([still], moment)
        stage.end(moment)

    def _taken(self) -> tuple[FailingDetector, StillReader]:
        detector, classifier = self._models.take()
        view = self._info.view
        if classifier is not None:
            return detector, CropReader(classifier, view=view)
        redetection = self._models.facts.redetection
        return detector, NoReader() if redetection is None else redetection(detector, view=view)

    def _fusion(self, edge_classes: npt.NDArray[np.int32], path: CameraPath) -> Fusion:
        info = self._info
        return Fusion(fps=info.fps, edge_classes=edge_classes, path=path, base_per_source=info.view.scale)

    def _guesses(self) -> Guesses | None:
        info = self._info
        return Guesses(fps=info.fps, scale=info.view.scale) if self._models.facts.calibrated else None

    def _scale_search(self, detector: FailingDetector) -> ScaleSearch | None:
        # Its promises are sums of probabilities. The hint that little is found counts pictures, not their parts.
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
