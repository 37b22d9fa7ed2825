"""Statistics in bounded memory, however long a run is: percentiles of a latency, and the number of distinct ids."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

_LOWEST_MS = 0.01
_HIGHEST_MS = 1e6
_LOG_RATIO = math.log(1.01)
_BINS = math.ceil(math.log(_HIGHEST_MS / _LOWEST_MS) / _LOG_RATIO) + 1


class LatencyStats:
    """p50, p95, max and any other percentile of the latencies added so far.

    A histogram whose bins grow by 1 % (log-spaced, 0.01 ms to 1000 s, about 15 kB). A percentile is interpolated
    between order statistics, each replaced by the centre of its bin: at most 0.5 % off, or 0.01 ms where that is
    more. The maximum and the count are exact.
    """

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS, np.int64)
        self._count = 0
        self._min_ms = math.inf
        self._max_ms = -math.inf

    def __len__(self) -> int:
        return self._count

    def add(self, latency_ms: float) -> None:
        """Count one latency in milliseconds; ``ValueError`` unless it is a finite number."""
        if not math.isfinite(latency_ms):
            raise ValueError(f"a latency must be a finite number of milliseconds, not {latency_ms!r}")
        latency_ms = max(0.0, latency_ms)  # below zero the two clocks disagree
        self._counts[_bin(latency_ms)] += 1
        self._count += 1
        self._min_ms = min(self._min_ms, latency_ms)
        self._max_ms = max(self._max_ms, latency_ms)

    def percentile(self, percent: float) -> float | None:
        """The ``percent`` (0…100) percentile in milliseconds, linear between ranks; None when empty."""
        if not 0 <= percent <= 100:
            raise ValueError(f"a percentile lies within 0…100, not {percent!r}")
        if not self._count:
            return None
        rank = percent / 100 * (self._count - 1)
        below, above = math.floor(rank), math.ceil(rank)
        # searchsorted(right) gives the bin that holds the order statistic of that rank (0-based).
        bins = np.searchsorted(np.cumsum(self._counts), [below, above], side="right")
        low_ms, high_ms = (
            self._order_statistic(int(b), r) for b, r in zip(bins, (below, above), strict=True)
        )
        return low_ms + (rank - below) * (high_ms - low_ms)

    def as_dict(self) -> dict[str, float | None]:
        """``{"p50", "p95", "max"}`` in milliseconds, rounded to 0.01; each None when nothing was added."""
        largest = self._max_ms if self._count else None
        values = {"p50": self.percentile(50), "p95": self.percentile(95), "max": largest}
        return {name: None if value is None else round(value, 2) for name, value in values.items()}

    def _order_statistic(self, index: int, rank: int) -> float:
        # The centre of a bin, except for the two order statistics that are known exactly.
        if rank == 0:
            return self._min_ms
        if rank == self._count - 1:
            return self._max_ms
        centre_ms = _LOWEST_MS * math.exp((index - 0.5) * _LOG_RATIO) if index else 0.0
        return min(max(centre_ms, self._min_ms), self._max_ms)


class DistinctIds:
    """Counts distinct ids that mostly grow, such as those of tracks and messages.

    The newest ``remember`` of them are known one by one; older ones count as known.
    """

    def __init__(self, *, remember: int = 10_000) -> None:
        self._remember = remember
        self._known: set[int] = set()
        self._floor: int | None = None
        self.count = 0

    def add(self, ids: Iterable[int]) -> int:
        """Take ids; return how many of them are new."""
        new = {one for one in ids if self._floor is None or one > self._floor} - self._known
        self.count += len(new)
        self._known |= new
        if len(self._known) > 2 * self._remember:
            ordered = sorted(self._known)
            self._floor = ordered[-self._remember - 1]
            self._known = set(ordered[-self._remember :])
        return len(new)


def _bin(latency_ms: float) -> int:
    # Bin 0 holds 0…0.01 ms; bin i holds 0.01 · 1.01^(i-1) … 0.01 · 1.01^i; the last one all that is above.
    if latency_ms <= _LOWEST_MS:
        return 0
    return min(1 + int(math.log(latency_ms / _LOWEST_MS) / _LOG_RATIO), _BINS - 1)
