"""The clock that each process goes by."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

__all__ = ["SteadyClock"]

_log = logging.getLogger(__name__)

_CHECK_INTERVAL_NS = 1_000_000_000
_FAR_NS = 10_000_000_000


class SteadyClock:
    """Unix time that never jumps: read once from the wall, then carried on by the monotonic clock.

    A machine without a battery for its clock starts in the past, and NTP sets it in mid-flight. Every time that HVT
    notes, sends or compares is of such a clock, so that a step of the wall's is no gap in the picture and no delay.
    The drawback is that a time that was wrong at the start stays wrong: where the wall has gone ten seconds away from
    it, one warning says so. Nothing is decided by it.
    """

    def __init__(
        self,
        *,
        wall_ns: Callable[[], int] = time.time_ns,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._wall_ns = wall_ns
        self._monotonic_ns = monotonic_ns
        self._ahead_ns = wall_ns() - monotonic_ns()
        self._next_check_ns: int | None = monotonic_ns() + _CHECK_INTERVAL_NS
        """When to compare next; None once it was said."""

    def __call__(self) -> int:
        """Unix nanoseconds, as the wall would show them had nobody set it."""
        monotonic_ns = self._monotonic_ns()
        if self._next_check_ns is not None and monotonic_ns >= self._next_check_ns:
            self._compare(monotonic_ns)
        return self._ahead_ns + monotonic_ns

    def _compare(self, monotonic_ns: int) -> None:
        self._next_check_ns = monotonic_ns + _CHECK_INTERVAL_NS
        off_ns = self._wall_ns() - self._ahead_ns - monotonic_ns
        if abs(off_ns) > _FAR_NS:
            self._next_check_ns = None
            _log.warning(
                "the clock of this machine was set by %+.0f s (or it slept): all times go on as if it had not been, "
                "until the next start",
                off_ns / 1e9,
            )
