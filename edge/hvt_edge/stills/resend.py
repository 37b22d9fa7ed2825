"""Stills that a ground could make nothing of, because it does not have the base frame they build on.

The ground names the still's sequence number (`StillResult.again`), and the edge sends the same crop once more, coded
without the base. Only for stills that were really sent, once for each, while it is young; what is kept for
that is bounded in number and bytes, whatever grounds ask for.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

from hvt_edge.stills.outbox import PendingStill

__all__ = ["ResendRing", "ResendSettings"]


@dataclass(frozen=True, slots=True)
class ResendSettings:
    """The bounds: stills, bytes of their crops, and the age of what is still worth seeing."""

    max_count: int = 64
    max_bytes: int = 8 * 2**20
    max_age_ns: int = 4_000_000_000


@dataclass(frozen=True, slots=True)
class _Kept:
    waiting: PendingStill
    sent_ns: int
    size_bytes: int


class ResendRing:
    """Keeps the crops of the stills sent last; the oldest goes first. Time is an argument."""

    def __init__(self, settings: ResendSettings = ResendSettings()) -> None:
        self._settings = settings
        self._kept: OrderedDict[int, _Kept] = OrderedDict()
        self._size_bytes = 0
        self._asked: set[int] = set()

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def size_bytes(self) -> int:
        """Memory of the crops."""
        return self._size_bytes

    def backlog(self, sequence: int, waiting: PendingStill, *, now_ns: int) -> None:
        """Remember a still that was sent; ``waiting.cut`` should hold no base any more."""
        size_bytes = waiting.cut.size_bytes
        self._kept[sequence] = _Kept(waiting, now_ns, size_bytes)
        self._size_bytes += size_bytes
        settings = self._settings
        while len(self._kept) > settings.max_count or self._size_bytes > settings.max_bytes:
            self._drop(next(iter(self._kept)))

    def ask(self, sequence: int) -> None:
        """Note that a ground wants this still again; one that is not kept is ignored."""
        if sequence in self._kept:
            self._asked.add(sequence)

    def take(self, now_ns: int) -> list[tuple[int, PendingStill]]:
        """Return those asked for, in the order in which they were sent, and keep them no longer.

        What was sent too long ago is forgotten.
        """
        for sequence in [
            key for key, kept in self._kept.items() if now_ns - kept.sent_ns > self._settings.max_age_ns
        ]:
            self._drop(sequence)
        return [(sequence, self._drop(sequence)) for sequence in sorted(self._asked)]

    def _drop(self, sequence: int) -> PendingStill:
        kept = self._kept.pop(sequence)
        self._size_bytes -= kept.size_bytes
        self._asked.discard(sequence)
        return kept.waiting
