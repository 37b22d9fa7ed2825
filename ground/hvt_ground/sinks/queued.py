"""A sink behind a bounded queue, in a thread of its own: its failures and delays are felt nowhere else.

`Sink` is the side that logs, `SinkWriter` the contract of a writer in that thread.
"""

from __future__ import annotations

import logging
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from hvt_common.errors import UserError, foreign
from hvt_common.runtime.failures import Failures, RetryPause, Turns, reason_of
from hvt_common.runtime.process import joined
from hvt_common.transport.inbox import Received
from hvt_common.units import SECOND_NS
from hvt_ground.events import Overlay, Refinement, VideoSample

T = TypeVar("T")
T_contra = TypeVar("T_contra", contravariant=True)


class Sink(Protocol[T_contra]):
    """Takes the events of one session, or other items, and uses those that it knows."""

    def log(self, item: T_contra) -> None:
        """Take an item."""

    def close(self, hurry: threading.Event | None = None) -> None:
        """Write the buffer; skip slow extras once ``hurry`` is set."""


class SinkWriter(ABC, Generic[T]):
    """A sink that one thread uses; this one writes to no file, and holds nothing. An error that it raises ends it."""

    path: Path | None = None
    """The file that was opened last; None without one."""
    awaits_keyframe = False
    """It can show nothing of the last events without one, and somebody looks: one is requested, once."""

    @abstractmethod
    def log(self, item: T) -> None: ...

    def skipped(self, count: int) -> None:
        """``count`` items were left out before the next one."""

    def close(self, hurry: threading.Event | None = None) -> None:
        """Write the rest; skip slow extras once ``hurry`` is set. A second call does nothing."""


_log = logging.getLogger(__name__)
_MOST_ITEMS = 4096
_MOST_BYTES = 32 * 2**20
"""Some minutes of a thin link, or some hundred large stills."""
_SMALL_BYTES = 512
_TRACK_BYTES = 64
"""Size of each track of an overlay."""
BEHIND_S = 10.0
"""The first delay of a sink that is told; then twice that, and so on, until it is less than half of this again."""
_POLL_S = 0.2
_AT_ONCE = threading.Event()
_AT_ONCE.set()


