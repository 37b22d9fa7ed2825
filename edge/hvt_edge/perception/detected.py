"""Compares the ground's count of objects with the edge's own on the same base pictures.

The ground's detector may be another, or none, and nobody at the edge knows it. So it reports a count, and for which
frame; compared are counts of about the same frame, so that a scene which fills or empties is no difference.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from hvt_common.units import SECOND_NS

_MOST_OPEN = 32
"""Comparisons that wait for a report: half a minute of them."""
_LEAST_WORTH = 0.5
"""Least weight of comparisons: with less nothing is known; the last one counts for some twenty seconds."""


@dataclass(frozen=True, slots=True)
class Detected:
    """A ground's report of its own detector."""

    receiver_id: int
    """The ground's number."""
    frame_index: int
    """The last frame that it was done with."""
    objects: int
    """How many it showed when it last looked, by that frame."""


@dataclass(frozen=True, slots=True)
class _Comparison:
    frame_index: int
    capture_ns: int
    objects: float


class GroundDifference:
    """Objects more at the ground than here, in the mean, the newest counting most. Deterministic; not thread-safe."""

    def __init__(self, *, memory_s: float, grace_ns: int) -> None:
        self._memory_s = memory_s
        self._grace_ns = grace_ns
        """The start of a ground or a scene does not count: the first picture is coarser than others."""
        self._receiver_id: int | None = None
        self.forget()

    def forget(self) -> None:
        """Another scene: reports of the one before say nothing of it."""
        self._open: deque[_Comparison] = deque(maxlen=_MOST_OPEN)
        self._mean, self._worth = 0.0, 0.0
        self._worth_ns: int | None = None
        self._first_ns: int | None = None

    @property
    def mean(self) -> float | None:
        """Less than 0 where the ground shows fewer; None where it has not said, or not for a while."""
        return self._mean if self._worth >= _LEAST_WORTH else None

    def expect(self, frame_index: int, objects: float, *, capture_ns: int) -> None:
        """Note the number found here on the base picture of this frame."""
        self._fade(capture_ns)
        self._open.append(_Comparison(frame_index, capture_ns, objects))

    def take(self, report: Detected) -> None:
        """Compare a report with the number found here on the newest picture that it covers."""
        if report.receiver_id != self._receiver_id:  # another model, perhaps
            self._receiver_id = report.receiver_id
            self._mean, self._worth, self._first_ns = 0.0, 0.0, None
        covered = None
        while self._open and self._open[0].frame_index <= report.frame_index:
            covered = self._open.popleft()
        if covered is None:
            return
        if self._first_ns is None:
            self._first_ns = covered.capture_ns
        if covered.capture_ns - self._first_ns < self._grace_ns:
            return
        self._worth += 1
        self._mean += (report.objects - covered.objects - self._mean) / self._worth

    def _fade(self, now_ns: int) -> None:
        if self._worth_ns is not None:
            self._worth *= math.exp(-max(0, now_ns - self._worth_ns) / SECOND_NS / self._memory_s)
        self._worth_ns = now_ns
