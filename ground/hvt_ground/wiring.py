"""From settings to stages: everything at the ground that is made for one session and needs no network."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Literal, cast

from hvt_common.inference.classify import Classifier, open_classifier
from hvt_common.inference.detect import Detector, open_detector, warm_up
from hvt_common.protocol.messages import Info
from hvt_common.tracking.bytetrack import ByteTracker, TrackerSettings, weak_confidence
from hvt_common.tracking.camera_motion import CameraMotion
from hvt_ground.backlog.perception import BacklogPerception
from hvt_ground.config import DETECTOR, MOTION, NONE, GroundConfig
from hvt_ground.events import Event
from hvt_ground.perception.fusion.camera_path import CameraPath
from hvt_ground.perception.fusion.fuse import Fusion, unified_names
from hvt_ground.perception.pipeline import Pipeline, PipelineParts
from hvt_ground.perception.stills.classify import CropReader, NoReader, Redetection, StillReader
from hvt_ground.perception.stills.refine import Refiner

__all__ = ["Models", "backlog_path", "make_backlog_perception", "make_pipeline", "output_path"]


_USUAL_SIZE = (1280, 720)
"""Of base streams; what an edge really sends is known only when its first picture waits to be seen."""


_Set = tuple[Detector, Classifier | None]


class Models:
    """Opens detector and classifier once to check them; one set serves one session at a time, for its buffers."""

    def __init__(self, config: GroundConfig) -> None:
        self._config = config
        self._ready: list[_Set] = [self._open()]
        self._serving: dict[str, _Set] = {}
        """By edge, what the session that is open has."""

    def take(self, edge: str | None = None) -> _Set:
        """A detector, and a classifier where one is wanted, that no other session uses."""
        try:
            taken = self._ready.pop()
        except IndexError:
            taken = self._open()
        if edge is not None:
            self._serving[edge] = taken
        return taken

    def give_back(self, detector: Detector, classifier: Classifier | None) -> None:
        """Take them back from a session that has ended; a network keeps nothing of it, the motion detector does."""
        for edge, serving in list(self._serving.items()):
            if serving[0] is detector:
                del self._serving[edge]
        if self._config.detector != MOTION:
            self._ready.append((detector, classifier))

    @contextmanager
    def checkout(self, edge: str) -> Iterator[_Set]:
        """What the open session of an edge has, for something else that is done in the thread that sees for it.

        Only a motion detector is a new one: it keeps what it saw, and opening it costs nothing.
        """
        serving = self._serving.get(edge)
        if serving is None:
            taken = self.take()
            try:
                yield taken
            finally:
                self.give_back(*taken)
        elif self._config.detector == MOTION:
            yield self._open_detector(), serving[1]
        else:
            yield serving

    def pool(self, edge: str) -> ModelPool:
        """The same, for one edge."""
        return ModelPool(self, edge)

    def _open_detector(self) -> Detector:
        config = self._config
        return open_detector(
            config.detector,
            labels=config.detector_labels,
            confidence=weak_confidence(config.confidence),
            nms_iou=config.nms_iou,
            threads=config.threads,
            provider=config.provider,
        )

    def _open(self) -> _Set:
        config = self._config
        detector = self._open_detector()
        warm_up(detector, _USUAL_SIZE)
        if config.classifier in (None, DETECTOR, NONE):
            return detector, None
        return detector, open_classifier(
            config.classifier, labels=config.labels, threads=config.threads, provider=config.provider
        )


class ModelPool:
    """Lends what serves one edge. For the thread that sees."""

    def __init__(self, models: Models, edge: str) -> None:
        self._models = models
        self._edge = edge

    def checkout(self) -> AbstractContextManager[_Set]:
        """See `Models.checkout`."""
        return self._models.checkout(self._edge)


def make_pipeline(
    config: GroundConfig, models: Models, *, info: Info, emit: Callable[[Event], None]
) -> Pipeline:
    """The pipeline of one session."""
    detector, classifier = models.take(info.edge)
    reader = _reader(config, detector, classifier, info=info)
    motion = cast('Literal["off", "flow", "ecc"]', config.camera_motion)
    names, edge_classes = unified_names(detector.class_names, info.class_names)
    path = CameraPath(ahead_frames=max(1, round(info.fps)))
    parts = PipelineParts(
        detector=detector,
        tracker=_tracker(config, info),
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
        release=lambda: models.give_back(detector, classifier),
    )
    return Pipeline(
        parts,
        view=info.view,
        fps=info.fps,
        detect_every=config.detect_every,
        emit=emit,
        wants_base=isinstance(reader, Redetection),
    )


def make_backlog_perception(config: GroundConfig, models: Models, *, info: Info) -> BacklogPerception:
    """What looks at what was kept of a session."""
    return BacklogPerception(
        info,
        models=models.pool(info.edge),
        tracker_of=lambda: _tracker(config, info),
        reader_of=lambda detector, classifier: _reader(config, detector, classifier, info=info),
        detect_every=config.detect_every,
    )


def _tracker(config: GroundConfig, info: Info) -> ByteTracker:
    motion = cast('Literal["off", "flow", "ecc"]', config.camera_motion)
    return ByteTracker(TrackerSettings.starting_at(config.confidence, camera_motion=motion), fps=info.fps)


def _reader(
    config: GroundConfig, detector: Detector, classifier: Classifier | None, *, info: Info
) -> StillReader:
    if classifier is not None:
        return CropReader(classifier, view=info.view)
    if config.classifier == DETECTOR:
        return Redetection(detector, view=info.view)
    return NoReader()


def output_path(target: Path | None, *, suffix: str, edge: str, stamp: str, taken: set[Path]) -> Path:
    """Where a file of one session goes, and note it in ``taken``.

    ``wish`` is the file or folder that the user named; ``stamp`` the time of the session's beginning. A named file is
    written anew, but each session of this process gets one of its own: the first takes the name, others have the
    edge's id in it. A file that nobody named is never overwritten.
    """
    if target is None or target.is_dir() or target.suffix != suffix:
        first = (target or Path()) / f"hvt-{edge}-{stamp}{suffix}"
        further = first
    else:
        first, further = target, target.with_name(f"{target.stem}-{edge}{suffix}")
    count, path = 1, first
    while path in taken or (path != target and path.exists()):
        path = (
            further
            if count == 1 and further != first
            else further.with_name(f"{further.stem}-{count}{suffix}")
        )
        count += 1
    taken.add(path)
    return path


def backlog_path(target: Path | None, *, edge: str, stamp: str, taken: set[Path]) -> Path:
    """Where goes what was kept of a session that is over, beside the recording of the one that is open.

    Never over another file: its edge has forgotten what is in there.
    """
    if target is not None and target.suffix == ".rrd" and not target.is_dir():
        first = target.with_name(f"{target.stem}-{edge}-backlog.rrd")
    else:
        first = (target or Path()) / f"hvt-{edge}-{stamp}-backlog.rrd"
    count, path = 1, first
    while path in taken or path.exists():
        count += 1
        path = first.with_name(f"{first.stem}-{count}.rrd")
    taken.add(path)
    return path
