"""Coded units that the edge has not decoded: a decoder that goes on needs them first."""

from __future__ import annotations

from typing import Final

from hvt_common.values import AccessUnit

_MOST_BYTES: Final = 2 * 2**20


class SkippedUnits:
    """Access units of frames that were not analyzed: the decoder needs them before the next. Bounded in bytes."""

    def __init__(self) -> None:
        self._units: list[AccessUnit] = []
        self._whole = True
        """Whether all since the last keyframe are there."""

    def add(self, unit: AccessUnit | None) -> None:
        """This frame is not analyzed; ``unit`` is None where it was not coded."""
        if unit is None:
            return
        if unit.keyframe:
            self._units, self._whole = [], True
        self._units.append(unit)
        if not self._whole or sum(len(one.data) for one in self._units) > _MOST_BYTES:
            self._units, self._whole = [], False

    def lose(self) -> None:
        """Units that were handed out did not reach the decoder."""
        self._units, self._whole = [], False

    def take(self, unit: AccessUnit | None) -> tuple[AccessUnit | None, tuple[AccessUnit, ...]]:
        """Return what the decoder may be given now: this frame's unit, and those before it.

        Where units are missing it is nothing until a keyframe: the frame is analyzed as one that was not coded.
        """
        if unit is None:
            return None, ()
        if unit.keyframe:
            self._units, self._whole = [], True
        skipped, self._units = tuple(self._units), []
        return (unit, skipped) if self._whole else (None, ())