class QueuedSink(Generic[T]):
    """Writes the items of `log` in a thread of its own, into a sink that ``open_sink`` makes there.

    A sink that raises is closed and made anew after pauses that grow up to ``longest_pause_s``; until then items
    are counted as lost. Where the queue is full `log` waits up to ``wait_s`` for room, then the item is counted as
    dropped. ``failures`` learns of it under the name ``part``, and that it hangs unless it is ``unhurried``.
    ``for_backlog``: items stored at the edge are to be written there.
    """

    def __init__(
        self,
        part: str,
        open_sink: Callable[[], SinkWriter[T]],
        *,
        failures: Failures,
        wait_s: float = 0.0,
        for_backlog: bool = False,
        longest_pause_s: float = 60.0,
        unhurried: bool = False,
    ) -> None:
        self.part = part
        self.for_backlog = for_backlog
        self._wait_s = wait_s
        self._changed = threading.Condition()
        self._queue: deque[tuple[T, int, int, float]] = deque()
        """Items, their sizes, how many were dropped before each, and when they came (monotonic)."""
        self._behind_s = BEHIND_S
        self._taken = 0
        """Items that ever were queued."""
        self._receipts: deque[tuple[int, Callable[[bool], None]]] = deque()
        """The functions to call when this many items are written."""
        self._queued_bytes = 0
        self._skipped = 0
        self._in_hand, self._came_s = False, 0.0
        """Whether an item is being written, and when the last one of them came."""
        self._ending = False
        self._hurry = threading.Event()
        self._failures = failures
        self._turns = nullcontext() if unhurried else Turns(part, failures)
        self._failed = 0
        """Times that the part has failed, at the newest failure here."""
        longest_ns = round(longest_pause_s * SECOND_NS)
        self._pause = RetryPause(min(SECOND_NS, longest_ns), longest_ns)
        self.files: list[Path] = []
        """The sinks in the order of opening."""
        self._open = self._failing = self._resumed = False
        self.missing = 0
        """Items that came while the sink was failing, or for which the queue had no room."""
        self.stored_losses = 0
        """How often an item that an edge has stored may have been lost."""
        self._dropped = 0
        """The latter."""
        self._thread = threading.Thread(
            target=self._run, args=(open_sink,), name=f"hvt-{part}"[:48], daemon=True
        )
        self._thread.start()

    def log(self, item: T) -> None:
        """Queue an item; for any thread. After `close` nothing is taken."""
        size = size_bytes(item)
        with self._changed:
            if self._wait_s and not self._fits(size):
                self._changed.wait_for(lambda: self._fits(size), self._wait_s)
            over = self._ending or self._failing
            if not over and self._fits(size):
                self._queue.append((item, size, self._skipped, time.monotonic()))
                self._taken += 1
                self._queued_bytes += size
                self._skipped = 0
                self._changed.notify_all()
                return
            self.stored_losses += is_stored(item)
            self.missing += not self._ending
            if not over:
                self._dropped += 1
                self._skipped += 1
                if self._dropped.bit_count() == 1:  # 1, 2, 4, 8 …
                    _log.warning("%s is too slow: %d events were dropped so far", self.part, self._dropped)

    def close(self, hurry: threading.Event | None = None) -> None:  # noqa: ARG002 - `join` has its own
        """Take nothing more; the queue is written and the sink closed in its own time."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()

    def join(self, within_s: float) -> bool:
        """Wait for the end (`joined`), then for a second more without slow extras."""
        _join([self], within_s)
        return self.ended

    @property
    def idle(self) -> bool:
        """Whether all that could be written is."""
        with self._changed:
            return not self._left

    @property
    def _left(self) -> int:
        return len(self._queue) + self._in_hand

    def is_open(self, *, within_s: float = 0.0) -> bool:
        """Whether an item logged now will be written, as far as is known; waits ``within_s`` for the sink to be made.

        Not where half the queue is full: stored items can come later and leave the rest to live ones.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._open or self._failing, within_s)
            has_space = len(self._queue) < _MOST_ITEMS // 2 and self._queued_bytes < _MOST_BYTES // 2
            return self._open and has_space

    def on_written(self, done: Callable[[bool], None], *, losses: int) -> None:
        """Call ``done(True)`` when all that was stored and logged so far is written, ``done(False)`` when it is not.

        It is not where `stored_losses` is not ``losses`` any more. Called once, here or in the sink's thread.
        """
        with self._changed:
            whole = self.stored_losses == losses
            if whole and (self._queue or self._in_hand):
                self._receipts.append((self._taken, done))
                return
        done(whole)

    def take_resumed(self) -> bool:
        """Whether it goes on after a gap since the last call: its video does with the next keyframe."""
        resumed, self._resumed = self._resumed, False
        return resumed

    @property
    def ended(self) -> bool:
        return not self._thread.is_alive()

    def _fits(self, size: int) -> bool:
        # Or whether there is no need of any.
        if self._ending or self._failing or not self._queue:
            return True
        return len(self._queue) < _MOST_ITEMS and self._queued_bytes + size <= _MOST_BYTES

    @property
    def behind_s(self) -> float:
        """For how long the oldest item waits that is not written yet; 0 where none does."""
        with self._changed:
            came_s = self._came_s if self._in_hand else self._queue[0][3] if self._queue else None
        return 0.0 if came_s is None else time.monotonic() - came_s

    # In its own thread

    def _run(self, open_sink: Callable[[], SinkWriter[T]]) -> None:
        # Not an attribute: the sink of an ended session is kept for its counts, its maker is not.
        while not self._use(open_sink):
            while not self._pause.due(time.monotonic_ns()):
                with self._changed:
                    if self._changed.wait_for(lambda: self._ending, _POLL_S):
                        self._failures.over(self.part, self._failed)
                        return

    def _use(self, open_sink: Callable[[], SinkWriter[T]]) -> bool:
        # Make the sink and write until the end; False where that failed.
        sink: SinkWriter[T] | None = None
        try:
            with self._turns:
                sink = open_sink()
            self._begin(sink)
            while (taken := self._take()) is not None:
                item, skipped = taken
                with self._turns:
                    if skipped:
                        sink.skipped(skipped)
                        self._resumed = True
                    sink.log(item)
                self._resumed |= sink.awaits_keyframe
                sink.awaits_keyframe = False
                if sink.path is not None and sink.path != self.files[-1]:
                    self.files.append(sink.path)
            sink.close(self._hurry)
        except foreign() as error:  # everything else goes on
            if sink is not None:
                with suppress(BaseException):
                    sink.close(_AT_ONCE)
            self._fail(error)
            return False
        return True

    def _begin(self, sink: SinkWriter[T]) -> None:
        if sink.path is not None:
            self.files.append(sink.path)
        with self._changed:
            self._resumed |= self._failing
            self._open, self._failing = True, False
            self._changed.notify_all()
        self._failures.works(self.part)

    def _take(self) -> tuple[T, int] | None:
        # The next item, and how many were dropped before it; None at the end.
        self._give_receipts()
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._ending)
            if not self._queue:
                return None
            item, size, skipped, self._came_s = self._queue.popleft()
            self._queued_bytes -= size
            self._in_hand = True
            if self._wait_s:
                self._changed.notify_all()
        if (behind_s := time.monotonic() - self._came_s) >= self._behind_s:
            self._behind_s = 2 * behind_s
            _log.warning("%s is too slow: it is %d s behind, which a kill would lose", self.part, behind_s)
        elif behind_s < BEHIND_S / 2:
            self._behind_s = BEHIND_S
        return item, skipped

    def _give_receipts(self) -> None:
        written: list[Callable[[bool], None]] = []
        with self._changed:
            self._in_hand = False
            while self._receipts and self._receipts[0][0] <= self._taken - len(self._queue):
                written.append(self._receipts.popleft()[1])
        for done in written:
            done(True)

    def _fail(self, error: BaseException) -> None:
        self._pause.failed(time.monotonic_ns())
        with self._changed:
            self._open, self._failing = False, True
            self.missing += len(self._queue) + self._in_hand
            self._queue.clear()
            self._queued_bytes = self._skipped = 0
            self._in_hand = False
            self.stored_losses += 1
            lost = [done for _, done in self._receipts]
            self._receipts.clear()
            self._changed.notify_all()
        for done in lost:
            done(False)
        self._failed = self._failures.failed(self.part, reason_of(error), last=self._ending)


