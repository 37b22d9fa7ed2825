"""The lines of a session's log: bounded, for each goes to every viewer of every edge."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from hvt_common.transport.flood import TokenBucket
from hvt_common.units import SECOND_NS
from hvt_ground.events import Notice

Level = Literal["info", "warning", "error"]

_BURST, _EVERY_NS = 60, SECOND_NS
"""So many at once, then one a second."""


class SessionLog:
    """Gives out lines; in a flood of them some are left out, and counted. ``at``: frame index and capture time."""

    def __init__(self, emit: Callable[[Notice], None], *, clock: Callable[[], int]) -> None:
        self._emit, self._clock = emit, clock
        self._bucket = TokenBucket(burst=_BURST, every_ns=_EVERY_NS)
        self._left_out = 0

    def note(self, level: Level, text: str, *, at: tuple[int, int], last: bool = False) -> None:
        """Give out a line; one of the ``last`` is never left out."""
        if not (last or self._bucket.take(self._clock())):
            self._left_out += 1
            return
        if self._left_out:
            what = f"{self._left_out} lines were left out here: the edge gave rise to too many"
            self._left_out = 0
            self._emit(Notice(*at, "warning", what))
        self._emit(Notice(*at, level, text))
