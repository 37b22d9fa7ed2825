"""The thread that owns the disk: it writes objects, and makes chunks of stored ones when the link allows.

Objects wait for it in a bounded queue (`Intake`). When the queue is full the disk is too slow: later objects are not
stored, and the log says so once. While a disk is full, read-only or gone, nothing is stored; objects already there
are sent all the same. Any other error, of a file that another program has changed or of this one, stops storing or
sending alone, which is tried again: video needs neither. Each chunk leaves in a thread of its own, because a link
that is full for seconds must not hold up the disk.
"""

from __future__ import annotations

import logging
import shutil
import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from hvt_common.errors import foreign
from hvt_common.protocol.messages import (
    AcknowledgedRange,
    BacklogKind,
    BacklogStill,
    ObjectKey,
    pack_backlog_still,
)
from hvt_common.runtime.failures import Failures, RetryPause, Turns, reason_of
from hvt_common.runtime.process import in_thread, joined, lower_priority
from hvt_common.runtime.statistics import Newest
from hvt_common.units import SECOND_NS
from hvt_common.values import AccessUnit
from hvt_edge.backlog.backfill import Backfill
from hvt_edge.backlog.disk import Store
from hvt_edge.backlog.entry import MOST_UNIT_BYTES, Entry
from hvt_edge.link.transmitter import Chunk

_MOST_ACKNOWLEDGED_RANGES = 64
"""Limit for all grounds together, the newest of each object; one report names 16."""


@dataclass(frozen=True, slots=True)
class IntakeStill:
    """A still for the disk."""

    number: int
    capture_ns: int
    utility: float
    still: BacklogStill


@dataclass(frozen=True, slots=True)
class EndSegment:
    """Marks the end of a segment: the queued frames before it are one object."""


Item = AccessUnit | IntakeStill | EndSegment


@dataclass(slots=True)
class News:
    """The events since the last `take`."""

    woken: bool = False
    interrupted: bool = False
    """The link went down: nothing is under way."""
    video_first: bool = False
    """A ground requested the video."""
    acknowledged: Newest[tuple[int, ObjectKey], AcknowledgedRange] = field(
        default_factory=partial(Newest, _MOST_ACKNOWLEDGED_RANGES)
    )
    """Acknowledged bytes, by receiver id and object."""


class Intake:
    """A queue from any thread to one. Holds ``most`` frames and stills, and at most one signal for each.

    A disk that is too slow costs frames and stills, and the log says so. It must not cost a signal: a segment without
    an end would cost much more. So signals are states, not items.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._changed = threading.Condition()
        self._items: deque[Item] = deque()
        self._queued = 0
        self._in_hand = False
        self._news = News()
        self._closed = False

    def __len__(self) -> int:
        return self._queued

    @property
    def idle(self) -> bool:
        """Whether no item waits and the last `take` returned none."""
        with self._changed:
            return not (self._items or self._in_hand)

    @property
    def ended(self) -> bool:
        with self._changed:
            return self._closed and not self._items

    # From any thread

    def offer(self, item: AccessUnit | IntakeStill) -> bool:
        """Queue an item to be stored; False where the queue is full."""
        with self._changed:
            if self._closed or self._queued >= self._most:
                return False
            self._items.append(item)
            self._queued += 1
            self._changed.notify()
        return True

    def end_segment(self) -> None:
        """The frames offered so far are one object."""
        with self._changed:
            if not (self._items and isinstance(self._items[-1], EndSegment)):
                self._items.append(EndSegment())
                self._changed.notify()

    def signal(self, *, interrupted: bool = False, video_first: bool = False, closed: bool = False) -> None:
        """Signal an event of `News`, or only let `take` return. ``closed``: no further item comes."""
        with self._changed:
            self._news.interrupted |= interrupted
            self._news.video_first |= video_first
            self._closed |= closed
            self._wake()

    def on_acknowledged(self, acknowledged_ranges: Sequence[AcknowledgedRange], *, receiver_id: int) -> None:
        """A ground acknowledges bytes; the newest report counts, and one that is lost is repeated."""
        with self._changed:
            for one in acknowledged_ranges:
                self._news.acknowledged.put((receiver_id, one.key), one)
            self._wake()

    def _wake(self) -> None:
        self._news.woken = True
        self._changed.notify()

    # In the thread that takes

    def take(self, timeout_s: float) -> tuple[News, Item | None]:
        """The events and the next item; None where no item came within ``timeout_s``, or an event came first."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._news.woken, timeout=timeout_s)
            news, self._news = self._news, News()
            item = self._items.popleft() if self._items else None
            self._in_hand = item is not None
            self._queued -= item is not None and not isinstance(item, EndSegment)
            return news, item


_log = logging.getLogger(__name__)

