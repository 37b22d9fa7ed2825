"""The gallery: slots of stills and the time that each is held: a grid of pairs, base crop left, still right.

Coordinates are those of the gallery's own canvas, `CANVAS` units wide and high; nothing here knows Rerun. A recording
is read by time, so what is in a slot may be written in any order.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from dataclasses import dataclass

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

_MOST_TIMES = 512
"""Remembered times of a slot: twenty minutes at three stills a second."""
_NEVER_NS = 2**63

Rect = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Placement:
    """The place of a picture on the canvas: ``canvas = picture * scale + (x, y)``."""

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


class Gallery:
    """Hands out slots so that a pair can be looked at: each is held for a while. Not safe for threads.

    ``hold_ns`` is in capture time.
    """

    def __init__(self, slots: int = SLOTS, *, hold_ns: int = round(HOLD_S * 1e9)) -> None:
        self._hold_ns = hold_ns
        self._changed = [False] * slots
        """Whether the still that a slot shows now changed a class."""
        self._times: list[list[tuple[int, int]]] = [[] for _ in range(slots)]
        """(frame index, capture time) of the pairs put into each slot, in their order."""

    def put(self, frame_index: int, capture_ns: int, *, changed: bool) -> int | None:
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
        return self._place(slot, frame_index, capture_ns)

    def put_stored(self, frame_index: int, capture_ns: int) -> int | None:
        """A slot that nothing was put into around that time, the one that was so for the longest.

        One that another still came into later is better: an old one should not stand there now. None where all were
        held, or it is too long ago to tell.
        """
        found: tuple[bool, int, int] | None = None
        for slot, times in enumerate(self._times):
            at = bisect_right(times, (frame_index, _NEVER_NS))
            if not at and len(times) >= _MOST_TIMES:
                continue
            since = capture_ns - times[at - 1][1] if at else _NEVER_NS
            until = times[at][1] - capture_ns if at < len(times) else _NEVER_NS
            this = at < len(times), since, -slot
            if min(since, until) >= self._hold_ns and (found is None or this > found):
                found = this
        return None if found is None else self._place(-found[2], frame_index, capture_ns)

    def _place(self, slot: int, frame_index: int, capture_ns: int) -> int:
        times = self._times[slot]
        insort(times, (frame_index, capture_ns))
        del times[: max(0, len(times) - _MOST_TIMES)]
        return slot
