"""How long runs still take: each kind by what the flights of its own took. Pure: time is an argument.

A flight of one method takes up to ten times as long as that of another: how fast the last ones were says little of
those to come.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Hashable, Mapping
from typing import Generic, TypeVar

_Run = TypeVar("_Run", bound=Hashable)

_REST = 0.1
"""Of a run that takes longer than expected, so much is taken to be left."""


class TimeLeft(Generic[_Run]):
    """``runs``, in the order in which so many workers take them, with how many flights each is expected to take.

    ``kinds`` are runs of which a flight takes about the same. The first run of each worker says nothing: what is done
    once, such as reading the clip, is done in it.
    """

    def __init__(
        self, runs: Mapping[_Run, int], *, kinds: Mapping[_Run, str], workers: int, now_s: float
    ) -> None:
        self._flights, self._kinds = dict(runs), kinds
        self._pending = list(runs)
        self._began: dict[_Run, tuple[float, int]] = {}
        """When, and how many flights were done by then."""
        for _ in range(workers):
            self._begin(now_s, 0)
        self._first = set(self._began)
        self._took: defaultdict[str, tuple[float, int]] = defaultdict(lambda: (0.0, 0))
        """(seconds, flights) of the runs of a kind that have ended."""

    def ended(self, run: _Run, *, flown: int, now_s: float) -> None:
        """This run has ended; ``flown`` flights are done in all."""
        if run in self._pending:  # a worker took it out of turn
            self._pending.remove(run)
        began_s, flown_then = self._began.pop(run, (now_s, flown))
        flights, kind = self._flights.pop(run), self._kinds[run]
        if flights and flown > flown_then and run not in self._first:  # else it was in the cache
            took_s, count = self._took[kind]
            self._took[kind] = took_s + now_s - began_s, count + flights
        self._begin(now_s, flown)

    def left_s(self, *, now_s: float) -> float | None:
        """Until the last has ended; None while of some kind nothing is known."""
        expected_s: dict[_Run, float] = {}
        for run, flights in self._flights.items():
            took_s, count = self._took[self._kinds[run]]
            if flights and not count:
                return None
            expected_s[run] = took_s / count * flights if flights else 0.0
        free_s = [
            max(expected_s[run] - (now_s - began_s), _REST * expected_s[run])
            for run, (began_s, _) in self._began.items()
        ]
        heapq.heapify(free_s)
        for run in self._pending:
            heapq.heapreplace(free_s, free_s[0] + expected_s[run])
        return max(free_s, default=0.0)

    def _begin(self, now_s: float, flown: int) -> None:
        if self._pending:
            self._began[self._pending.pop(0)] = (now_s, flown)
