"""``--preset auto``: the slowest preset of x265 for which the machine has time, measured and not guessed.

Encoding is to take at most `share_of` the processors at the full rate of coded frames, by the processor time that it
takes and not by the clock: what waits behind others takes none. What another preset would take follows from the one
that runs by `_COST`. In flight it may step again, at a keyframe that comes anyway and seldom: only where half a
minute in the mean says so plainly.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from hvt_common.units import SECOND_NS
from hvt_edge.operating import Operating

_log = logging.getLogger(__name__)

SLOWEST: Final = "veryfast"
"""The preset of studies, the demo and all of lockstep: there time does not matter."""
_COST: Final = {"ultrafast": 0.63, "superfast": 0.77, SLOWEST: 1.0}
"""Processor time against that of the slowest: .58 to .69 and .74 to .79 on two clips at 300 and 800 kbps."""
_LEAST_CORES: Final = 0.4
_SHARE: Final = 0.2
_PLAINLY: Final = 1.15
_WINDOW_NS: Final = 30 * SECOND_NS

Spent = Callable[[], tuple[int, int]]
"""(processor time in nanoseconds, frames) of the encoder that runs, since it was opened."""


@dataclass(frozen=True, slots=True)
class PresetChoice:
    """A preset, and why it is not the slowest."""

    preset: str = SLOWEST
    says: str = ""
    """One line for people; empty for the slowest, and for one that the user has chosen."""


def share_of(cores: int) -> float:
    """Processors, of so many, that encoding may take."""
    return max(_LEAST_CORES, _SHARE * cores)


def choose_preset(slowest_cores: float, *, most_cores: float) -> PresetChoice:
    """The slowest preset within ``most_cores``, where `SLOWEST` would take so much; else the fastest."""
    within = [one for one, cost in _COST.items() if slowest_cores * cost <= most_cores]
    preset = within[-1] if within else next(iter(_COST))
    if preset == SLOWEST:
        return PresetChoice()
    took = f"{slowest_cores:.2g} of a core" if slowest_cores < 1 else f"{slowest_cores:.1f} cores"
    return PresetChoice(preset, f"preset {preset}: {SLOWEST} would take {took}")


class PresetControl:
    """Decides at keyframes whether x265 is to be opened with another preset; sets ``operating.now.preset``.

    Whoever opens an encoder says how to ask it what it takes (`watch`). Time is an argument.
    """

    def __init__(self, operating: Operating, *, nominal_fps: float, most_cores: float) -> None:
        self._operating = operating
        self._nominal_fps, self._most_cores = nominal_fps, most_cores
        self._spent: Spent = lambda: (0, 0)
        self._before = (0, 0)
        self._total = (0, 0)
        """Of this window, in encoders that are closed."""
        self._since_ns: int | None = None

    def watch(self, spent: Spent) -> None:
        """Another encoder codes from now on, with the preset that is in force."""
        self._total = self._in_window()
        self._spent, self._before = spent, spent()

    def wants_another(self, now_ns: int) -> bool:
        """Whether the encoder is to be opened anew with the preset that this sets; call it at each keyframe."""
        if self._since_ns is None:
            self._begin(now_ns)
        assert self._since_ns is not None, "set above"
        spent_ns, frames = self._in_window()
        if now_ns - self._since_ns < _WINDOW_NS or not frames:
            return False
        self._begin(now_ns)
        now = self._operating.now
        fps = self._nominal_fps / now.decimation
        slowest_cores = spent_ns / frames / SECOND_NS * fps / _COST[now.preset]
        faster, choice, slower = (
            choose_preset(slowest_cores * by, most_cores=self._most_cores)
            for by in (_PLAINLY, 1, 1 / _PLAINLY)
        )
        if now.preset in (faster.preset, choice.preset, slower.preset):
            return False
        self._operating.encode_with(choice.preset, choice.says)
        _log.info("%s", choice.says or f"preset {choice.preset}: there is time for it again")
        return True

    def _in_window(self) -> tuple[int, int]:
        spent_ns, frames = self._spent()
        return self._total[0] + spent_ns - self._before[0], self._total[1] + frames - self._before[1]

    def _begin(self, now_ns: int) -> None:
        self._since_ns, self._total, self._before = now_ns, (0, 0), self._spent()
