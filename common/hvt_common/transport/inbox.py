"""The bounded queue between Zenoh's callbacks, which must never block, and our own threads; and a watch for floods.

A flood is far more messages of one kind than a working peer sends. Its watch takes time as an argument.
"""

import threading
from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass

from hvt_common.units import SECOND_NS

CAPACITY_BYTES = 64 * 2**20
"""The size limit of one inbox: minutes of a base stream, and sixteen of the largest messages there are."""


@dataclass(frozen=True, slots=True)
class Received:
    """One message as it came, nothing of it checked yet."""

    key: str
    payload: bytes
    attachment: bytes
    encoding: str
    received_ns: int
    """Our clock in Zenoh's callback, Unix nanoseconds."""

    @property
    def size_bytes(self) -> int:
        return len(self.payload) + len(self.attachment)


class Inbox:
    """A bounded queue between Zenoh's callbacks and one of our threads; putting never blocks.

    It is bounded in messages and in bytes: a payload may have megabytes. A message that does not fit is dropped:
    the queue stays whole up to a gap. With a ``share`` below 1 no key may take more than that of it: a flood under
    one does not keep the others out.
    """

    def __init__(self, *, capacity: int, capacity_bytes: int = CAPACITY_BYTES, share: float = 1.0) -> None:
        self._items: deque[Received] = deque()
        self._bytes = 0
        self._capacity = capacity
        self._capacity_bytes = capacity_bytes
        self._share = share
        self._by_key: dict[str, tuple[int, int]] = {}
        """Messages and bytes of each key that has any."""
        self._changed = threading.Condition()
        self._closed = False
        self.dropped = 0
        """Messages that did not fit."""

    def put(self, item: Received) -> None:
        with self._changed:
            if not self._fits(item):
                self.dropped += 1
                return
            self._items.append(item)
            self._account(item, 1)
            self._changed.notify()

    def get(self, *, timeout_s: float) -> Received | None:
        """The oldest message; None after ``timeout_s``, or at once when closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._closed, timeout_s)
            return self._take() if self._items else None

    def close(self) -> None:
        """Wake the waiting thread; queued messages can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def __len__(self) -> int:
        return len(self._items)

    def _take(self) -> Received:
        item = self._items.popleft()
        self._account(item, -1)
        return item

    def _account(self, item: Received, sign: int) -> None:
        size_bytes = sign * item.size_bytes
        self._bytes += size_bytes
        count, held_bytes = self._by_key.get(item.key, (0, 0))
        if count + sign:
            self._by_key[item.key] = (count + sign, held_bytes + size_bytes)
        else:
            del self._by_key[item.key]

    def _fits(self, item: Received) -> bool:
        count, held_bytes = self._by_key.get(item.key, (0, 0))
        return (
            len(self._items) < self._capacity
            and self._bytes + item.size_bytes <= self._capacity_bytes
            and count < self._share * self._capacity
            and held_bytes + item.size_bytes <= self._share * self._capacity_bytes
        )


_AGAIN_NS = 60 * SECOND_NS
"""Between two warnings: a flood is not to fill the log."""


class TokenBucket:
    """Grants ``burst`` at once, and after that one each ``every_ns``; for one thread.

    Where the clock was set back it goes on from there.
    """

    def __init__(self, *, burst: int, every_ns: int) -> None:
        self._burst_ns, self._every_ns = burst * every_ns, every_ns
        self._paid_ns: int | None = None
        """Grants are paid for up to this time."""

    def take(self, now_ns: int) -> bool:
        """Whether there is one more now."""
        earliest_ns = now_ns - self._burst_ns
        paid_ns = earliest_ns if self._paid_ns is None else min(max(self._paid_ns, earliest_ns), now_ns)
        granted = paid_ns + self._every_ns <= now_ns
        self._paid_ns = paid_ns + self._every_ns * granted
        return granted


class FloodWatch:
    """Counts messages of each kind second by second; may be used by any thread.

    ``most_per_s`` of one kind in a second are no flood: at least twice the rate of the busiest peer.
    """

    def __init__(self, *, most_per_s: int) -> None:
        self._most = most_per_s
        self._lock = threading.Lock()
        self._second = -1
        self._counts: dict[Hashable, int] = {}
        self._said_ns: int | None = None

    def note(self, kind: Hashable, *, now_ns: int) -> int | None:
        """A message of this kind came; its number in this second where that is worth a warning now, else None."""
        with self._lock:
            second = now_ns // SECOND_NS
            if second != self._second:
                self._second = second
                self._counts.clear()
            count = self._counts[kind] = self._counts.get(kind, 0) + 1
            if count <= self._most or (self._said_ns is not None and now_ns - self._said_ns < _AGAIN_NS):
                return None
            self._said_ns = now_ns
            return count
