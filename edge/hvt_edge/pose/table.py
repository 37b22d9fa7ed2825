"""Poses by time, as a file beside a clip gives them."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace

from hvt_common.geodesy import between
from hvt_common.units import SECOND_NS
from hvt_common.values import Pose

MOST_GAP_S = 10.0
_BEYOND_NS = SECOND_NS
"""So long before the first pose and after the last one they are still taken."""


class PoseTable:
    """``poses`` in order of time, at least one; their ``capture_ns`` counts from the clip's first frame."""

    def __init__(
        self, poses: Sequence[Pose], *, most_gap_s: float = MOST_GAP_S, notes: tuple[str, ...] = ()
    ) -> None:
        self.notes = notes
        self._poses = poses
        self._times = [one.capture_ns for one in poses]
        self._most_gap_ns = round(most_gap_s * SECOND_NS)
        self.trouble = ""

    def at(self, media_ns: int, *, capture_ns: int) -> Pose | None:
        """The pose at this moment of the clip, between the two around it; None in a gap or beyond the ends."""
        pose = self._at(media_ns)
        self.trouble = "" if pose else f"the pose file has nothing at {media_ns / SECOND_NS:.0f} s"
        return None if pose is None else replace(pose, capture_ns=capture_ns)

    def _at(self, media_ns: int) -> Pose | None:
        after = bisect_right(self._times, media_ns)
        if 0 < after < len(self._poses):
            first, second = self._poses[after - 1], self._poses[after]
            if second.capture_ns - first.capture_ns <= self._most_gap_ns:
                return between(first, second, media_ns)
        nearest = self._poses[max(0, after - 1)]
        return nearest if abs(nearest.capture_ns - media_ns) <= _BEYOND_NS else None

    def close(self) -> None:
        """Nothing is open."""
