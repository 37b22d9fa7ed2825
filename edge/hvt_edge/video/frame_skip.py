"""Which ticks of the source are coded: each n-th, and with ``--fps auto`` an n that follows from what was measured.

Fewer frames get more bits each. How many are best depends on how hard the scene is to code, which shows in the
quantiser that x265 needs at the given rate: `MeasuredFrameSkip` keeps it in a band (see base_model). The rate changes
at keyframes only, because the encoder is opened anew for it, and not more often than once in ``rest_ticks``.
"""

from __future__ import annotations

import math

from hvt_edge.video.rate_model import better_decimation

__all__ = ["FrameSkip", "MeasuredFrameSkip"]


class FrameSkip:
    """Each ``decimation``-th tick. Where one was missed, the next tick is coded in its place."""

    def __init__(self, decimation: int = 1) -> None:
        assert decimation >= 1
        self.decimation = decimation
        """Changed by `at_keyframe` only."""
        self._next: int | None = None

    def codes(self, tick: int) -> bool:
        """Tell whether this tick is to be coded; ticks rise."""
        return self._next is None or tick >= self._next

    def coded(self, tick: int, *, keyframe: bool, mean_qp: float) -> None:
        """This tick was coded. After a keyframe, which may come at any tick, the count starts anew."""
        del mean_qp
        if self._next is None or keyframe:
            self._next = tick + self.decimation
        else:
            self._next += self.decimation * max(1, math.ceil((tick + 1 - self._next) / self.decimation))

    def at_keyframe(self, tick: int) -> int:
        """Decide on ``decimation`` from this tick on, which will be a keyframe."""
        del tick
        return self.decimation


class MeasuredFrameSkip(FrameSkip):
    """``--fps auto``: decided anew at keyframes, from the mean quantiser of the frames since the last decision.

    Depends on the coded frames alone, so that in lockstep the same input gives the same bytes.
    """

    def __init__(self, decimation: int = 1, *, most_decimation: int, rest_ticks: int) -> None:
        super().__init__(decimation)
        self._most_decimation = most_decimation
        self._rest_ticks = rest_ticks
        self._decided_tick: int | None = None
        self._qp_sum = 0.0
        self._frames = 0

    def coded(self, tick: int, *, keyframe: bool, mean_qp: float) -> None:
        """See `FrameSkip`. Keyframes are coarser by nature and tell nothing."""
        super().coded(tick, keyframe=keyframe, mean_qp=mean_qp)
        if self._decided_tick is None:
            self._decided_tick = tick
        if not keyframe and math.isfinite(mean_qp):
            self._qp_sum += mean_qp
            self._frames += 1

    def at_keyframe(self, tick: int) -> int:
        """See `FrameSkip`."""
        if self._decided_tick is None or tick - self._decided_tick < self._rest_ticks or not self._frames:
            return self.decimation
        self.decimation = better_decimation(
            self.decimation, mean_qp=self._qp_sum / self._frames, most_decimation=self._most_decimation
        )
        self._decided_tick, self._qp_sum, self._frames = tick, 0.0, 0
        return self.decimation
