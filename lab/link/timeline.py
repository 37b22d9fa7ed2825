"""A link over time: phases of constant rate, delay and loss, and darkness. Pure."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace


@dataclass(frozen=True, slots=True)
class LinkState:
    """The link for as long as nothing changes, the same in both directions."""

    rate_bps: int
    """Bits a second, headers of IP and TCP or UDP included."""
    delay_s: float = 0.0
    """One way, beside serialisation and queue."""
    jitter_s: float = 0.0
    """At most so much is added to the delay, evenly spread."""
    loss: float = 0.0
    """Share of the packets."""
    reorder: float = 0.0
    """Share of the datagrams that others overtake (UDP only)."""
    dark: bool = False
    """Nothing passes."""


@dataclass(frozen=True, slots=True)
class Phase:
    """A state and when it begins, in seconds of the script."""

    start_s: float
    state: LinkState


@dataclass(frozen=True, slots=True)
class Script:
    """Pieces in order of time. The first holds before its start too, the last for ever."""

    phases: tuple[Phase, ...]
    lasts_s: float
    queue_bytes: int
    """Bytes that the sender's end of the link holds before it drops (UDP) or pushes back (TCP)."""
    falls_s: tuple[float, ...] = ()
    """When the rate is stepped down."""
    rises_s: tuple[float, ...] = ()
    """When the rate is stepped up again."""
    dark: tuple[tuple[float, float], ...] = field(init=False, repr=False, compare=False)
    """Begin and end of each darkness."""
    _starts: tuple[float, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_starts", tuple(phase.start_s for phase in self.phases))
        object.__setattr__(self, "dark", tuple(_dark_spans(self.phases)))

    def at(self, t_s: float) -> LinkState:
        return self.phases[self._index(t_s)].state

    def until(self, t_s: float) -> float:
        """When the state of this moment ends; infinite for the last."""
        index = self._index(t_s)
        return self._starts[index + 1] if index + 1 < len(self.phases) else math.inf

    def light_s(self, t_s: float) -> float:
        """The first moment from ``t_s`` on at which the link is not dark."""
        while self.at(t_s).dark:
            t_s = self.until(t_s)
        return t_s

    def finish_s(self, start_s: float, bits: float) -> float:
        """When so many bits have left that begin to leave at ``start_s``; darkness carries none."""
        t_s = start_s
        while True:
            state, end_s = self.at(t_s), self.until(t_s)
            rate_bps = 0 if state.dark else state.rate_bps
            if rate_bps and t_s + bits / rate_bps <= end_s:
                return t_s + bits / rate_bps
            bits -= rate_bps * (end_s - t_s)
            t_s = end_s

    def carries_bits(self, start_s: float, end_s: float) -> float:
        total, t_s = 0.0, start_s
        while t_s < end_s:
            state, step_s = self.at(t_s), min(end_s, self.until(t_s))
            total += 0.0 if state.dark else state.rate_bps * (step_s - t_s)
            t_s = step_s
        return total

    def shifted(self, begin_s: float) -> Script:
        """The same, begun at this moment of another clock."""
        return replace(
            self, phases=tuple(replace(phase, start_s=phase.start_s + begin_s) for phase in self.phases)
        )

    def still(self) -> Script:
        """Before the beginning: the first state, for ever, without loss."""
        first = replace(self.phases[0].state, dark=False, loss=0.0)
        return replace(self, phases=(Phase(0.0, first),))

    def without_delay(self) -> Script:
        """The script that namespaces can play: a floor with a delay that they do not have would flatter."""
        return replace(
            self,
            phases=tuple(
                replace(phase, state=replace(phase.state, delay_s=0.0, jitter_s=0.0, reorder=0.0))
                for phase in self.phases
            ),
        )

    def _index(self, t_s: float) -> int:
        return max(0, bisect_right(self._starts, t_s) - 1)


def _dark_spans(phases: Sequence[Phase]) -> Iterator[tuple[float, float]]:
    began_s: float | None = None
    for phase in phases:
        if phase.state.dark and began_s is None:
            began_s = phase.start_s
        elif not phase.state.dark and began_s is not None:
            yield began_s, phase.start_s
            began_s = None
