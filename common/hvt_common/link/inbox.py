"""The bounded queue between Zenoh's callbacks, which must never block, and our own threads."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from typing import Literal, Protocol

__all__ = ["Inbox", "Received", "Sink"]


@dataclass(frozen=True, slots=True)
class Received:
    """One message as it came, nothing of it checked yet."""

    key: str
    payload: bytes
    attachment: bytes
    encoding: str
    received_ns: int
    """Our Unix clock in Zenoh's callback."""


class Sink(Protocol):
    """Where Zenoh's callbacks put what came; must never block."""

    def put(self, item: Received) -> None:
        """Take one message."""
        ...


class Inbox:
    """A bounded queue between Zenoh's callbacks and one of our threads; putting never blocks.

    ``overflow`` says what gives way when it is full: ``newest`` for the base stream (what is queued stays whole up
    to a gap), ``oldest`` where the latest value wins.
    """

    def __init__(self, *, capacity: int, overflow: Literal["newest", "oldest"]) -> None:
        self._items: deque[Received] = deque()
        self._capacity = capacity
        self._overflow = overflow
        self._changed = threading.Condition()
        self._closed = False
        self.dropped = 0
        """Messages that found no room."""

    def put(self, item: Received) -> None:
        """Add a message, or drop one."""
        with self._changed:
            if len(self._items) >= self._capacity:
                self.dropped += 1
                if self._overflow == "newest":
                    return
                self._items.popleft()
            self._items.append(item)
            self._changed.notify()

    def get(self, *, timeout_s: float) -> Received | None:
        """The oldest message; None after ``timeout_s``, or at once when closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._closed, timeout_s)
            return self._items.popleft() if self._items else None

    def close(self) -> None:
        """Wake whoever waits; what is queued can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def __len__(self) -> int:
        return len(self._items)
