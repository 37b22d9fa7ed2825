"""Where in the gallery a still goes that is older than what is shown: into a slot that was free at its time.

A recording is read by time, so the pictures of a slot may be written in any order. The captions of all slots are one
row, so those that were written for later times are written again with the new one in its place.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from dataclasses import dataclass, field
from typing import Generic, TypeVar

__all__ = ["BacklogGallery", "CaptionRow", "Put"]

T = TypeVar("T")

_MOST_ROWS = 4096
"""Of captions that are remembered: twenty minutes at three stills a second."""


@dataclass(frozen=True, slots=True, order=True)
class CaptionRow(Generic[T]):
    """The captions from one moment on."""

    frame_index: int
    capture_ns: int = field(compare=False)
    captions: tuple[T, ...] = field(compare=False)


@dataclass(frozen=True, slots=True)
class Put(Generic[T]):
    """What to write for a still."""

    slot: int
    rows: tuple[CaptionRow[T], ...]
    """Captions: its own, and later ones once more."""
    stays: bool
    """Nothing came into the slot later: it is what is shown there now."""


class BacklogGallery(Generic[T]):
    """What each slot held when. Not safe for threads.

    Args:
        empty: the captions while nothing is shown, one a slot.
        hold_ns: for how long a picture keeps its slot at least.
    """

    def __init__(self, empty: tuple[T, ...], *, hold_ns: int) -> None:
        self._empty = empty
        self._hold_ns = hold_ns
        self._rows: list[CaptionRow[T]] = []
        self._slots: list[list[tuple[int, int]]] = [[] for _ in empty]
        """(frame index, capture time) of what was put into each, in their order."""

    def note(self, slot: int, row: CaptionRow[T]) -> None:
        """A still was put into a slot; all captions as they are now."""
        insort(self._rows, row)
        insort(self._slots[slot], (row.frame_index, row.capture_ns))
        if len(self._rows) > _MOST_ROWS:
            oldest = self._rows.pop(0).frame_index
            for times in self._slots:
                del times[: bisect_right(times, (oldest, 2**63))]

    def put(self, frame_index: int, capture_ns: int, caption: T) -> Put[T] | None:
        """A slot for a still of that moment; None where all were held, or it is too long ago to tell."""
        if len(self._rows) >= _MOST_ROWS and frame_index < self._rows[0].frame_index:
            return None
        slot = self._free(frame_index, capture_ns)
        if slot is None:
            return None
        until = self._after(slot, frame_index)
        at = bisect_right(self._rows, CaptionRow(frame_index, 0, ()))
        before = self._rows[at - 1].captions if at else self._empty
        rows = [CaptionRow(frame_index, capture_ns, _with(before, slot, caption))]
        for place in range(at, len(self._rows)):
            later = self._rows[place]
            if until is not None and later.frame_index >= until:
                break
            self._rows[place] = CaptionRow(
                later.frame_index, later.capture_ns, _with(later.captions, slot, caption)
            )
            rows.append(self._rows[place])
        self.note(slot, rows[0])
        return Put(slot, tuple(rows), stays=until is None)

    def _free(self, frame_index: int, capture_ns: int) -> int | None:
        """Of the slots that nothing was put into around that time, the one that was so for the longest.

        One that another still came into later is better: an old one should not stand there now.
        """
        found: tuple[bool, int, int] | None = None
        for slot, times in enumerate(self._slots):
            at = bisect_right(times, (frame_index, 2**63))
            since = capture_ns - times[at - 1][1] if at else 2**63
            until = times[at][1] - capture_ns if at < len(times) else 2**63
            this = at < len(times), since, -slot
            if min(since, until) >= self._hold_ns and (found is None or this > found):
                found = this
        return None if found is None else -found[2]

    def _after(self, slot: int, frame_index: int) -> int | None:
        """The frame at which the next picture comes into the slot."""
        times = self._slots[slot]
        at = bisect_right(times, (frame_index, 2**63))
        return times[at][0] if at < len(times) else None


def _with(captions: tuple[T, ...], slot: int, caption: T) -> tuple[T, ...]:
    return (*captions[:slot], caption, *captions[slot + 1 :])
