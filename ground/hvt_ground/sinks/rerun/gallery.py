"""Where a still goes in the gallery, and for how long it stays: a grid of pairs, base crop left, still right.

Coordinates are those of the gallery's own canvas, `CANVAS` units wide and high; nothing here knows Rerun. A recording
is read by time, so the pictures of a slot may be written in any order. The captions of all slots are one row: those
that were written for later times are written again with a late one in its place.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from dataclasses import dataclass, field
from typing import Generic, TypeVar

__all__ = ["CANVAS", "HOLD_S", "SLOTS", "CaptionRow", "Gallery", "Placement", "Put", "frame_of", "placed"]

T = TypeVar("T")

COLUMNS, ROWS = 2, 4
SLOTS = COLUMNS * ROWS
HOLD_S = 1.5
_CELL = (150.0, 92.0)
"""Width and height of one picture."""
_GAP = 6.0
_MARGIN = 12.0
_CAPTION = 30.0
_PAIR = (2 * _CELL[0] + _GAP, _CELL[1] + _CAPTION)

CANVAS = (COLUMNS * (_PAIR[0] + 2 * _MARGIN), ROWS * (_PAIR[1] + _MARGIN) + _MARGIN)
"""(width, height) of everything."""

_MOST_ROWS = 4096
"""Of captions that are remembered: twenty minutes at three stills a second."""
_NEVER_NS = 2**63

Rect = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Placement:
    """How a picture is brought onto the canvas: ``canvas = picture * scale + (x, y)``."""

    x: float
    y: float
    scale: float


def frame_of(slot: int) -> Rect:
    """x1 y1 x2 y2 of the two pictures of a slot together."""
    column, row = slot % COLUMNS, slot // COLUMNS
    x = _MARGIN + column * (_PAIR[0] + 2 * _MARGIN)
    y = _MARGIN + row * (_PAIR[1] + _MARGIN)
    return x, y, x + _PAIR[0], y + _CELL[1]


def placed(slot: int, size: tuple[int, int], *, right: bool) -> Placement:
    """A picture of ``size`` pixels as large as its half of the slot allows, centred there."""
    x1, y1, _, _ = frame_of(slot)
    left = x1 + (_CELL[0] + _GAP if right else 0.0)
    scale = min(_CELL[0] / size[0], _CELL[1] / size[1])
    return Placement(
        x=left + (_CELL[0] - size[0] * scale) / 2, y=y1 + (_CELL[1] - size[1] * scale) / 2, scale=scale
    )


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


class Gallery(Generic[T]):
    """Hands out slots so that a pair can be looked at: each is held for a while. Not safe for threads.

    ``empty`` has the captions while nothing is shown, one a slot; ``hold_ns`` is in capture time.
    """

    def __init__(self, empty: tuple[T, ...], *, hold_ns: int = round(HOLD_S * 1e9)) -> None:
        self._empty = empty
        self._hold_ns = hold_ns
        self._changed = [False] * len(empty)
        """Whether the still that a slot shows now changed a class."""
        self._rows: list[CaptionRow[T]] = []
        self._times: list[list[tuple[int, int]]] = [[] for _ in empty]
        """(frame index, capture time) of what was put into each slot, in their order."""

    def put(self, frame_index: int, capture_ns: int, caption: T, *, changed: bool) -> Put[T] | None:
        """A slot for a still of now; None where all are held.

        ``changed`` says that the still changed the class: then it may replace, before its time, one that did not.
        """
        since_ns = [times[-1][1] if times else -_NEVER_NS for times in self._times]
        slot = min(range(len(since_ns)), key=since_ns.__getitem__)
        if capture_ns - since_ns[slot] < self._hold_ns:
            confirmed = [one for one, was in enumerate(self._changed) if not was]
            if not changed or not confirmed:
                return None
            slot = min(confirmed, key=since_ns.__getitem__)
        self._changed[slot] = changed
        return self._place(slot, frame_index, capture_ns, caption)

    def put_stored(self, frame_index: int, capture_ns: int, caption: T) -> Put[T] | None:
        """A slot that was free at that moment; None where all were held, or it is too long ago to tell."""
        if len(self._rows) >= _MOST_ROWS and frame_index < self._rows[0].frame_index:
            return None
        slot = self._free_then(frame_index, capture_ns)
        return None if slot is None else self._place(slot, frame_index, capture_ns, caption)

    def _free_then(self, frame_index: int, capture_ns: int) -> int | None:
        """Of the slots that nothing was put into around that time, the one that was so for the longest.

        One that another still came into later is better: an old one should not stand there now.
        """
        found: tuple[bool, int, int] | None = None
        for slot, times in enumerate(self._times):
            at = bisect_right(times, (frame_index, _NEVER_NS))
            since = capture_ns - times[at - 1][1] if at else _NEVER_NS
            until = times[at][1] - capture_ns if at < len(times) else _NEVER_NS
            this = at < len(times), since, -slot
            if min(since, until) >= self._hold_ns and (found is None or this > found):
                found = this
        return None if found is None else -found[2]

    def _place(self, slot: int, frame_index: int, capture_ns: int, caption: T) -> Put[T]:
        times = self._times[slot]
        after = bisect_right(times, (frame_index, _NEVER_NS))
        until = times[after][0] if after < len(times) else None
        at = bisect_right(self._rows, CaptionRow(frame_index, 0, ()))
        before = self._rows[at - 1].captions if at else self._empty
        own = CaptionRow(frame_index, capture_ns, _with(before, slot, caption))
        rows = [own]
        for place in range(at, len(self._rows)):
            later = self._rows[place]
            if until is not None and later.frame_index >= until:
                break
            self._rows[place] = CaptionRow(
                later.frame_index, later.capture_ns, _with(later.captions, slot, caption)
            )
            rows.append(self._rows[place])
        insort(self._rows, own)
        insort(times, (frame_index, capture_ns))
        if len(self._rows) > _MOST_ROWS:
            oldest = self._rows.pop(0).frame_index
            for one in self._times:
                del one[: max(0, bisect_right(one, (oldest, _NEVER_NS)) - 1)]
        return Put(slot, tuple(rows))


def _with(captions: tuple[T, ...], slot: int, caption: T) -> tuple[T, ...]:
    return (*captions[:slot], caption, *captions[slot + 1 :])
