"""How many different ids there have been, in bounded memory."""

from __future__ import annotations

from collections.abc import Iterable

__all__ = ["DistinctIds"]


class DistinctIds:
    """Counts ids that only grow, such as those of tracks and of messages; each once, however often it comes.

    The newest ``remember`` of them are known one by one; beyond, whatever is older counts as seen.
    """

    def __init__(self, *, remember: int = 10_000) -> None:
        self._remember = remember
        self._seen: set[int] = set()
        self._floor: int | None = None
        self.count = 0

    def add(self, ids: Iterable[int]) -> int:
        """Take ids; return how many of them are new."""
        new = {one for one in ids if self._floor is None or one > self._floor} - self._seen
        self.count += len(new)
        self._seen |= new
        if len(self._seen) > 2 * self._remember:
            ordered = sorted(self._seen)
            self._floor = ordered[-self._remember - 1]
            self._seen = set(ordered[-self._remember :])
        return len(new)
