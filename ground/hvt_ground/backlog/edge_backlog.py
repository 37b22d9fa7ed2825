"""Stored objects of an edge, from chunks to the session that they belong to.

Objects of the open session go there, those of a session before into a recording of its own. All of it is done by the
open session's perception worker when nothing newer is there: the picture of now goes first.
They come into a recording by jobs of that worker, one step a frame.

``take()`` opens the session's backlog, and lets it go when the job ends; it gives None where nothing of that session
is taken any more. ``done(usable)`` is called when the object is written: None where it was not taken, or lost.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path

from hvt_common.errors import UserError
from hvt_common.protocol.messages import (
    AcknowledgedRange,
    BacklogHeader,
    BacklogKind,
    BacklogUnit,
    Info,
    ObjectKey,
    WireError,
)
from hvt_common.runtime.statistics import Newest
from hvt_ground.backlog.assembly import BacklogAssembly, backlog_content
from hvt_ground.backlog.recordings import BacklogRecordings
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


_log = logging.getLogger(__name__)

_MOST_INFOS = 64


class EdgeBacklog:
    """Of one edge. `chunk` is for the receiving thread, `take_acknowledged_ranges` for any.

    ``recordings`` takes what is of another session; None refuses it.
    """

    def __init__(self, edge: str, *, recordings: BacklogRecordings | None) -> None:
        self._edge = edge
        self._recordings = recordings
        self._assembly = BacklogAssembly()
        self._lock = threading.Lock()
        self._infos: Newest[int, Info] = Newest(_MOST_INFOS)
        self.working = 0
        """Received objects that are not delivered yet."""
        self._sessions = 0
        """Sessions that have ended: jobs still at work for one of them are ignored."""

    @property
    def paths(self) -> Sequence[Path]:
        """Recordings of former sessions that were written."""
        return () if self._recordings is None else tuple(self._recordings.paths)

    @property
    def unreported(self) -> int:
        """Number of acknowledgements not yet sent to the edge."""
        return self._assembly.unreported

    def take_acknowledged_ranges(self, most: int) -> tuple[AcknowledgedRange, ...]:
        """Return and forget up to ``most`` acknowledgements."""
        with self._lock:
            return self._assembly.take_acknowledged_ranges(most)

    def chunk(
        self, header: BacklogHeader, payload: bytes, *, own: SessionBacklog, worker: PerceptionWorker
    ) -> bool:
        """Take a chunk; True where it completes its object, which is handed to ``worker``.

        ``own`` is the backlog of the session that is open. Raises `WireError` where it cannot be one, or the
        object that it completes is unusable.
        """
        is_own = header.session_id == own.info.session_id
        if not is_own and (self._recordings is None or not self._recordings.takes(header.session_id)):
            raise WireError(f"it was stored of the session {header.session_id:016x}, which is not shown")
        is_info = header.kind == BacklogKind.INFO
        with self._lock:
            known = is_own or header.session_id in self._infos
            if not (known or is_info):
                self._assembly.want_info(header.session_id)
            may_finish = is_info or (known and worker.accepts_jobs)
            whole = self._assembly.chunk(header, payload, may_finish=may_finish)
        if whole is None:
            return False
        self._deliver(header.key, whole, own, worker)
        return True

    def session_ended(self, info: Info) -> None:
        """The open session is closed: unprocessed objects were not acknowledged, and will come again."""
        with self._lock:
            self._infos.put(info.session_id, info)
            dropped = self._assembly.drop_handed()
            self.working = 0
            self._sessions += 1
        if dropped:
            _log.info("%s: %d objects of an outage were not worked off in time", self._edge, dropped)

    def close(self) -> None:
        """Close the recordings of former sessions."""
        if self._recordings is not None:
            self._recordings.close()

    def _deliver(self, key: ObjectKey, whole: bytes, own: SessionBacklog, worker: PerceptionWorker) -> None:
        try:
            content = backlog_content(key, whole, edge=self._edge)
        except WireError:
            with self._lock:
                self._assembly.settle(key, usable=False)
            raise
        is_own = key[0] == own.info.session_id
        if isinstance(content, Info):
            with self._lock:
                self._infos.put(content.session_id, content)
                self._assembly.settle(key, usable=True)
            return
        if is_own:  # it stays open as long as its worker
            take: Take = lambda: nullcontext(own if own.able() else None)  # noqa: E731
        else:
            assert self._recordings is not None, "without, no chunk of another session is taken"
            take = partial(self._recordings.using, self._infos[key[0]])
        with self._lock:
            self.working += 1
            done = partial(self._done, key, self._sessions)
        if isinstance(content, ReceivedStill):
            worker.submit(read_still(content, take, done=done))
        else:
            worker.submit(show_video(content, take, worker=worker, done=done))

    def _done(self, key: ObjectKey, session: int, usable: bool | None) -> None:  # noqa: FBT001 - partial
        # A job has ended; None: its object was not taken.
        with self._lock:
            if session != self._sessions:
                return
            self.working -= 1
            self._assembly.settle(key, usable=usable)
