"""Detects a flood, far more messages of one kind than a working peer sends, and bounds what comes of one.

Pure: time is an argument.
"""

from __future__ import annotations

import threading
from collections.abc import Hashable

from hvt_common.units import SECOND_NS

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

    ``most_per_s`` of one kind in a second are no flood: at least twice what the busiest peer sends.
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
