"""The frame loop reports once a second that it turns: a state for watchers, and a message for systemd's watchdog.

A long wait in the loop turns it meanwhile: a clip waits for its ground, a lost camera yields a step without a frame
each second. Only a loop that hangs reports nothing.
"""

from __future__ import annotations

from collections.abc import Callable

from hvt_common.runtime.process import notify_systemd
from hvt_common.units import SECOND_NS
from hvt_edge.health.state import EdgeState, Phase, StateMaker


class Heartbeat:
    """Beats in the frame loop; ``clock`` is wall time, in lockstep too."""

    def __init__(self, maker: StateMaker, *, clock: Callable[[], int]) -> None:
        self._maker = maker
        self._clock = clock
        self._due_ns = 0
        self.state: EdgeState | None = None
        """The newest; None before the first. Any thread may read it."""

    def beat(self, phase: Phase) -> EdgeState:
        """Make a state now."""
        self._due_ns = self._clock() + SECOND_NS
        self.state = self._maker.make(phase)
        notify_systemd("WATCHDOG=1")
        return self.state

    def turn(self, phase: Phase) -> None:
        """Make one if the last is a second old."""
        if self._clock() >= self._due_ns:
            self.beat(phase)
