"""The detector and the classifier of a ground: opened once, for all its sessions.

The detector has a thread, which sessions share: following tracks and listing them never waits for a detection. A
session has one picture there. While that waits, its next takes its place, so that a searched picture is never old.
They are searched in the order of asking: a session that asks seldom gets as many turns as one that always asks.
"""

from __future__ import annotations

import logging
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from queue import SimpleQueue
from typing import Self

from hvt_common.inference.classify import Classifier, open_classifier
from hvt_common.inference.detect import FailingDetector, open_detector, warm_up
from hvt_common.inference.labels import default_confidence, is_calibrated, uncalibrated
from hvt_common.inference.retried import RetriedClassifier, RetriedDetector
from hvt_common.inference.store import needed_part
from hvt_common.inference.view_trust import trust_from
from hvt_common.runtime.clock import SteadyClock
from hvt_common.runtime.failures import Failures
from hvt_common.runtime.process import lower_priority
from hvt_common.tracking.settings import weak_confidence
from hvt_common.values import Detections
from hvt_common.video.hevc import Picture
from hvt_ground.config import DETECTOR, MOTION, NONE, GroundConfig
from hvt_ground.perception.stills.classify import StillReader
from hvt_ground.perception.stills.vocabulary import check_common


class Detection:
    """A picture that waits for the detector, is in it, or was."""

    def __init__(self, picture: Picture, detect: Callable[[Picture], Detections]) -> None:
        self.found: Future[Detections] = Future()
        self._picture: Picture | None = picture
        self._detect = detect
        self._lock = threading.Lock()

    @property
    def queued(self) -> bool:
        """It is not in the detector yet."""
        return self._picture is not None

    def replace(self, picture: Picture) -> bool:
        """Wait with a newer picture; False where the detector has the first already."""
        with self._lock:
            if self._picture is None:
                return False
            self._picture = picture
            return True

    def run(self) -> None:
        """Search the picture; for the detector's thread."""
        with self._lock:
            picture, self._picture = self._picture, None
        if picture is None or not self.found.set_running_or_notify_cancel():
            return
        try:
            self.found.set_result(self._detect(picture))
        except BaseException as error:  # noqa: BLE001 - raised where it is taken
            self.found.set_exception(error)


class DetectorThread:
    """The thread of one detector. It ends when nobody holds this any more."""

    def __init__(self) -> None:
        self._queue: SimpleQueue[Detection | None] = SimpleQueue()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def submit(self, picture: Picture, detect: Callable[[Picture], Detections]) -> Detection:
        """Have a picture searched as soon as those are that were asked for before."""
        detection = Detection(picture, detect)
        self._queue.put(detection)
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(
                    target=_run, args=(self._queue,), name="hvt-detector", daemon=True
                )
                self._thread.start()
                weakref.finalize(self, self._queue.put, None)
        return detection


def _run(queue: SimpleQueue[Detection | None]) -> None:
    lower_priority()
    while (detection := queue.get()) is not None:
        detection.run()
        del detection  # its session holds the thread's owner


_log = logging.getLogger(__name__)

_USUAL_SIZE = (1280, 720)
"""The usual size of base streams; an edge's own is known with its first picture."""

ModelSet = tuple[FailingDetector, Classifier | None]


@dataclass(frozen=True, slots=True)
class ModelFacts:
    """Facts from the files of the models, read once: later sessions go on though a file is gone, or another."""

    track_confidence: float
    """From where a detection starts a track: as given, else as the detector's file says."""
    calibrated: bool
    """Whether the detector's scores are probabilities."""
    stills_calibrated: bool
    """Whether the model that reads stills gives probabilities."""
    trust_from: float | None = None
    """As of `ViewTrust`."""
    redetection: Callable[..., StillReader] | None = None
    """Makes the reader of stills that is the detector again, from it and the ``view``; None for another."""

    @classmethod
    def of(cls, config: GroundConfig) -> Self:
        """Raises `UserError` where a file cannot be used."""
        confidence, reader = config.confidence, config.classifier
        calibrated = is_calibrated(config.detector, role="detector")
        return cls(
            default_confidence(config.detector) if confidence is None else confidence,
            calibrated,
            calibrated
            if reader == DETECTOR
            else reader not in (None, NONE) and is_calibrated(reader, role="classifier"),
            trust_from(config.detector),
            needed_part("redetection", f"--classifier {DETECTOR}") if reader == DETECTOR else None,
        )


