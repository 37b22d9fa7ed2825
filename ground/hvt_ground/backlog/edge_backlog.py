"""Stored objects of an edge, from chunks to the session that they belong to.

Objects of the open session go there, those of a session before into a recording of its own. All of it is done by the
open session's perception worker when nothing newer is there: the picture of now goes first.
They come into a recording by jobs of that worker, one step a frame.

The files for earlier sessions are bounded, by day and open at a time, whatever an edge says that it stored: an edge
that is started over and over, or somebody in its name, would fill the disk with them.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import KW_ONLY, dataclass
from functools import partial
from pathlib import Path

from hvt_common.protocol.messages import (
    AcknowledgedRange,
    BacklogHeader,
    BacklogKind,
    Info,
    ObjectKey,
    WireError,
)
from hvt_common.runtime.statistics import Newest
from hvt_ground.backlog.assembly import BacklogAssembly, backlog_content
from hvt_ground.backlog.session_backlog import SessionBacklog, Take, read_still, show_video
from hvt_ground.events import Event, Notice, Refinement
from hvt_ground.perception.session import SessionPerception
from hvt_ground.perception.stills.decode import ReceivedStill
from hvt_ground.perception.worker import PerceptionWorker
from hvt_ground.sinks import QueuedSink

_log = logging.getLogger(__name__)

_MOST_INFOS = 64
MOST_OPEN = 4
MOST_FILES = 32
_DAY_S = 86_400.0
_MOST_REMEMBERED = 256
"""Files that the summary names."""
_OPEN_S = 0.5


class EdgeBacklog:
    """Of one edge. `chunk` is for the receiving thread, `take_acknowledged_ranges` for any.

    ``recordings`` takes objects of other sessions; None refuses them.
    """

    def __init__(self, edge: str, *, recordings: BacklogRecordings | None) -> None:
        self._edge = edge
        self._recordings = recordings
        self._assembly = BacklogAssembly()
        self._lock = threading.Lock()
        self._infos: Newest[int, Info] = Newest(_MOST_INFOS)
        self._sessions = 0
        """Sessions that have ended: jobs still at work for one of them are ignored."""

    @property
    def paths(self) -> Sequence[Path]:
        """Recordings of former sessions that were written."""
        return () if self._recordings is None else tuple(self._recordings.paths)

    @property
    def working(self) -> int:
        """Received objects that are not delivered yet."""
        return self._assembly.handed

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
            raise WireError(f"it was stored of the session {header.session_id:08x}, which is not shown")
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
        if isinstance(content, Info):
            with self._lock:
                self._infos.put(content.session_id, content)
                self._assembly.settle(key, usable=True)
            return
        if key[0] == own.info.session_id:  # it stays open as long as its worker
            take: Take = lambda: nullcontext(own if own.able() else None)  # noqa: E731
        else:
            assert self._recordings is not None, "without, no chunk of another session is taken"
            take = partial(self._recordings.using, self._infos[key[0]])
        done = partial(self._done, key, self._sessions)
        if isinstance(content, ReceivedStill):
            worker.submit(read_still(content, take, done=done))
        else:
            worker.submit(show_video(content, take, worker=worker, done=done))

    def _done(self, key: ObjectKey, session: int, usable: bool | None) -> None:  # noqa: FBT001 - partial
        # A job has ended; None: its object was not taken.
        with self._lock:
            if session == self._sessions:
                self._assembly.settle(key, usable=usable)


class BacklogRecording:
    """The recording of one session that is over."""

    def __init__(self, info: Info, *, sink: QueuedSink[Event], perception: SessionPerception) -> None:
        self.users = 0
        """Jobs that have it in hand, or wait for it."""
        self.sink = sink
        self.backlog = SessionBacklog(
            info,
            log=sink.log,
            perception=perception,
            read=lambda still: perception.read(still, emit=self._emit),
            outputs=[sink],
        )

    def close(self) -> None:
        """Log the amount received and close the file, without waiting for it."""
        totals = self.backlog.totals
        if totals.first is not None and totals.amount():
            self.sink.log(
                Notice(*totals.first, "info", f"{totals.amount()} of this session arrived after it had ended")
            )
        self.sink.close()

    def _emit(self, event: Event) -> None:
        if isinstance(event, Refinement):
            self.backlog.note(event)
        self.sink.log(event)


@dataclass(eq=False)
class BacklogRecordings:
    """Of one edge: opened when something comes of a session. Safe for threads.

    Where more than ``most`` are open, the one that nothing came for the longest is closed. One that is in use is not:
    should all be, one more is open for the time being. When more comes of a session whose recording is closed, it
    gets another file; at most ``most_files`` are made in a day. The caller that has one made waits up to ``open_s``
    for its file, others not at all for as long. ``clock`` is seconds without steps.
    """

    open_one: Callable[[Info], BacklogRecording]
    _: KW_ONLY
    most: int = MOST_OPEN
    most_files: int = MOST_FILES
    open_s: float = _OPEN_S
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        self._made_s: deque[float] = deque(maxlen=self.most_files)
        self._lock = threading.Lock()
        self._open: OrderedDict[int, BacklogRecording] = OrderedDict()
        self._closed = False
        self._sinks: deque[QueuedSink[Event]] = deque(maxlen=_MOST_REMEMBERED)

    @property
    def paths(self) -> list[Path]:
        """The last files, in the order of opening."""
        return [path for sink in tuple(self._sinks) for path in sink.files]

    @property
    def open_sessions(self) -> list[int]:
        """Session ids of the recordings that are open, the one that was used last at the end."""
        with self._lock:
            return list(self._open)

    def takes(self, session_id: int) -> bool:
        """Whether there is a recording for this session, or may be one."""
        with self._lock:
            return not self._closed and (session_id in self._open or self._may_make())

    @contextmanager
    def using(self, info: Info) -> Iterator[SessionBacklog | None]:
        """The backlog of that session's recording, which stays open meanwhile.

        None where `takes` says no, or the recording cannot be written now.
        """
        recording, wait_s = self._taken(info)
        try:  # not while the lock is held: the receiving thread asks `takes`
            able = recording is not None and recording.sink.is_open(within_s=wait_s)
            yield recording.backlog if recording is not None and able else None
        finally:
            if recording is not None:
                with self._lock:
                    recording.users -= 1

    def _taken(self, info: Info) -> tuple[BacklogRecording | None, float]:
        # With one more user, and how long to wait for its file.
        with self._lock:
            recording, wait_s = self._open.get(info.session_id), 0.0
            if recording is None:
                if self._closed or not self._may_make():
                    return None, wait_s
                self._close_surplus()
                self._made_s.append(self.clock())
                recording = self._open[info.session_id] = self.open_one(info)
                self._sinks.append(recording.sink)
                wait_s = self.open_s
            self._open.move_to_end(info.session_id)
            recording.users += 1
            return recording, wait_s

    def close(self) -> None:
        with self._lock:
            self._closed = True
            while self._open:
                self._open.popitem()[1].close()

    def _may_make(self) -> bool:
        return len(self._made_s) < self.most_files or self.clock() - self._made_s[0] >= _DAY_S

    def _close_surplus(self) -> None:
        unused = [session_id for session_id, recording in self._open.items() if not recording.users]
        for session_id in unused[: max(0, len(self._open) + 1 - self.most)]:
            self._open.pop(session_id).close()