def _join(sinks: Sequence[QueuedSink[Any]], within_s: float) -> None:
    for one in sinks:
        one.close()
    threads = [one._thread for one in sinks]  # noqa: SLF001 - of this module
    if joined(*threads, left=lambda: sum(one._left for one in sinks), within_s=within_s):  # noqa: SLF001
        return
    for one in sinks:
        one._hurry.set()  # noqa: SLF001
    joined(*threads, left=lambda: 0, within_s=1.0)
    for one in sinks:
        if not one.ended:
            one._fail(UserError("it did not end in time, and what it had yet to write is lost"))  # noqa: SLF001


def is_stored(item: object) -> bool:
    """Whether an edge has stored it and forgets it when it is acknowledged."""
    return isinstance(item, VideoSample | Refinement) and item.stored


def size_bytes(item: object) -> int:
    """About the memory of an item."""
    match item:
        case Received():
            return item.size_bytes + _SMALL_BYTES
        case VideoSample():
            return len(item.data) + _SMALL_BYTES
        case Refinement():
            pictures = (item.still_bgr, item.base_crop_bgr)
            return len(item.still) + sum(one.nbytes for one in pictures if one is not None) + _SMALL_BYTES
        case Overlay():
            return _TRACK_BYTES * len(item.track_ids) + _SMALL_BYTES
    return _SMALL_BYTES


class Receipt:
    """Whether all events stored and logged between its making and `then` are written by each of ``sinks``."""

    def __init__(self, sinks: Sequence[QueuedSink[Any]]) -> None:
        self._sinks = [(sink, sink.stored_losses) for sink in sinks]

    def then(self, done: Callable[[bool], None]) -> None:
        """Call ``done(True)`` when all of it is written, ``done(False)`` when some is lost; once, in any thread."""
        if not self._sinks:
            done(True)
            return
        sink, losses = self._sinks.pop()
        sink.on_written(lambda whole: self.then(done) if whole else done(False), losses=losses)


class Outputs:
    """All sinks of a ground, for its end; ``failures`` learns their outcomes. For any thread."""

    def __init__(self, failures: Failures) -> None:
        self._failures = failures
        self._sinks: list[QueuedSink[Any]] = []
        self._lock = threading.Lock()

    def open(
        self,
        part: str,
        open_sink: Callable[[], SinkWriter[T]],
        *,
        wait_s: float = 0.0,
        for_backlog: bool = False,
        longest_pause_s: float = 60.0,
    ) -> QueuedSink[T]:
        """A sink behind a queue (`QueuedSink`)."""
        sink = QueuedSink(
            part,
            open_sink,
            failures=self._failures,
            wait_s=wait_s,
            for_backlog=for_backlog,
            longest_pause_s=longest_pause_s,
        )
        with self._lock:
            self._sinks = [one for one in self._sinks if not one.ended]
            self._sinks.append(sink)
        return sink

    @property
    def idle(self) -> bool:
        """Whether all that could be written is."""
        with self._lock:
            return all(one.idle for one in self._sinks)

    @property
    def behind_s(self) -> dict[str, float]:
        """Seconds, by part: the age of the oldest item that a sink has not written, where it is long."""
        with self._lock:
            late = sorted((one.behind_s, one.part) for one in self._sinks)  # of one part the latest counts
        return {part: late_s for late_s, part in late if late_s >= BEHIND_S}

    def close(self, *, within_s: float = 8.0) -> None:
        """End them all, as `QueuedSink.join` does."""
        with self._lock:
            sinks = list(self._sinks)
        _join(sinks, within_s)
