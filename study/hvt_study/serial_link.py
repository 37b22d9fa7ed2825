"""A serial link of a given rate, in media time: when each message has wholly arrived.

One server, first come first served, the base stream before everything else, nothing interrupted: a message that has
begun to go goes to its end. That is a radio modem behind a queue which knows two priorities. The sizes are line
bytes, as the ledger counts them. Pure: time is an argument.
"""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from hvt_common.units import SECOND_NS

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True, order=True)
class _Queued(Generic[_T]):
    enter_ns: int
    number: int
    size_bytes: int = field(compare=False)
    message: _T = field(compare=False)


@dataclass(frozen=True, slots=True)
class Arrival(Generic[_T]):
    """One message at the far end."""

    message: _T
    size_bytes: int
    urgent: bool
    enter_ns: int
    """When it was handed to the link."""
    arrival_ns: int
    """When its last bit was there."""


@dataclass(frozen=True, slots=True)
class LinkReport:
    """How long messages took."""

    delay_p50_ms: float
    """From the reference time that was given for each to its arrival."""
    delay_p95_ms: float
    worst_queue_bytes: int
    """The most that was handed over and had not arrived, of all channels."""

    @classmethod
    def of(cls, delays_ns: Iterable[int], arrivals: Iterable[Arrival[_T]]) -> LinkReport:
        """``delays_ns`` of the messages that matter; the queue is that of all ``arrivals``."""
        delays_ms = np.fromiter(delays_ns, np.float64) / 1e6
        p50, p95 = np.percentile(delays_ms, (50, 95)).tolist() if len(delays_ms) else (0.0, 0.0)
        return cls(delay_p50_ms=p50, delay_p95_ms=p95, worst_queue_bytes=_worst_queue(arrivals))


class SerialLink(Generic[_T]):
    """Takes messages of type ``_T`` with the time at which they are handed over; gives them back as they arrive."""

    def __init__(self, *, rate_bps: float) -> None:
        """``rate_bps``: line bits a second, above 0."""
        if not rate_bps > 0:
            raise ValueError(f"rate_bps is {rate_bps}, must be above 0")
        self._byte_ns = 8 * SECOND_NS / rate_bps
        self._queued: dict[bool, list[_Queued[_T]]] = {True: [], False: []}
        self._under_way: deque[Arrival[_T]] = deque()
        self._free_ns = 0.0
        self._count = 0

    def put(self, message: _T, *, size_bytes: int, enter_ns: int, urgent: bool) -> None:
        """Hand over one message; ``urgent`` ones go before all others that wait.

        Messages may be put in another order than they enter, as long as none enters before a time that `arrived` was
        asked for already.
        """
        insort(self._queued[urgent], _Queued(enter_ns, self._count, size_bytes, message))
        self._count += 1

    def arrived(self, now_ns: int | None) -> list[Arrival[_T]]:
        """What has arrived by ``now_ns`` and was not returned before, in order; None: all that is left.

        Everything that enters before ``now_ns`` has to be put before.
        """
        while (start_ns := self._next_start_ns()) is not None and (now_ns is None or start_ns < now_ns):
            self._serve(start_ns)
        there: list[Arrival[_T]] = []
        while self._under_way and (now_ns is None or self._under_way[0].arrival_ns <= now_ns):
            there.append(self._under_way.popleft())
        return there

    def _next_start_ns(self) -> float | None:
        first_ns = min((queue[0].enter_ns for queue in self._queued.values() if queue), default=None)
        return None if first_ns is None else max(self._free_ns, first_ns)

    def _serve(self, start_ns: float) -> None:
        urgent = bool(self._queued[True]) and self._queued[True][0].enter_ns <= start_ns
        one = self._queued[urgent].pop(0)
        self._free_ns = start_ns + one.size_bytes * self._byte_ns
        self._under_way.append(
            Arrival(one.message, one.size_bytes, urgent, one.enter_ns, round(self._free_ns))
        )


def _worst_queue(arrivals: Iterable[Arrival[_T]]) -> int:
    """The highest sum of what has entered and not arrived; what arrives at an instant makes room at that instant."""
    steps: list[tuple[int, int]] = []
    for one in arrivals:
        steps += [(one.enter_ns, one.size_bytes), (one.arrival_ns, -one.size_bytes)]
    held = worst = 0
    for _, size_bytes in sorted(steps):
        held += size_bytes
        worst = max(worst, held)
    return worst
