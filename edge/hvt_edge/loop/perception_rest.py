"""Rests perception while video loses frames for want of processor time."""

from __future__ import annotations

from typing import Final

from hvt_common.units import SECOND_NS

_FIRST_NS: Final = SECOND_NS // 8
_LONGEST_NS: Final = SECOND_NS // 2
"""If video goes on losing frames whatever perception does, boxes are still made twice a second."""
_STEADY_NS: Final = 5 * SECOND_NS


class PerceptionRest:
    """Has perception rest after each frame that video lost, twice as long while it goes on losing some.

    Pure: time is an argument.
    """

    def __init__(self) -> None:
        self._lost = 0
        self._lost_ns: int | None = None
        self._rest_ns = 0
        self._taken_ns: int | None = None

    def lets(self, lost: int, *, now_ns: int) -> bool:
        """Whether perception may take the frame of now; ``lost``: so many frames video has lost until now."""
        if lost > self._lost:
            steady = self._lost_ns is None or now_ns - self._lost_ns > _STEADY_NS
            self._rest_ns = _FIRST_NS if steady else min(_LONGEST_NS, 2 * self._rest_ns)
            self._lost, self._lost_ns = lost, now_ns
        rests = self._lost_ns is not None and now_ns - self._lost_ns < self._rest_ns
        if rests and self._taken_ns is not None and now_ns - self._taken_ns < _LONGEST_NS:
            return False
        self._taken_ns = now_ns
        return True
