"""What the disk thread is given: frames and stills in their order, bounded, and signals that are never refused.

A disk that is too slow costs frames and stills, and says so. It must not cost a signal: a segment that does not end
would cost much more. So signals are states, not items.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Sequence
from dataclasses import dataclass

from hvt_common.protocol.messages import AcknowledgedRange, BacklogKind, BacklogStill
from hvt_common.values import AccessUnit
from hvt_edge.backlog.entry import Key

__all__ = ["EndSegment", "Intake", "IntakeStill", "IntakeUnit", "News"]

_MOST_ACKNOWLEDGED_RANGES = 64
"""Of all grounds together, the newest of each object; one report names 16."""


@dataclass(frozen=True, slots=True)
class IntakeUnit:
    """An access unit for the disk."""

    unit: AccessUnit
    parameter_sets: bytes
    """The newest keyframe."""


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


@dataclass(frozen=True, slots=True)
class News:
    """What has happened since the last `take`."""

    interrupted: bool
    """The link went: what was on its way is not."""
    video_first: bool
    """A ground requested the video."""
    acknowledged_ranges: tuple[tuple[int, AcknowledgedRange], ...]
    """What grounds say they have, with their receiver ids."""


class Intake:
    """From any thread to one. Holds ``most`` frames and stills, and a signal for each of them at the most."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._changed = threading.Condition()
        self._items: deque[IntakeUnit | IntakeStill | EndSegment] = deque()
        self._queued = 0
        self._interrupted = self._video_first = self._woken = self._closed = False
        self._acknowledged_ranges: OrderedDict[tuple[int, Key], AcknowledgedRange] = OrderedDict()

    def __len__(self) -> int:
        """Frames and stills that wait."""
        return self._queued

    @property
    def ended(self) -> bool:
        """Whether nothing waits and nothing more comes."""
        with self._changed:
            return self._closed and not self._items

    # From any thread

    def offer(self, item: IntakeUnit | IntakeStill) -> bool:
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

    def interrupt(self) -> None:
        """The link went."""
        with self._changed:
            self._interrupted = True
            self._wake()

    def request_video(self) -> None:
        """Somebody wants the video first."""
        with self._changed:
            self._video_first = True
            self._wake()

    def on_acknowledged(self, acknowledged_ranges: Sequence[AcknowledgedRange], *, receiver_id: int) -> None:
        """A ground acknowledges what it has; the newest counts, and one that is lost comes again."""
        with self._changed:
            for acknowledged_range in acknowledged_ranges:
                key = (
                    receiver_id,
                    (
                        acknowledged_range.session_id,
                        BacklogKind(acknowledged_range.kind),
                        acknowledged_range.number,
                    ),
                )
                self._acknowledged_ranges.pop(key, None)
                self._acknowledged_ranges[key] = acknowledged_range
            while len(self._acknowledged_ranges) > _MOST_ACKNOWLEDGED_RANGES:
                self._acknowledged_ranges.popitem(last=False)
            self._wake()

    def wake(self) -> None:
        """Let `take` return."""
        with self._changed:
            self._wake()

    def close(self) -> None:
        """Nothing more comes."""
        with self._changed:
            self._closed = True
            self._wake()

    def _wake(self) -> None:
        self._woken = True
        self._changed.notify()

    # In the thread that takes

    def take(self, timeout_s: float) -> tuple[News, IntakeUnit | IntakeStill | EndSegment | None]:
        """What has happened, and the next item; None where there is none within that time, or something happened."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._woken, timeout=timeout_s)
            news = News(
                self._interrupted,
                self._video_first,
                tuple(
                    (receiver_id, acknowledged_range)
                    for (receiver_id, _), acknowledged_range in self._acknowledged_ranges.items()
                ),
            )
            self._interrupted = self._video_first = self._woken = False
            self._acknowledged_ranges.clear()
            item = self._items.popleft() if self._items else None
            self._queued -= item is not None and not isinstance(item, EndSegment)
            return news, item
