"""Chooses the source frames to code: each n-th, with ``--fps auto`` by an n from measurements.

Fewer frames get more bits each. How many are best depends on how hard the scene is to code, which shows in the
quantiser that x265 needs at the given rate: `MeasuredFrameSkip` holds it in a band (see rate_model). The rate changes
at keyframes only, because the encoder is opened anew for it, and seldom.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from hvt_edge.video.rate_model import SPARING, QuantiserBand, better_decimation


class FrameSkip:
    """Each ``decimation``-th source frame. Where one was missed, the next is coded in its place."""

    def __init__(self, decimation: int = 1) -> None:
        assert decimation >= 1
        self.decimation = decimation
        """Changed by `at_keyframe` only."""
        self._next: int | None = None

    def codes(self, index: int) -> bool:
        """Tell whether this source frame is to be coded; indices rise."""
        return self._next is None or index >= self._next

    def coded(self, index: int, *, keyframe: bool, mean_qp: float) -> None:
        """This frame was coded. After a keyframe, which may come at any index, the count starts anew."""
        del mean_qp
        if self._next is None or keyframe:
            self._next = index + self.decimation
        else:
            self._next += self.decimation * max(1, math.ceil((index + 1 - self._next) / self.decimation))

    def at_keyframe(self, index: int) -> int:
        """Decide on ``decimation`` from this frame on, which will be a keyframe."""
        del index
        return self.decimation

    def wants_keyframe(self, index: int) -> bool:
        """Whether more frames are worth a keyframe of their own after this one."""
        del index
        return False


class MeasuredFrameSkip(FrameSkip):
    """``--fps auto``: decided anew at keyframes, from the mean quantiser of the newest ``window_frames``.

    With ``own_keyframes`` more frames are worth one; fewer wait for a keyframe that comes anyway. All of it depends
    on the coded frames alone, so that in lockstep the same input gives the same bytes.
    """

    def __init__(
        self,
        decimation: int = 1,
        *,
        most_decimation: int,
        rest_frames: int,
        window_frames: int,
        band: QuantiserBand = SPARING,
        own_keyframes: bool = False,
    ) -> None:
        super().__init__(decimation)
        self._most_decimation = most_decimation
        self._rest_frames = rest_frames
        self._window_frames = window_frames
        self._band = band
        self._own_keyframes = own_keyframes
        self._decided_index: int | None = None
        self._quantisers: deque[tuple[int, float]] = deque()
        """(index, mean quantiser) of the newest frames."""

    def coded(self, index: int, *, keyframe: bool, mean_qp: float) -> None:
        """See `FrameSkip`. Keyframes are coarser by nature and tell nothing."""
        super().coded(index, keyframe=keyframe, mean_qp=mean_qp)
        if self._decided_index is None:
            self._decided_index = index
        if not keyframe and math.isfinite(mean_qp):
            self._quantisers.append((index, mean_qp))
        while self._quantisers and self._quantisers[0][0] <= index - self._window_frames:
            self._quantisers.popleft()

    def at_keyframe(self, index: int) -> int:
        """See `FrameSkip`."""
        if not self._may_decide(index):
            return self.decimation
        self.decimation = self._better()
        self._decided_index = index
        self._quantisers.clear()
        return self.decimation

    def wants_keyframe(self, index: int) -> bool:
        """See `FrameSkip`."""
        return self._own_keyframes and self._may_decide(index) and self._better() < self.decimation

    def _may_decide(self, index: int) -> bool:
        decided = self._decided_index
        return decided is not None and index - decided >= self._rest_frames and bool(self._quantisers)

    def _better(self) -> int:
        return better_decimation(
            self.decimation,
            mean_qp=sum(qp for _, qp in self._quantisers) / len(self._quantisers),
            most_decimation=self._most_decimation,
            band=self._band,
        )


class LimitedFrameSkip(FrameSkip):
    """Another choice, with no more frames than ``least_decimation()`` allows at the time of a keyframe."""

    def __init__(self, preferred: FrameSkip, least_decimation: Callable[[], int]) -> None:
        super().__init__(preferred.decimation)
        self._preferred = preferred
        self._least_decimation = least_decimation

    def coded(self, index: int, *, keyframe: bool, mean_qp: float) -> None:
        """See `FrameSkip`."""
        super().coded(index, keyframe=keyframe, mean_qp=mean_qp)
        self._preferred.coded(index, keyframe=keyframe, mean_qp=mean_qp)

    def at_keyframe(self, index: int) -> int:
        """See `FrameSkip`."""
        self.decimation = max(self._preferred.at_keyframe(index), self._least_decimation())
        return self.decimation

    def wants_keyframe(self, index: int) -> bool:
        """See `FrameSkip`."""
        return self._preferred.wants_keyframe(index)
