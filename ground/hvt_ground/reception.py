"""What the receiver measures for the edge's rate: the newest message of each stream, when it came, and how old. Pure.

Reports cost the way back: they come so often that together they take `_SHARE` of what arrives, within bounds, and
only when something new has arrived; in a pause the usual ones, twice a second, go on.
"""

from __future__ import annotations

import statistics
from collections import deque
from dataclasses import dataclass

from hvt_common.link.wire import BaseHeader

__all__ = ["REPORT_LINE_BYTES", "Measured", "Reception", "StepFree"]

_MS = 1_000_000
_SECOND_NS = 1_000_000_000
REPORT_LINE_BYTES = 180
"""What a report without results takes on the line."""
_SHARE = 0.03
_LEAST_NS, _MOST_NS = 100 * _MS, 500 * _MS
_RATE_OVER_NS = 2 * _SECOND_NS
_MOST_DELAYS = 256
_HELD_US = 2**32 - 1


class StepFree:
    """Takes the steps out of a wall clock: its times as it would show them, had nobody set it since the start."""

    def __init__(self, *, wall_ns: int, monotonic_ns: int) -> None:
        self._ahead_ns = wall_ns - monotonic_ns

    def time_ns(self, noted_ns: int, *, wall_ns: int, monotonic_ns: int) -> int:
        """``noted_ns`` was read off the wall clock a short while ago; the others are read now."""
        return noted_ns - (wall_ns - monotonic_ns - self._ahead_ns)


@dataclass(frozen=True, slots=True)
class Measured:
    """What a report says of the link."""

    base_sequence: int
    base_held_us: int
    still_sequence: int
    delay_p50_ms: float | None
    """Of the base messages since the last report."""


class Reception:
    """Of one session. ``now_ns`` is one clock without steps in all calls."""

    def __init__(self, *, lockstep: bool = False) -> None:
        self._lockstep = lockstep
        self._base_sequence = self._still_sequence = -1
        self._arrived_ns = 0
        self._sizes: deque[tuple[int, int]] = deque()
        self._size_bytes = 0
        self._delays_ms: deque[float] = deque(maxlen=_MOST_DELAYS)
        self._news = False
        self._reported_ns: int | None = None

    def base(
        self, header: BaseHeader, *, size_bytes: int, arrived_ns: int, delay_ms: float | None = None
    ) -> None:
        """An access unit of this session has arrived; ``delay_ms`` from capture, where clocks allow to say."""
        if header.sequence > self._base_sequence:
            self._base_sequence, self._arrived_ns = header.sequence, arrived_ns
        if delay_ms is not None:
            self._delays_ms.append(delay_ms)
        self._note(size_bytes, arrived_ns)

    def still(self, sequence: int, *, size_bytes: int, arrived_ns: int) -> None:
        """A still of this session has arrived."""
        self._still_sequence = max(self._still_sequence, sequence)
        self._note(size_bytes, arrived_ns)

    def due(self, now_ns: int) -> bool:
        """Whether a report should go out."""
        if self._reported_ns is None:
            return True
        since_ns = now_ns - self._reported_ns
        return since_ns >= _MOST_NS or (self._news and since_ns >= self.interval_ns(now_ns))

    def interval_ns(self, now_ns: int) -> int:
        """Between two reports while messages arrive."""
        if self._lockstep:
            return _MOST_NS
        self._forget(now_ns)
        arriving = self._size_bytes / _RATE_OVER_NS
        if arriving <= 0:
            return _MOST_NS
        return min(_MOST_NS, max(_LEAST_NS, round(REPORT_LINE_BYTES / (_SHARE * arriving))))

    def take(self, now_ns: int) -> Measured:
        """What to report now; delays begin anew."""
        delays = list(self._delays_ms)
        self._delays_ms.clear()
        self._news = False
        self._reported_ns = now_ns
        held_us = max(0, now_ns - self._arrived_ns) // 1000 if self._base_sequence >= 0 else 0
        return Measured(
            base_sequence=self._base_sequence,
            base_held_us=min(held_us, _HELD_US),
            still_sequence=self._still_sequence,
            delay_p50_ms=statistics.median(delays) if delays else None,
        )

    def _note(self, size_bytes: int, arrived_ns: int) -> None:
        self._sizes.append((arrived_ns, size_bytes))
        self._size_bytes += size_bytes
        self._news = True
        self._forget(arrived_ns)

    def _forget(self, now_ns: int) -> None:
        while self._sizes and (self._sizes[0][0] <= now_ns - _RATE_OVER_NS or len(self._sizes) > 4096):
            self._size_bytes -= self._sizes.popleft()[1]
