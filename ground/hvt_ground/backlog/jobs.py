"""Stored objects on their way into a recording: jobs of the perception worker, one step a frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial

from hvt_common.errors import UserError
from hvt_common.protocol.messages import BacklogUnit
from hvt_common.values import Image
from hvt_ground.backlog.perception import StretchTracker
from hvt_ground.backlog.session_backlog import SessionBacklog
from hvt_ground.perception.models import NotOpenError
from hvt_ground.perception.stills.decode import ReceivedStill
from hvt_ground.perception.worker import Job, PerceptionWorker
from hvt_ground.sinks import Receipt

_Pictures = Iterator[tuple[BacklogUnit, Image | None] | None]


@dataclass(frozen=True, slots=True)
class Destination:
    """The destination of an object: acquired when its job begins, released when the job is closed."""

    acquire: Callable[[], SessionBacklog | None]
    """None: nothing of that session is taken any more."""
    release: Callable[[SessionBacklog], None]


class StillJob(Job):
    """Reads one still; ``done(usable)`` is called when it is written, with None where it was not taken, or lost."""

    def __init__(
        self, still: ReceivedStill, destination: Destination, *, done: Callable[[bool | None], None]
    ) -> None:
        self._still = still
        self._destination = destination
        self._done = done

    def step(self) -> bool:
        """All of it."""
        target = self._destination.acquire()
        if target is None:
            self._done(None)
            return True
        try:
            receipt, sequence = target.receipt(), self._still.header.sequence
            new = target.is_new_still(sequence)
            if new:
                target.read_still(self._still)
        finally:
            self._destination.release(target)
        receipt.then(partial(self._end, target if new else None))
        return True

    def _end(self, target: SessionBacklog | None, written: bool) -> None:  # noqa: FBT001 - partial
        if target is not None and not written:
            target.lose_still(self._still.header.sequence)
        self._done(True if written else None)

    def fail(self, error: Exception) -> None:
        """End with an error: the object comes again if the machine may mend it, such as a full disk."""
        self._done(_usable(error))


class VideoJob(Job):
    """Logs those frames of a stretch that are missing and can be decoded; then a job of its own finds their boxes.

    Where the worker has too many of those, only the video is shown. ``done`` is as for `StillJob`.
    """

    def __init__(
        self,
        units: Sequence[BacklogUnit],
        destination: Destination,
        *,
        worker: PerceptionWorker,
        done: Callable[[bool | None], None],
    ) -> None:
        self._units = units
        self._destination = destination
        self._worker = worker
        self._done = done
        self._target: SessionBacklog | None = None
        self._pictures: _Pictures = iter(())
        self._last: BacklogUnit | None = None
        self._logged: dict[int, float] = {}
        """Frame index → the seconds that it counts for."""
        self._receipt = Receipt(())

    def step(self) -> bool:
        """Decode and log one frame."""
        if self._target is None:
            self._target = self._destination.acquire()
            if self._target is None:
                self._done(None)
                return True
            self._receipt = self._target.receipt()
            self._pictures = self._target.video.pictures(self._units)
        if not self._target.able():
            self._finish(self._target, None)
            return True
        for shown in self._pictures:
            lasts_s = None if shown is None else self._target.show(*shown, after=self._last)
            if shown is not None and lasts_s is not None:
                self._last = shown[0]
                self._logged[self._last.frame_index] = lasts_s
            return False
        if self._logged and self._target.perception is not None:
            boxes = _BoxesJob(self._units, self._logged.keys(), self._destination)
            if not self._worker.submit(boxes, last=True):
                boxes.close()
        self._finish(self._target, True)
        return True

    def fail(self, error: Exception) -> None:
        """See `StillJob`."""
        if self._target is None:
            self._done(_usable(error))
        else:
            self._finish(self._target, _usable(error))

    def close(self) -> None:
        """Release the destination."""
        if self._target is not None:
            self._destination.release(self._target)

    def _finish(self, target: SessionBacklog, usable: bool | None) -> None:  # noqa: FBT001 - as of `done`
        # Say so when it is written; frames that are lost on the way are missing again.

        def end(written: bool) -> None:  # noqa: FBT001 - a receipt
            if not written:
                target.lose_frames(self._logged)
            self._done(usable if written else None)

        self._receipt.then(end)


class _BoxesJob(Job):
    def __init__(
        self, units: Sequence[BacklogUnit], frames: AbstractSet[int], destination: Destination
    ) -> None:
        self._units = units
        self._frames = frames
        self._destination = destination
        self._target = destination.acquire()
        self._pictures: _Pictures = iter(())
        self._checkout = ExitStack()
        """Its checkout from the model pool, from the first step on."""
        self._tracker: StretchTracker | None = None
        self._last: BacklogUnit | None = None

    def step(self) -> bool:
        """Analyze one frame."""
        target = self._target
        if target is None or target.perception is None:
            return True
        if self._tracker is None:
            self._tracker = self._checkout.enter_context(target.perception.track(target.log_boxes))
            self._pictures = target.video.pictures(self._units)
        for shown in self._pictures:
            if shown is not None and shown[1] is not None and shown[0].frame_index in self._frames:
                self._last = shown[0]
                self._tracker.analyze(self._last.frame_index, self._last.capture_ns, shown[1])
            return False
        if self._last is not None:
            target.end_boxes(self._last)
        return True

    def close(self) -> None:
        """Give the models back and release the destination."""
        self._checkout.close()
        if self._target is not None:
            self._destination.release(self._target)


def _usable(error: Exception) -> bool | None:
    return None if isinstance(error, OSError | UserError | NotOpenError) else False
