"""The messages under way: `Flight` has their bytes, for the pace, `BaseInFlight` the units, for an outage.

Time is an argument; both are bounded.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

from hvt_common.units import SECOND_NS
from hvt_common.values import AccessUnit

_MOST_RECORDS = 1024


@dataclass(frozen=True, slots=True)
class Sent:
    """One base message on its way."""

    sequence: int
    sent_ns: int
    serialization_ns: int
    """From sending until it has left, on a link of the present rate."""
    line_bytes: int
    up_to_bytes: int
    """Line bytes of everything sent so far, this message included."""
    messages: int
    """Messages of base and stills sent so far: reports count the lost of both."""


class Flight:
    """The account of messages in flight. Pure: time is an argument; bounded in memory."""

    def __init__(self) -> None:
        self._base: deque[Sent] = deque(maxlen=_MOST_RECORDS)
        self._given_up: deque[Sent] = deque(maxlen=_MOST_RECORDS)
        self._stills: deque[tuple[int, int, int]] = deque(maxlen=_MOST_RECORDS)
        """(sequence, time of sending, line bytes)."""
        self._backlog_bytes = 0.0
        self._drained_ns = 0
        self._total_bytes = 0
        self._messages = 0
        self._last = (-1, -1)

    @property
    def last_base(self) -> int:
        """The sequence of the base message that went out last; -1 before the first."""
        return self._last[0]

    @property
    def oldest(self) -> Sent | None:
        return self._base[0] if self._base else None

    @property
    def size_bytes(self) -> int:
        """Line bytes of base and stills that no report has named yet."""
        return sum(one.line_bytes for one in self._base) + sum(size for _, _, size in self._stills)

    def sent_base(self, sequence: int, line_bytes: int, *, now_ns: int, rate_bps: int) -> None:
        self._add(line_bytes, now_ns=now_ns, rate_bps=rate_bps)
        self._messages += 1
        self._last = (sequence, self._last[1])
        serialization_ns = self.backlog_ns(now_ns=now_ns, rate_bps=rate_bps)
        self._base.append(
            Sent(sequence, now_ns, serialization_ns, line_bytes, self._total_bytes, self._messages)
        )

    def sent_still(self, sequence: int, line_bytes: int, *, now_ns: int, rate_bps: int) -> None:
        self._add(line_bytes, now_ns=now_ns, rate_bps=rate_bps)
        self._messages += 1
        self._last = (self._last[0], sequence)
        self._stills.append((sequence, now_ns, line_bytes))

    def sent_other(self, line_bytes: int, *, now_ns: int, rate_bps: int) -> None:
        """A message goes out that no report names."""
        self._add(line_bytes, now_ns=now_ns, rate_bps=rate_bps)

    def backlog_ns(self, *, now_ns: int, rate_bps: int) -> int:
        """The time that a link of this rate still needs for the bytes in flight."""
        self._drain(now_ns, rate_bps)
        return round(8 * SECOND_NS * self._backlog_bytes / rate_bps)

    def acknowledge(self, base_sequence: int, still_sequence: int) -> Sent | None:
        """Take off what has arrived; return the newest base message of it, None where there is none.

        Messages before it have arrived too or are lost. Numbers that were never sent mean nothing.
        """
        if base_sequence > self._last[0] or still_sequence > self._last[1]:
            return None
        newest: Sent | None = None
        for sent in (self._given_up, self._base):
            while sent and sent[0].sequence <= base_sequence:
                newest = sent.popleft()
        latest_ns = -(2**63) if newest is None else newest.sent_ns - 2 * SECOND_NS
        while self._stills and (self._stills[0][0] <= still_sequence or self._stills[0][1] < latest_ns):
            self._stills.popleft()
        self._backlog_bytes = min(self._backlog_bytes, self.size_bytes)
        return newest

    def refill(self) -> None:
        """The link is slower than was thought: all that is not reported still waits."""
        self._backlog_bytes = max(self._backlog_bytes, self.size_bytes)

    def give_up(self) -> None:
        """Take messages in flight for lost; a late report may still name them."""
        given_up = (*self._given_up, *self._base)
        self.clear()
        self._given_up.extend(given_up)

    def clear(self) -> None:
        """Forget messages in flight: they are lost."""
        self._given_up.clear()
        self._base.clear()
        self._stills.clear()
        self._backlog_bytes = 0.0

    def _add(self, line_bytes: int, *, now_ns: int, rate_bps: int) -> None:
        self._drain(now_ns, rate_bps)
        self._backlog_bytes += line_bytes
        self._total_bytes += line_bytes

    def _drain(self, now_ns: int, rate_bps: int) -> None:
        # Two threads send, with times that may differ a little: never back.
        elapsed_ns = max(0, now_ns - self._drained_ns)
        self._drained_ns = max(self._drained_ns, now_ns)
        self._backlog_bytes = max(0.0, self._backlog_bytes - rate_bps * elapsed_ns / 8 / SECOND_NS)


class BaseInFlight:
    """Access units that were sent and that no report has named; the oldest leaves first. Thread-safe."""

    def __init__(self, *, max_age_ns: int = 4 * SECOND_NS, max_bytes: int = 2 * 2**20) -> None:
        self._max_age_ns = max_age_ns
        self._max_bytes = max_bytes
        self._lock = threading.Lock()
        self._units: deque[tuple[int, int, AccessUnit]] = deque()
        """(sequence, time of sending, unit)."""
        self._size_bytes = 0

    def __len__(self) -> int:
        return len(self._units)

    @property
    def size_bytes(self) -> int:
        return self._size_bytes

    def sent(self, sequence: int, unit: AccessUnit, *, now_ns: int) -> None:
        with self._lock:
            self._units.append((sequence, now_ns, unit))
            self._size_bytes += len(unit.data)
            while self._units and (
                self._size_bytes > self._max_bytes or now_ns - self._units[0][1] > self._max_age_ns
            ):
                self._forget()

    def on_report(self, base_sequence: int) -> bool:
        """The primary receiver has come as far as this; return whether that is news."""
        with self._lock:
            before = len(self._units)
            while self._units and self._units[0][0] <= base_sequence:
                self._forget()
            return len(self._units) < before

    def take(self) -> list[AccessUnit]:
        """Return and forget all that may be lost, in order."""
        with self._lock:
            units = [unit for _, _, unit in self._units]
            self._units.clear()
            self._size_bytes = 0
        return units

    def _forget(self) -> None:
        self._size_bytes -= len(self._units.popleft()[2].data)
