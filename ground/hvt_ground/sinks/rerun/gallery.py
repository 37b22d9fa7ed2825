"""Where a still goes in the gallery, and for how long it stays: a grid of pairs, base crop left, still right.

Coordinates are those of the gallery's own canvas, `CANVAS` units wide and high; nothing here knows Rerun.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["CANVAS", "HOLD_S", "SLOTS", "Gallery", "Placement", "frame_of", "placed"]

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


class Gallery:
    """Hands out slots so that a pair can be looked at: each is held for a while, a changed class above all.

    Args:
        hold_s: How long a pair keeps its slot at least, in seconds of capture time.
    """

    def __init__(self, *, hold_s: float = HOLD_S) -> None:
        self._hold_ns = round(hold_s * 1e9)
        self._since_ns: dict[int, int] = {}
        self._changed: dict[int, bool] = {}

    def take(self, capture_ns: int, *, changed: bool) -> int | None:
        """The slot for a still taken at ``capture_ns``, or None when all are held.

        ``changed`` says that the still changed the class: then it may replace, before its time, one that did not.
        """
        slot = self._free(capture_ns, changed=changed)
        if slot is not None:
            self._since_ns[slot] = capture_ns
            self._changed[slot] = changed
        return slot

    def _free(self, capture_ns: int, *, changed: bool) -> int | None:
        for slot in range(SLOTS):
            if slot not in self._since_ns:
                return slot
        oldest = min(self._since_ns, key=self._since_ns.__getitem__)
        if capture_ns - self._since_ns[oldest] >= self._hold_ns:
            return oldest
        if not changed:
            return None
        unchanged = [slot for slot, was in self._changed.items() if not was]
        return min(unchanged, key=self._since_ns.__getitem__, default=None)
