"""Objects of an edge's earlier sessions go into recordings of their own, one for each session.

So many files a day at most, and of those so many open at a time, whatever an edge says that it stored: one that is
started over and over, or somebody in its name, would fill the disk with them.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from hvt_common.protocol.messages import Info
from hvt_ground.backlog.session_backlog import SessionBacklog
from hvt_ground.events import Event, Notice, Refinement
from hvt_ground.perception.session import SessionPerception
from hvt_ground.sinks import QueuedSink

MOST_OPEN = 4
MOST_FILES = 32
_DAY_S = 86_400.0
_MOST_REMEMBERED = 256
"""Files that the summary names."""
_OPEN_S = 0.5


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
            text = f"{totals.amount()} of this session arrived after it had ended"
            self.sink.log(Notice(*totals.first, "info", text))
        self.sink.close()

    def _emit(self, event: Event) -> None:
        if isinstance(event, Refinement):
            self.backlog.note(event)
        self.sink.log(event)


class BacklogRecordings:
    """Of one edge: opened when something comes of a session. Safe for threads.

    Where more than ``most`` are open, the one that nothing came for the longest is closed. One that is in use is not:
    should all be, one more is open for the time being. When more comes of a session whose recording is closed, it
    gets another file; at most ``most_files`` are made in a day. Whoever has one made waits up to ``open_s`` for its
    file, and for as long nobody else does. ``clock`` is seconds without steps.
    """

    def __init__(
        self,
        open_one: Callable[[Info], BacklogRecording],
        *,
        most: int = MOST_OPEN,
        most_files: int = MOST_FILES,
        open_s: float = _OPEN_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._open_one = open_one
        self._most = most
        self._open_s = open_s
        self._most_files = most_files
        self._clock = clock
        self._made_s: deque[float] = deque(maxlen=most_files)
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
                self._made_s.append(self._clock())
                recording = self._open[info.session_id] = self._open_one(info)
                self._sinks.append(recording.sink)
                wait_s = self._open_s
            self._open.move_to_end(info.session_id)
            recording.users += 1
            return recording, wait_s

    def close(self) -> None:
        with self._lock:
            self._closed = True
            while self._open:
                self._open.popitem()[1].close()

    def _may_make(self) -> bool:
        return len(self._made_s) < self._most_files or self._clock() - self._made_s[0] >= _DAY_S

    def _close_surplus(self) -> None:
        unused = [session_id for session_id, recording in self._open.items() if not recording.users]
        for session_id in unused[: max(0, len(self._open) + 1 - self._most)]:
            self._open.pop(session_id).close()
