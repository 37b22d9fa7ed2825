"""Stored objects on their way into a recording: jobs of the perception worker, one step a frame.

``take()`` opens the session's backlog, and lets it go when the job ends; it gives None where nothing of that session
is taken any more. ``done(usable)`` is called when the object is written: None where it was not taken, or lost.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
from contextlib import AbstractContextManager

from hvt_common.errors import UserError
from hvt_common.protocol.messages import BacklogUnit
from hvt_ground.backlog.session_backlog import SessionBacklog
from hvt_ground.perception.models import NotOpenError
from hvt_ground.perception.stills.decode import ReceivedStill
from hvt_ground.perception.worker import Job, PerceptionWorker
from hvt_ground.sinks import Receipt

Take = Callable[[], AbstractContextManager[SessionBacklog | None]]
Done = Callable[[bool | None], None]


def read_still(still: ReceivedStill, take: Take, *, done: Done) -> Job:
    """Read one still, in one step."""
    sequence, receipt, new = still.header.sequence, Receipt(()), False
    try:
        with take() as target:
            if target is not None:
                receipt, new = target.receipt(), target.is_new_still(sequence)
                if new:
                    target.read_still(still)
    except Exception as error:
        done(_usable(error))
        raise

    def end(written: bool) -> None:  # noqa: FBT001 - a receipt
        if target is not None and new and not written:
            target.lose_still(sequence)
        done(True if written and target is not None else None)

    receipt.then(end)
    yield from ()


def show_video(units: Sequence[BacklogUnit], take: Take, *, worker: PerceptionWorker, done: Done) -> Job:
    """Log those frames of a stretch that are missing and can be decoded; another job finds their boxes.

    Where the worker has too many of those, only the video is shown.
    """
    target: SessionBacklog | None = None
    receipt, usable = Receipt(()), None
    logged: dict[int, float] = {}
    """Frame index → the seconds that it counts for."""

    def finish(usable: bool | None) -> None:  # noqa: FBT001 - as of `done`
        # Say so when it is written; frames that are lost on the way are missing again.
        def end(written: bool) -> None:  # noqa: FBT001 - a receipt
            if target is not None and not written:
                target.lose_frames(logged)
            done(usable if written else None)

        receipt.then(end)

    try:
        with take() as target:
            if target is not None:
                receipt, last = target.receipt(), None
                for shown in target.video.pictures(units):
                    if not target.able():
                        break
                    lasts_s = None if shown is None else target.show(*shown, after=last)
                    if shown is not None and lasts_s is not None:
                        last = shown[0]
                        logged[last.frame_index] = lasts_s
                    yield
                else:
                    usable = target.able() or None
                boxes = _find_boxes(units, logged.keys(), take)
                if usable and logged and next(boxes, True) is None and not worker.submit(boxes, last=True):
                    boxes.close()
    except Exception as error:
        finish(_usable(error))
        raise
    finish(usable)


def _find_boxes(units: Sequence[BacklogUnit], frames: AbstractSet[int], take: Take) -> Job:
    with take() as target:
        if target is None or target.perception is None:
            return
        yield  # the recording stays open while this waits
        analyze, last = target.perception.track(target.log_boxes), None
        for shown in target.video.pictures(units):
            if shown is not None and shown[1] is not None and shown[0].frame_index in frames:
                last = shown[0]
                analyze(last.frame_index, last.capture_ns, shown[1])
            yield
        if last is not None:
            target.end_boxes(last)


def _usable(error: Exception) -> bool | None:
    # The object comes again if the machine may mend it, such as a full disk.
    return None if isinstance(error, OSError | UserError | NotOpenError) else False
