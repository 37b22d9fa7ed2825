"""The clock of a process, Unix time that never steps; how much time has passed, whatever the wall clock says."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from uuid import uuid4

_log = logging.getLogger(__name__)

_CHECK_INTERVAL_NS = 1_000_000_000
_FAR_NS = 10_000_000_000


def since_boot_ns() -> int:
    """Nanoseconds since this boot, those included in which the machine slept."""
    return time.clock_gettime_ns(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


class SteadyClock:
    """Unix time that never steps: the wall clock at the start, advanced by the time that has passed, sleep included.

    A machine without a battery for its clock starts with an old date, and NTP sets it in flight. All times that HVT
    records, sends or compares are of such a clock, so that a step of the wall clock is neither a gap nor a delay. A
    time that is wrong at the start stays wrong; one warning says so where it is ten seconds off.
    """

    def __init__(
        self, *, wall_ns: Callable[[], int] = time.time_ns, monotonic_ns: Callable[[], int] = since_boot_ns
    ) -> None:
        self._wall_ns = wall_ns
        self._monotonic_ns = monotonic_ns
        self._ahead_ns = wall_ns() - monotonic_ns()
        self._next_check_ns: int | None = monotonic_ns() + _CHECK_INTERVAL_NS
        """When to compare with the wall clock next; None after the warning."""

    def __call__(self) -> int:
        """Unix nanoseconds without the steps of the wall clock."""
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
                "the clock of this machine was set by %+.0f s: all times go on as if it had not been, until the next "
                "start",
                off_ns / 1e9,
            )


@dataclass(frozen=True, slots=True)
class Moment:
    """One moment by two clocks: by the one that may be set, and by the one of this boot, which nobody sets."""

    unix_ns: int
    boot: str
    """The boot that ``steady_ns`` counts from."""
    steady_ns: int


@cache
def boot_id() -> str:
    """The id of this boot of the machine; if the system has none, of this process."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return uuid4().hex


def unwitnessed_ns(before: Moment, now: Moment, *, most_ns: int) -> int:
    """By how much Unix time has moved from ``before`` to ``now`` beyond the time that is known to have passed.

    Within a boot that time is known. Over a boot nobody knows it: the clock of a machine without a battery stood
    still, and a clock that was set tells nothing of its former error. Then the difference counts up to ``most_ns``.
    """
    moved_ns = now.unix_ns - before.unix_ns
    if now.boot == before.boot:
        return moved_ns - (now.steady_ns - before.steady_ns)
    return moved_ns - min(max(moved_ns, 0), most_ns)
