"""From settings to stages: everything at the ground that is made for one session and needs no network."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal, cast

from hvt_common.link.wire import Info
from hvt_common.vision.camera_motion import CameraMotion
from hvt_common.vision.classify import Classifier, open_classifier
from hvt_common.vision.detect import Detector, open_detector, warm_up
from hvt_common.vision.track import ByteTracker, TrackerSettings, weak_confidence
from hvt_ground.camera_path import CameraPath
from hvt_ground.classify_stills import CropReader, NoReader, Redetection, StillReader
from hvt_ground.config import DETECTOR, NONE, GroundConfig
from hvt_ground.events import Event
from hvt_ground.fuse import Fusion, unified_names
from hvt_ground.refine import Refiner
from hvt_ground.sight import GroundSight, SightParts

__all__ = ["Models", "make_sight", "output_path"]


_USUAL_SIZE = (1280, 720)
"""Of base streams; what an edge really sends is known only when its first picture waits to be seen."""


class Models:
    """Opens detector and classifier once to check them, then one set a session: they keep buffers and state."""

    def __init__(self, config: GroundConfig) -> None:
        self._config = config
        self._ready: tuple[Detector, Classifier | None] | None = self._open()

    def take(self) -> tuple[Detector, Classifier | None]:
        """A detector, and a classifier where one is wanted, that nobody else uses."""
        ready, self._ready = self._ready, None
        return ready or self._open()

    def _open(self) -> tuple[Detector, Classifier | None]:
        config = self._config
        detector = open_detector(
            config.detector,
            labels=config.detector_labels,
            confidence=weak_confidence(config.confidence),
            nms_iou=config.nms_iou,
            threads=config.threads,
            provider=config.provider,
        )
        warm_up(detector, _USUAL_SIZE)
        if config.classifier in (None, DETECTOR, NONE):
            return detector, None
        return detector, open_classifier(
            config.classifier, labels=config.labels, threads=config.threads, provider=config.provider
        )


def make_sight(
    config: GroundConfig, models: Models, *, info: Info, emit: Callable[[Event], None]
) -> GroundSight:
    """The eyes of one session."""
    detector, classifier = models.take()
    reader = _reader(config, detector, classifier, info=info)
    motion = cast('Literal["off", "flow", "ecc"]', config.camera_motion)
    names, edge_classes = unified_names(detector.class_names, info.class_names)
    path = CameraPath(ahead_ticks=max(1, round(info.fps)))
    parts = SightParts(
        detector=detector,
        tracker=ByteTracker(
            TrackerSettings.starting_at(config.confidence, camera_motion=motion), fps=info.fps
        ),
        reader=reader,
        refiner=Refiner(
            cast('Literal["replace", "fuse"]', config.refine),
            fps=info.fps,
            detector_classes=names,
            classifier_classes=reader.class_names,
        ),
        fusion=Fusion(fps=info.fps, edge_classes=edge_classes, path=path),
        path=path,
        camera=None if motion == "off" else CameraMotion(motion, scale=None),
    )
    return GroundSight(
        parts,
        view=info.view,
        fps=info.fps,
        detect_every=config.detect_every,
        emit=emit,
        wants_base=isinstance(reader, Redetection),
    )


def _reader(
    config: GroundConfig, detector: Detector, classifier: Classifier | None, *, info: Info
) -> StillReader:
    if classifier is not None:
        return CropReader(classifier, view=info.view)
    if config.classifier == DETECTOR:
        return Redetection(detector, view=info.view)
    return NoReader()


def output_path(wish: Path | None, *, suffix: str, edge: str, stamp: str, taken: set[Path]) -> Path:
    """Where a file of one session goes, and note it in ``taken``.

    ``wish`` is the file or folder that the user named; ``stamp`` the time of the session's beginning. A named file is
    written anew, but each session of this process gets one of its own: the first takes the name, others have the
    edge's id in it. A file that nobody named is never overwritten.
    """
    if wish is None or wish.is_dir() or wish.suffix != suffix:
        first = (wish or Path()) / f"hvt-{edge}-{stamp}{suffix}"
        further = first
    else:
        first, further = wish, wish.with_name(f"{wish.stem}-{edge}{suffix}")
    count, path = 1, first
    while path in taken or (path != wish and path.exists()):
        path = (
            further
            if count == 1 and further != first
            else further.with_name(f"{further.stem}-{count}{suffix}")
        )
        count += 1
    taken.add(path)
    return path
