"""What an edge kept before it was started again goes into recordings of its own, one for each session.

So many files at most, and of those so many open at a time, whatever an edge says that it kept: one that is started
over and over, or somebody in its name, would fill the disk with them.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from hvt_common.protocol.messages import Info
from hvt_ground.backlog.fill import BacklogFill, Work
from hvt_ground.backlog.perception import BacklogPerception
from hvt_ground.events import Notice
from hvt_ground.link.sequence_window import SequenceWindow
from hvt_ground.perception.stills.decode import ReceivedStill
from hvt_ground.sinks.rerun.recorder import Recorder

__all__ = ["MOST_FILES", "MOST_OPEN", "BacklogRecording", "BacklogRecordings"]

MOST_OPEN = 4
MOST_FILES = 32
_CLOSE_S = 1.0
"""For so long the end of the ground waits for footers; a file without one opens just as well."""


class BacklogRecording:
    """One session's. `still` is for the thread that sees, `fill` for the one that receives."""

    def __init__(
        self, info: Info, *, path: Path | None, recorder: Recorder, perception: BacklogPerception
    ) -> None:
        self.info = info
        self.path = path
        self._recorder = recorder
        self._perception = perception
        self._stills = SequenceWindow()
        self.fill = BacklogFill(info, log=recorder.log, perception=perception)

    def still(self, still: ReceivedStill) -> Work:
        """Decode, name and log one, once."""
        if self._stills.add([still.header.sequence]):
            self.fill.note_still(still.header.frame_index, still.header.capture_ns)
            self._perception.read(still, emit=self._recorder.log)
        yield
        return True

    def close(self, *, footer: bool = True) -> None:
        """Say what has come and close the file."""
        arrived = self.fill.arrived
        if arrived.first is not None:
            text = f"{arrived.amount()} of this session arrived after it had ended"
            self._recorder.log(Notice(*arrived.first, "info", text))
        self._recorder.close(footer=footer)


@dataclass(slots=True)
class _Open:
    recording: BacklogRecording
    users: int = 0
    """Work that has it in hand, or waits to."""


class BacklogRecordings:
    """Of one edge: opened when something comes of a session. For the threads that receive and see.

    Where too many are open, the one that nothing came for the longest is closed, in a thread of its own, for a footer
    may take seconds. One that is in use is not: should all be, one more is open for the time being. When more comes
    of a session whose recording is closed, it gets another file.

    Args:
        open_one: makes the recording of a session.
        most: how many may be open.
        most_files: how many are made in all.
    """

    def __init__(
        self,
        open_one: Callable[[Info], BacklogRecording],
        *,
        most: int = MOST_OPEN,
        most_files: int = MOST_FILES,
    ) -> None:
        self._open_one = open_one
        self._most = most
        self._left = most_files
        self._lock = threading.Lock()
        self._open: OrderedDict[int, _Open] = OrderedDict()
        self._closer = ThreadPoolExecutor(1, thread_name_prefix="hvt-backlog-close")
        self._closing: list[Future[None]] = []
        self._stop_ns: int | None = None
        """When the time for footers is over; None while more may come."""
        self.paths: list[Path] = []
        """All files, in the order of opening."""

    def takes(self, session_id: int) -> bool:
        """Whether there is a recording for this session, or may be one."""
        with self._lock:
            return self._stop_ns is None and (self._left > 0 or session_id in self._open)

    @contextmanager
    def using(self, info: Info) -> Iterator[BacklogRecording | None]:
        """The session's recording, which stays open meanwhile; None where `takes` says no.

        Raises:
            UserError: its file cannot be made, or another could not be closed as it should.
        """
        held = self._hold(info)
        try:
            yield None if held is None else held.recording
        finally:
            if held is not None:
                self._release(held)

    def stored(self, recording: BacklogRecording, work: Work) -> Work:
        """The work, for which a recording that is in use now stays open until it is done, or `release_all`."""
        with self._lock:
            held = next(one for one in self._open.values() if one.recording is recording)
            held.users += 1
        return self._released_after(held, work)

    def release_all(self) -> None:
        """No work goes on: those that did it are gone."""
        with self._lock:
            for held in self._open.values():
                held.users = 0

    def close(self) -> None:
        """Close all that are open."""
        with self._lock:
            self._stop_ns = time.monotonic_ns() + round(_CLOSE_S * 1e9)
            while self._open:
                self._close_later(self._open.popitem()[1])
        self._closer.shutdown()
        self._raise_error(wait=True)

    def _hold(self, info: Info) -> _Open | None:
        self._raise_error()
        with self._lock:
            held = self._open.get(info.session_id)
            if held is None:
                if self._stop_ns is not None or self._left <= 0:
                    return None
                self._make_space()
                self._left -= 1
                held = self._open[info.session_id] = _Open(self._open_one(info))
                if held.recording.path is not None:
                    self.paths.append(held.recording.path)
            self._open.move_to_end(info.session_id)
            held.users += 1
            return held

    def _release(self, held: _Open) -> None:
        with self._lock:
            held.users = max(0, held.users - 1)

    def _released_after(self, held: _Open, work: Work) -> Work:
        try:
            return (yield from work)
        finally:
            self._release(held)

    def _make_space(self) -> None:
        unused = [session_id for session_id, held in self._open.items() if not held.users]
        for session_id in unused[: max(0, len(self._open) + 1 - self._most)]:
            self._close_later(self._open.pop(session_id))

    def _close_later(self, held: _Open) -> None:
        self._closing.append(self._closer.submit(self._close, held.recording))

    def _close(self, recording: BacklogRecording) -> None:
        recording.close(footer=self._stop_ns is None or time.monotonic_ns() < self._stop_ns)

    def _raise_error(self, *, wait: bool = False) -> None:
        for closing in self._closing:
            if wait or closing.done():
                closing.result()
