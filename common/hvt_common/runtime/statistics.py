"""Statistics in bounded memory, however long a run is: percentiles of a latency, sets of numbers, newest entries."""

import math
import threading
from collections import OrderedDict
from collections.abc import Iterable
from typing import TypeVar

import numpy as np

_LOWEST_MS = 0.01
_HIGHEST_MS = 1e6
_LOG_RATIO = math.log(1.01)
_BINS = math.ceil(math.log(_HIGHEST_MS / _LOWEST_MS) / _LOG_RATIO) + 1
_PAGE_BITS = 12
_MOST_SENT = 512
"""Stills whose second copy is still known for one: those of the last seconds."""
_NEVER_NS = -(2**64)
"""When a still was sent that has come with the backlog only."""

_Key = TypeVar("_Key")
_Value = TypeVar("_Value")


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


class Newest(OrderedDict[_Key, _Value]):
    """A table of at most ``most`` keys: one more, and the first goes, that was set before all others.

    A key that is set again stays in its place (`move_to_end`).
    """

    def __init__(self, most: int) -> None:
        super().__init__()
        self._most = most

    def __setitem__(self, key: _Key, value: _Value) -> None:
        super().__setitem__(key, value)
        if len(self) > self._most:
            self.popitem(last=False)

    def put(self, key: _Key, value: _Value) -> bool:
        """Set the newest key; whether it was not there."""
        new = key not in self
        self[key] = value
        self.move_to_end(key)
        return new


class SequenceWindow:
    """A set of numbers from 0, one bit each. A number missed long ago may still come, and is known to be new.

    At most ``pages`` stretches of 4096 numbers are stored, half a kilobyte each; beyond, the one longest unused is
    forgotten. So forged numbers cost bounded memory, and do not make future numbers look known.
    """

    def __init__(self, *, pages: int = 4096) -> None:
        self._pages: Newest[int, int] = Newest(pages)
        """The one that was touched last stands last."""
        self.count = 0

    def add(self, numbers: Iterable[int]) -> int:
        """Take numbers; return how many of them are new."""
        before = self.count
        for number in numbers:
            page, bit = number >> _PAGE_BITS, 1 << (number & (1 << _PAGE_BITS) - 1)
            held = self._pages.get(page, 0)
            self._pages[page] = held | bit
            self._pages.move_to_end(page)
            self.count += not held & bit
        return self.count - before

    def discard(self, number: int) -> None:
        if number in self:
            self._pages[number >> _PAGE_BITS] ^= 1 << (number & (1 << _PAGE_BITS) - 1)
            self.count -= 1

    def __contains__(self, number: int) -> bool:
        """Whether it has been, as far as is remembered."""
        return bool(self._pages.get(number >> _PAGE_BITS, 0) >> (number & (1 << _PAGE_BITS) - 1) & 1)


class StillSequenceWindow:
    """The received stills: each is shown once, and counted as often as it crossed. Safe for threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._seen = SequenceWindow()
        self._sent_ns: Newest[int, int] = Newest(_MOST_SENT)
        """Sequence → when a still was sent of which no second copy has come."""

    def is_new(self, sequence: int, *, send_ns: int = _NEVER_NS) -> bool:
        """Whether a still on ``roi``, or without a time one of the backlog, has not come before."""
        with self._lock:
            if not self._seen.add([sequence]):
                return False
            self._sent_ns[sequence] = send_ns
            return True

    def is_copy(self, sequence: int, *, send_ns: int) -> bool:
        """Whether one that is not new is the copy that the edge sent for want of an acknowledgement; once.

        A second message with the send time of the first is a replay. For a still that came with the backlog, the
        first message on ``roi`` is such a copy.
        """
        with self._lock:
            if send_ns <= self._sent_ns.get(sequence, send_ns):
                return False
            del self._sent_ns[sequence]
            return True

    def forget(self, sequence: int) -> None:
        """One was lost on its way into a file: it is new when it comes again."""
        with self._lock:
            self._seen.discard(sequence)
            self._sent_ns.pop(sequence, None)


def _bin(latency_ms: float) -> int:
    # Bin 0 holds 0…0.01 ms; bin i holds 0.01 · 1.01^(i-1) … 0.01 · 1.01^i; the last one all that is above.
    if latency_ms <= _LOWEST_MS:
        return 0
    return min(1 + int(math.log(latency_ms / _LOWEST_MS) / _LOG_RATIO), _BINS - 1)
