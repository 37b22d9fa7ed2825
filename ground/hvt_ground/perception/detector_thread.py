"""The detector's own thread, which sessions share: following tracks and listing them never waits for a detection.

A session has one picture there. While that waits, its next takes its place, so that what is searched is never old.
Those that wait go in the order of asking: who asks seldom is searched as often as who asks with each picture.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from queue import SimpleQueue

from hvt_common.runtime.process import lower_priority
from hvt_common.values import Detections, Image


class Detection:
    """A picture that waits for the detector, is in it, or was."""

    def __init__(self, image: Image, detect: Callable[[Image], Detections]) -> None:
        self.found: Future[Detections] = Future()
        self._image: Image | None = image
        self._detect = detect
        self._lock = threading.Lock()

    @property
    def queued(self) -> bool:
        """It is not in the detector yet."""
        return self._image is not None

    def replace(self, image: Image) -> bool:
        """Wait with a newer picture; False where the detector has the first already."""
        with self._lock:
            if self._image is None:
                return False
            self._image = image
            return True

    def run(self) -> None:
        """Search the picture; for the detector's thread."""
        with self._lock:
            image, self._image = self._image, None
        if image is None or not self.found.set_running_or_notify_cancel():
            return
        try:
            self.found.set_result(self._detect(image))
        except BaseException as error:  # noqa: BLE001 - raised where it is taken
            self.found.set_exception(error)


class DetectorThread:
    """Of one detector. The thread ends when nobody holds this any more."""

    def __init__(self) -> None:
        self._queue: SimpleQueue[Detection | None] = SimpleQueue()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def submit(self, image: Image, detect: Callable[[Image], Detections]) -> Detection:
        """Have a picture searched as soon as those are that were asked for before."""
        detection = Detection(image, detect)
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
