"""How long runs still take: each kind by the time of its own earlier flights. Pure: time is an argument.

A flight of one method takes up to ten times as long as that of another: how fast the last ones were says little of
those to come. But other programs, which make one slower than earlier ones of its kind, make all slower.
"""

import heapq
from collections import Counter
from collections.abc import Hashable, Mapping
from typing import Generic, TypeVar

_Run = TypeVar("_Run", bound=Hashable)

_REST = 0.3
"""A run that nears its expected time or takes longer is expected to need this share of its time so far again."""
_NEWEST = 0.4
"""Weight of the newest run among those of its kind, at least; and of how much it is off, for all other kinds."""


class TimeLeft(Generic[_Run]):
    """``runs``, in the order in which so many workers take them, with how much work each is, 0 where others do it.

    ``kinds`` are names of runs of which the same work takes about as long, the narrowest first: the first of which
    something is known counts. The first run of each worker says nothing: it includes work done once, such as reading
    the clip.
    """

    def __init__(
        self, runs: Mapping[_Run, float], *, kinds: Mapping[_Run, tuple[str, ...]], workers: int, now_s: float
    ) -> None:
        self._work, self._kinds = dict(runs), kinds
        self._pending = list(runs)
        self._began: dict[_Run, tuple[float, int]] = {}
        """When, and how many flights were done by then."""
        for _ in range(workers):
            self._begin(now_s, 0)
        self._first = set(self._began)
        self._unit_s: dict[str, float] = {}
        """Seconds for one unit of work now, by kind."""
        self._ended: Counter[str] = Counter()
        """Runs of a kind that count."""

    def ended(self, run: _Run, *, flown: int, now_s: float) -> None:
        """This run has ended; ``flown`` flights are done in all."""
        if run in self._pending:  # a worker took it out of turn
            self._pending.remove(run)
        began_s, flown_then = self._began.pop(run, (now_s, flown))
        work = self._work.pop(run)
        if work and flown > flown_then and run not in self._first:  # else it was in the cache
            self._learn(self._kinds[run], (now_s - began_s) / work)
        self._begin(now_s, flown)

    def left_s(self, *, now_s: float) -> float | None:
        """Until the last has ended; None while of some kind nothing is known."""
        expected_s: dict[_Run, float] = {}
        for run, work in self._work.items():
            known_s = (self._unit_s[kind] for kind in self._kinds[run] if kind in self._unit_s)
            unit_s = next(known_s, None) if work else 0.0
            if unit_s is None:
                return None
            expected_s[run] = unit_s * work
        free_s = []
        for run, (began_s, _) in self._began.items():
            took_s = now_s - began_s
            longest_s = expected_s[run] if run in self._first else max(expected_s[run], took_s)
            free_s.append(max(expected_s[run] - took_s, _REST * longest_s) if expected_s[run] else 0.0)
        heapq.heapify(free_s)
        for run in self._pending:
            heapq.heapreplace(free_s, free_s[0] + expected_s[run])
        return max(free_s, default=0.0)

    def _learn(self, kinds: tuple[str, ...], unit_s: float) -> None:
        known = dict(self._unit_s)
        off = unit_s / known.get(kinds[0], unit_s)
        self._ended.update(kinds)
        for one in known.keys() - set(kinds):
            self._unit_s[one] *= off**_NEWEST
        for one in kinds:
            newest = max(_NEWEST, 1 / self._ended[one])
            self._unit_s[one] = known.get(one, unit_s) ** (1 - newest) * unit_s**newest

    def _begin(self, now_s: float, flown: int) -> None:
        if self._pending:
            self._began[self._pending.pop(0)] = (now_s, flown)
