"""Analyzes what was stored of one session: boxes in stretches of its video, and stills of one that is over.

Neither the tracks of the open session nor a detector's memory are touched.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hvt_common.inference.classify import Classifier
from hvt_common.inference.detect import FailingDetector
from hvt_common.inference.view_trust import ViewTrust
from hvt_common.protocol.messages import Info
from hvt_common.tracking.bytetrack import ByteTracker
from hvt_common.values import Detections, Image
from hvt_ground.events import Event, Overlay
from hvt_ground.perception.fusion.camera_path import CameraPath
from hvt_ground.perception.fusion.fuse import Fusion, unified_names
from hvt_ground.perception.guesses import Guesses
from hvt_ground.perception.history import History
from hvt_ground.perception.models import ModelSet
from hvt_ground.perception.stills.classify import StillReader
from hvt_ground.perception.stills.decode import ReceivedStill
from hvt_ground.perception.stills.refine import Refiner, ViewTilt
from hvt_ground.perception.stills.stage import Progress, StillStage
from hvt_ground.perception.stills.vocabulary import Vocabulary

FIRST_TRACK_ID = 1_000_001
"""Id of the first track in stored video: these tracks are others than those of the live stream."""

Emit = Callable[[Event], None]


class BacklogPerception:
    """Of one session. For one thread at a time.

    ``take_models`` gives detector and classifier, ``tracker_of`` makes a tracker for one stretch,
    ``reader_of`` makes what names stills of detector and classifier; ``trust`` and ``tilt`` are of the session's
    view, ``guesses_of`` of one stretch.
    """

    def __init__(
        self,
        info: Info,
        *,
        take_models: Callable[[], ModelSet],
        tracker_of: Callable[[], ByteTracker],
        reader_of: Callable[[FailingDetector, Classifier | None], StillReader],
        detect_every: int,
        trust: ViewTrust,
        tilt: ViewTilt | None = None,
        guesses_of: Callable[[], Guesses | None] = lambda: None,
    ) -> None:
        self._info = info
        self._take_models = take_models
        self._tracker_of = tracker_of
        self._reader_of = reader_of
        self._detect_every = detect_every
        self._trust = trust
        self.tilt = tilt or ViewTilt()
        self._guesses_of = guesses_of
        self._next_id = FIRST_TRACK_ID

    def track(self, emit: Emit) -> Callable[[int, int, Image], None]:
        """What detects and tracks along one stretch of video, given frame index, capture time and picture in order.

        What is doubted live is doubted there.
        """
        detector, tracker, guesses = self._take_models()[0], self._tracker_of(), self._guesses_of()
        before = self._next_id - 1
        detected: int | None = None

        def analyze(frame_index: int, capture_ns: int, image_bgr: Image) -> None:
            nonlocal detected
            if detected is None or frame_index - detected >= self._detect_every:
                detected = frame_index
                found = detector.detect(image_bgr) or Detections.none()
                self._trust.take(found)
                tracks = tracker.update(found, frame_index=frame_index, image_bgr=image_bgr)
                self.tilt.take(tracks, detector.class_names, height_px=image_bgr.shape[0])
            else:
                tracks = tracker.predict(frame_index=frame_index, image_bgr=image_bgr)
            ids = tracks.ids + before
            self._next_id = max(self._next_id, int(ids.max(initial=0)) + 1)
            names = tuple(detector.class_names[class_id] for class_id in tracks.class_ids)
            doubted = np.full(len(tracks), self._trust.unlike)
            if guesses is not None:
                guesses.update(tracks, names, tracker.camera_step)
                doubted |= guesses.among(tracks.ids)
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
                    vague=np.array([self.tilt.is_vague(name) for name in names], np.bool_),
                )
            )

        return analyze

    def read(self, still: ReceivedStill, *, emit: Emit) -> None:
        """Decode, name and give out a still of a session that is over: no track of it is here to be matched."""
        info = self._info
        detector, classifier = self._take_models()
        reader = self._reader_of(detector, classifier)
        names, edge_classes = unified_names(detector.class_names, info.class_names)
        vocabulary = Vocabulary(names, reader.class_names)
        stage = StillStage(
            reader,
            Refiner("fuse", fps=info.fps, vocabulary=vocabulary, tilt=self.tilt),
            vocabulary=vocabulary,
            history=History(),
            fusion=Fusion(
                fps=info.fps,
                edge_classes=edge_classes,
                path=CameraPath(ahead_frames=1),
                base_per_source=info.view.scale,
            ),
            view=info.view,
            wants_base=False,
            gap_frames=1,
            emit=emit,
        )
        header = still.header
        moment = Progress(header.frame_index, header.capture_ns, picture_index=header.frame_index)
        stage.take([still], moment)
        stage.end(moment)
