"""The queue of the disk thread: frames and stills in their order, bounded, and signals that are never refused.

A disk that is too slow costs frames and stills, and says so. It must not cost a signal: a segment that does not end
would cost much more. So signals are states, not items.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from hvt_common.protocol.messages import AcknowledgedRange, BacklogStill, ObjectKey
from hvt_common.values import AccessUnit

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
    """The frames before this are an object; it has its place among them."""


Item = AccessUnit | IntakeStill | EndSegment


@dataclass(slots=True)
class News:
    """The events since the last `take`."""

    woken: bool = False
    interrupted: bool = False
    """The link went: nothing is under way."""
    video_first: bool = False
    """A ground requested the video."""
    acknowledged: dict[tuple[int, ObjectKey], AcknowledgedRange] = field(default_factory=dict)
    """Acknowledged bytes, by receiver id and object."""


class Intake:
    """From any thread to one. Holds ``most`` frames and stills, and a signal for each of them at the most."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._changed = threading.Condition()
        self._items: deque[Item] = deque()
        self._queued = 0
        self._in_hand = False
        self._news = News()
        self._closed = False

    def __len__(self) -> int:
        """Frames and stills that wait."""
        return self._queued

    @property
    def idle(self) -> bool:
        """Whether nothing waits, and nothing is in hand since the last `take`."""
        with self._changed:
            return not (self._items or self._in_hand)

    @property
    def ended(self) -> bool:
        """Whether nothing waits and nothing more comes."""
        with self._changed:
            return self._closed and not self._items

    # From any thread

    def offer(self, item: AccessUnit | IntakeStill) -> bool:
        """Hand over something to be stored; False where there is no space for it."""
        with self._changed:
            if self._closed or self._queued >= self._most:
                return False
            self._items.append(item)
            self._queued += 1
            self._changed.notify()
        return True

    def end_segment(self) -> None:
        """The frames offered so far are an object."""
        with self._changed:
            if not (self._items and isinstance(self._items[-1], EndSegment)):
                self._items.append(EndSegment())
                self._changed.notify()

    def signal(self, *, interrupted: bool = False, video_first: bool = False, closed: bool = False) -> None:
        """Something has happened, see `News`; or only let `take` return. ``closed``: nothing more comes."""
        with self._changed:
            self._news.interrupted |= interrupted
            self._news.video_first |= video_first
            self._closed |= closed
            self._wake()

    def on_acknowledged(self, acknowledged_ranges: Sequence[AcknowledgedRange], *, receiver_id: int) -> None:
        """A ground acknowledges bytes; the newest report counts, and a lost one comes again."""
        with self._changed:
            known = self._news.acknowledged
            for one in acknowledged_ranges:
                key = (receiver_id, one.key)
                known.pop(key, None)
                known[key] = one
            while len(known) > _MOST_ACKNOWLEDGED_RANGES:
                del known[next(iter(known))]
            self._wake()

    def _wake(self) -> None:
        self._news.woken = True
        self._changed.notify()

    # In the thread that takes

    def take(self, timeout_s: float) -> tuple[News, Item | None]:
        """The events, and the next item; None if there is none within that time, or something happened."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._news.woken, timeout=timeout_s)
            news, self._news = self._news, News()
            item = self._items.popleft() if self._items else None
            self._in_hand = item is not None
            self._queued -= item is not None and not isinstance(item, EndSegment)
            return news, item