class NotOpenError(Exception):
    """The run ends, and its models are not open: nobody looks at the remaining pictures."""


class Models:
    """Opens detector and classifier once, in a thread of its own; all sessions share them.

    A runtime may compile for many seconds: video is received, recorded and shown meanwhile. Two pictures at once
    would each have half the cores, and take twice the memory and threads.
    """

    def __init__(self, config: GroundConfig, *, clock: Callable[[], int] | None = None) -> None:
        self._config = config
        self.failures = Failures(clock or SteadyClock())
        """Models whose run raised."""
        self.detector_thread = DetectorThread()
        self.facts = ModelFacts.of(config)  # a file that is not there is refused at once
        self._opened: Future[ModelSet] = Future()
        threading.Thread(target=self._load, name="hvt-models", daemon=True).start()

    @property
    def loading(self) -> bool:
        return self._opened.cancelled() or not self._opened.done()

    @property
    def error(self) -> BaseException | None:
        """Why they cannot be opened; None while that is not known."""
        return None if self.loading else self._opened.exception()

    def wait(self) -> ModelSet:
        """A detector, and a classifier where one is wanted, once they are open.

        Raises `UserError` where a setting or a file of them cannot be used.
        """
        return self._opened.result()

    def take(self) -> ModelSet:
        """Like `wait`, for a session; each `MOTION` detector is a new one, for it remembers pictures.

        Raises `NotOpenError` where they cannot be opened, of which `error` tells, or nobody is to wait any more.
        """
        try:
            opened = self._opened.result()
        except Exception:  # noqa: BLE001 - the run ends with it, and says it once
            raise NotOpenError("the run ends before the detector is open") from None
        return (self._open_detector(), opened[1]) if self._config.detector == MOTION else opened

    def give_up(self) -> None:
        """The run ends: nobody waits for the models any longer."""
        self._opened.cancel()

    def _load(self) -> None:
        if self._config.threads > 1:  # workers inherit the priority of the opening thread
            lower_priority()
        opened, failed = None, None
        try:
            opened = self._open()
            self._check(opened)
        except BaseException as error:  # noqa: BLE001 - raised where they are taken
            failed = error
        if not self._opened.set_running_or_notify_cancel():
            return
        if failed is not None or opened is None:
            self._opened.set_exception(failed)
        else:
            self._opened.set_result(opened)

    def _open_detector(self) -> FailingDetector:
        config = self._config
        open_one = partial(
            open_detector,
            config.detector,
            labels=config.detector_labels,
            confidence=weak_confidence(self.facts.track_confidence),
            nms_iou=config.nms_iou,
            head=config.head,
            threads=config.threads,
            provider=config.provider,
            failures=self.failures,
        )
        return RetriedDetector(open_one, "detector", self.failures)

    def _check(self, opened: ModelSet) -> None:
        # Refuse a classifier that has nothing to say of the detector's tracks; say which scores mean little.
        config, (detector, classifier) = self._config, opened
        if config.detector != MOTION and not self.facts.calibrated:
            _log.warning("%s", uncalibrated("detector", config.detector))
        if classifier is None or config.classifier is None:
            return
        check_common(config.detector, detector.class_names, config.classifier, classifier.class_names)
        if not self.facts.stills_calibrated:
            _log.warning("%s, and no class gets a check mark", uncalibrated("classifier", config.classifier))

    def _open(self) -> ModelSet:
        config = self._config
        detector = self._open_detector()
        if config.detector != MOTION:  # it remembers pictures
            warm_up(detector, _USUAL_SIZE)
        if config.classifier in (None, DETECTOR, NONE):
            return detector, None
        open_one = partial(
            open_classifier,
            config.classifier,
            labels=config.labels,
            threads=config.threads,
            provider=config.provider,
        )
        return detector, RetriedClassifier(open_one, "classifier", self.failures)
