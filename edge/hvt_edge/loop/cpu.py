"""Processor time: how much of it every frame would take, and how much of it there is."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

_STAT = Path("/proc/stat")
_MOST_SHORT = 600
_IDLE = (3, 4)
"""Columns of idle and iowait in /proc/stat (proc(5)), counted without the name."""
_LEAST_S = 0.1


@dataclass(frozen=True, slots=True)
class Cores:
    """In processor cores; 0 where it is not measured."""

    needed: float = 0.0
    """By this process, had it left out nothing."""
    free: float = 0.0
    """Left by others."""
    taken: float = 0.0
    """By this process."""


@dataclass(frozen=True, slots=True)
class _Sample:
    wall_s: float
    own_s: float
    busy_s: float
    """Of all processes on the cores that this one may use."""


class CpuMeter:
    """Measures from one call of `measure` to the next."""

    def __init__(self) -> None:
        self._last = _sample()
        self.now = Cores()
        self._short: list[Cores] = []

    def measure(self, *, scale: float, short: bool) -> None:
        """The time since the last call; ``scale``: by how much it would have been more without what was left out.

        ``short``: something was left out for want of time.
        """
        last, here = self._last, _sample()
        if last is None or here is None or here.wall_s - last.wall_s < _LEAST_S:
            return
        self._last = here
        wall_s, own_s = here.wall_s - last.wall_s, here.own_s - last.own_s
        others = max(0.0, here.busy_s - last.busy_s - own_s) / wall_s
        taken = own_s / wall_s
        self.now = Cores(needed=taken * scale, free=max(0.0, processors() - others), taken=taken)
        if short:
            self._short = [*self._short[-_MOST_SHORT:], self.now]

    @property
    def short(self) -> Cores:
        """The mean of the times in which something was left out."""
        rows = [(one.needed, one.free, one.taken) for one in self._short] or [(0.0, 0.0, 0.0)]
        return Cores(*(sum(column) / len(rows) for column in zip(*rows, strict=True)))


def processors() -> int:
    """Number of processors that this process may use."""
    return len(_cores())


def _cores() -> set[int]:
    return os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(os.cpu_count() or 1))


def _sample() -> _Sample | None:
    names = {f"cpu{core}" for core in _cores()}
    try:
        rows = [line.split() for line in _STAT.read_text(encoding="ascii").splitlines()]
        busy = sum(
            sum(int(value) for place, value in enumerate(row[1:9]) if place not in _IDLE)
            for row in rows
            if row[0] in names
        )
    except (OSError, ValueError, IndexError):
        return None
    return _Sample(time.monotonic(), time.process_time(), busy / os.sysconf("SC_CLK_TCK"))
