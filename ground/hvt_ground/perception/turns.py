"""A fair lock: sessions that share a detector get it equally often, and none waits for long.

A session that waited its turn out would let its pictures pile up, and show them all late. So it waits for a part of
the time to its next picture; then it follows its tracks through this one and asks again with the next.
"""

from __future__ import annotations

import threading
import time

_ABSENT_S = 5.0
"""Whoever has not asked for so long is new when it comes again: it has nothing to catch up."""


class Turns:
    """Of one detector. ``who`` is any hashable; safe for threads."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._taken = False
        self._queue: dict[object, None] = {}
        """In the order of asking."""
        self._had: dict[object, int] = {}
        """How many turns each session had that asked lately; a newcomer begins with the least of the others."""
        self._requested_s: dict[object, float] = {}

    def take(self, who: object, *, within_s: float | None) -> bool:
        """Whether it became this session's turn within that time (None: however long); it lasts until `release`."""
        with self._changed:
            self._note(who)
            self._queue[who] = None
            granted = self._changed.wait_for(lambda: not self._taken and self._next() == who, within_s)
            del self._queue[who]
            if granted:
                self._had[who] += 1
                self._taken = True
            return granted

    def release(self) -> None:
        """The turn that was taken is over."""
        with self._changed:
            self._taken = False
            self._changed.notify_all()

    def _next(self) -> object:
        # Of those that wait the one that had the fewest turns.
        return min(self._queue, key=self._had.__getitem__)

    def _note(self, who: object) -> None:
        now_s = time.monotonic()
        for one in [one for one, at_s in self._requested_s.items() if now_s - at_s > _ABSENT_S]:
            if one not in self._queue:
                del self._requested_s[one], self._had[one]
        self._had.setdefault(who, min(self._had.values(), default=0))
        self._requested_s[who] = now_s