_PART, _SENDING_PART = "store", "backlog"
"""The names of storing and of sending among the parts whose failures are reported."""
_QUEUE = 512
_BUSY_S = 0.02
_IDLE_S = 0.25
_CLOSE_S = 5.0
_LAST_CHUNK_S = 1.0
"""Time that the last chunk has to leave."""
_MEASURED_NS, _OLD_NS = SECOND_NS, 5 * SECOND_NS
"""How often the disk's free space is measured, and how long a measurement counts."""


@dataclass(frozen=True, slots=True)
class StoreNumbers:
    """The contents and counters of the store."""

    stills: int = 0
    segments: int = 0
    """Stretches of video, including the one that is being written."""
    video_s: float = 0.0
    disk_bytes: int = 0
    sent_stills: int = 0
    sent_video_s: float = 0.0
    acknowledged_bytes: int = 0
    evicted_stills: int = 0
    evicted_segments: int = 0
    unreadable: int = 0
    given_up: int = 0
    unacknowledged_bytes: int = 0
    """Bytes sent that no report of a ground names yet."""

    @property
    def empty(self) -> bool:
        return not (self.stills or self.segments)


class StoreWorker:
    """Stores, sends, and closes the store; all disk access runs in its thread.

    Any error of storing or sending goes to ``failures``, and the work is tried again. ``allowance(now_ns)`` is the
    limit of a chunk, 0 where none may be sent. ``send(chunk)``, which may block, returns its line bytes, 0 where it
    was not sent. ``on_sent(entry)`` is called for each object that a ground has completely. `close` waits ``close_s``
    for the disk.
    """

    def __init__(
        self,
        store: Store,
        *,
        session_id: int,
        clock: Callable[[], int],
        allowance: Callable[[int], int],
        send: Callable[[Chunk], int],
        round_trip_ns: Callable[[], int],
        failures: Failures,
        on_sent: Callable[[Entry], None] = lambda _entry: None,
        close_s: float = _CLOSE_S,
    ) -> None:
        self._store = store
        self._allowance, self._send = allowance, send
        self._round_trip_ns = round_trip_ns
        self._clock = clock
        self._failures = failures
        self._on_sent = on_sent
        self._close_s = close_s
        self._backfill = Backfill(store, session_id=session_id, on_done=self._note_done)
        self.intake = Intake(_QUEUE)
        """Takes signals directly; objects to store come by `offer`."""
        self._sending: tuple[Chunk, Future[int]] | None = None
        """The chunk that was sent last, until its outcome is noted."""
        self._link = threading.Lock()
        """Held while a chunk is being sent."""
        self._sent_stills = self._sent_ns = 0
        self._slow = self._sends_no_more = False
        self._free: tuple[int, int | None] | None = None
        """When the disk's free bytes were measured, and their number."""
        self._too_large = 0
        self._retry, self._sending_retry = RetryPause(), RetryPause()
        self.failed = False
        """The disk refuses: nothing is stored until a trial write succeeds."""
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="hvt-store", daemon=True)
        self._thread.start()

    # From other threads

    def check(self) -> None:
        """Raise the error that has ended the thread, once."""
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def offer(self, item: AccessUnit | IntakeStill) -> bool:
        """Queue an item to be stored; False where the disk is too slow or refuses, or the item is too large."""
        self.check()
        if self.failed:
            return False
        if isinstance(item, AccessUnit) and len(item.data) > MOST_UNIT_BYTES:
            self._too_large += 1
            if self._too_large.bit_count() == 1:  # 1, 2, 4, 8 …
                size = f"{len(item.data) / 1e6:.1f} MB"
                _log.warning("a frame of %s is too large to be stored (%d so far)", size, self._too_large)
            return False
        if not self.intake.offer(item):
            if not self._slow:
                self._slow = True
                _log.warning(
                    "the disk of --store-folder is too slow: some of what is captured now is not stored"
                )
            return False
        return True

    @property
    def numbers(self) -> StoreNumbers:
        store = self._store
        return StoreNumbers(
            stills=store.stills,
            segments=store.segments + store.open_segments,
            video_s=store.span_ns / SECOND_NS,
            disk_bytes=store.disk_bytes,
            sent_stills=self._sent_stills,
            sent_video_s=self._sent_ns / SECOND_NS,
            acknowledged_bytes=self._backfill.acknowledged_bytes,
            evicted_stills=store.evicted_stills,
            evicted_segments=store.evicted_segments,
            unreadable=store.damaged,
            given_up=self._backfill.given_up,
            unacknowledged_bytes=self._backfill.unacknowledged_bytes,
        )

    @property
    def disk_free_bytes(self) -> int | None:
        """Free bytes of the store's disk; None where it does not answer."""
        free = self._free
        return free[1] if free is not None and self._clock() - free[0] < _OLD_NS else None

    def send_no_more(self, within_s: float = _LAST_CHUNK_S) -> None:
        """Send no chunk from now on, so that the counts can be final; new objects are still stored.

        The chunk under way has ``within_s`` to leave.
        """
        self._sends_no_more = True
        if self._link.acquire(timeout=within_s):
            self._link.release()

    def close(self) -> None:
        """Write the queue, close the file, join the thread. A disk that hangs costs the queue, and a warning."""
        self.intake.signal(closed=True)
        if not joined(self._thread, left=self.intake.__len__, within_s=self._close_s):
            _log.warning(
                "the disk of --store-folder takes longer than %g s: %d frames and stills that wait for it are not "
                "stored",
                self._close_s,
                len(self.intake),
            )
        self.send_no_more(self._close_s)
        self.check()

    # In the thread

    def _run(self) -> None:
        lower_priority()
        turns = Turns(_PART, self._failures, clock=self._clock)
        try:
            with turns:
                self._attempt(self._store.enter)
            while not self.intake.ended:
                with turns:
                    self._turn()
            self._attempt(self._store.close)
        except BaseException as error:  # noqa: BLE001 - handed to the frame loop, which ends the process
            self._error = error

    def _turn(self) -> None:
        # Only in this thread: a disk that hangs would hold up the frame loop, and live video with it.
        if self._free is None or self._clock() - self._free[0] >= _MEASURED_NS:
            self._free = self._clock(), _free_bytes(self._store.path)
        busy = self._store.stills or self._store.segments
        news, item = self.intake.take(_BUSY_S if busy else _IDLE_S)
        self._attempt_sending(lambda: self._note(news))
        if self.failed and self._retry.due(self._clock()) and self._attempt(self._store.trial):
            self.failed = False
            self._failures.works(_PART)
        if isinstance(item, EndSegment):
            self._attempt(self._store.end_segment)
        elif item is None:
            if self._sending_retry.due(self._clock()):
                self._attempt_sending(self._send_chunk)
        elif not self.failed and not self._attempt(lambda: self._add(item)):
            self._attempt(self._store.end_segment)

    def _attempt(self, do: Callable[[], None]) -> bool:
        # Returns whether it succeeded; after a failure nothing is stored until a trial succeeds.
        try:
            do()
        except Exception as error:  # noqa: BLE001 - a failure stops storing, never the flight
            self._fail(error)
            return False
        return True

    def _fail(self, error: Exception) -> None:
        reason = f"storing stopped ({reason_of(error)})"
        if isinstance(error, OSError):
            reason = f"--store-folder {error.filename or ''}: {error.strerror or error}"
        self.failed = True
        self._retry.failed(self._clock())
        self._failures.failed(_PART, reason)

    def _attempt_sending(self, do: Callable[[], None]) -> None:
        # If sending fails for another reason than the disk, the object in hand is set aside, and sending pauses.
        try:
            do()
        except OSError as error:
            self._fail(error)
        except foreign() as error:  # Zenoh may panic: that stops sending, never storing nor the flight
            self._backfill.put_aside()
            self._sending_retry.failed(self._clock())
            self._failures.failed(_SENDING_PART, f"what was stored is not sent ({reason_of(error)})")

    def _note(self, news: News) -> None:
        if news.interrupted:
            self._backfill.interrupt()
        self._backfill.video_first |= news.video_first
        for (receiver_id, _), one in news.acknowledged.items():
            self._backfill.on_acknowledged(one, receiver_id=receiver_id, now_ns=self._clock())

    def _add(self, item: AccessUnit | IntakeStill) -> None:
        if isinstance(item, AccessUnit):
            self._store.add_unit(item)
        else:
            data = pack_backlog_still(item.still)
            self._store.add_still(item.number, data, utility=item.utility, capture_ns=item.capture_ns)

    def _send_chunk(self) -> None:
        if self._sending is not None:
            chunk, sent = self._sending
            if not sent.done():
                return
            self._sending = None
            if not sent.result():
                self._backfill.take_back(chunk)  # and wait a moment: other messages are being sent
                return
            self._failures.works(_SENDING_PART)
        now_ns = self._clock()
        limit_bytes = 0 if self._sends_no_more else self._allowance(now_ns)
        if not limit_bytes:
            return
        next_chunk = self._backfill.next_chunk(
            limit_bytes, now_ns=now_ns, round_trip_ns=self._round_trip_ns()
        )
        if next_chunk is not None:
            sent = in_thread(partial(self._send_now, next_chunk), name="hvt-backlog")
            self._sending = next_chunk, sent
            sent.add_done_callback(lambda _sent: self.intake.signal())

    def _send_now(self, chunk: Chunk) -> int:
        with self._link:
            return 0 if self._sends_no_more else self._send(chunk)

    def _note_done(self, entry: Entry) -> None:
        self._sent_stills += entry.kind is BacklogKind.STILL
        self._sent_ns += entry.span_ns
        self._on_sent(entry)


def _free_bytes(folder: Path) -> int | None:
    # The folder may not exist yet: its nearest existing parent answers.
    for path in (folder, *folder.parents):
        try:
            return shutil.disk_usage(path).free
        except FileNotFoundError:
            continue
        except OSError:
            break
    return None
