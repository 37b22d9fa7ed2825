"""The segment that is being written: where it begins, how much it holds, and which unit begins the next."""

from __future__ import annotations

from pathlib import Path

from hvt_common.protocol.messages import MAX_BACKLOG_BYTES
from hvt_common.values import AccessUnit
from hvt_edge.backlog.entry import BLOCK_BYTES, blocks
from hvt_edge.backlog.segment import SegmentWriter

__all__ = ["SEGMENT_NS", "OpenSegment"]

SEGMENT_NS = 10_000_000_000
"""A keyframe is wanted when a segment is so long: eviction and sending go by segments."""
_MOST_SEGMENT_BYTES = MAX_BACKLOG_BYTES - 512 * 1024
_MOST_SEGMENT_UNITS = 2400


class OpenSegment:
    """Raises OSError or FFmpegError where the disk takes no more."""

    def __init__(self, path: Path, first: AccessUnit, parameter_sets: bytes) -> None:
        self.path = path
        self.first = first
        self._last = (first.frame_index - 1, first.capture_ns - 1)
        self._size_bytes = self._units = 0
        self._writer = SegmentWriter(path, parameter_sets=parameter_sets)

    @property
    def span_ns(self) -> int:
        """From its first frame to its last."""
        return max(0, self._last[1] - self.first.capture_ns)

    @property
    def disk_bytes(self) -> int:
        """About."""
        return 2 * BLOCK_BYTES + blocks(self._size_bytes)

    def ends_before(self, unit: AccessUnit) -> bool:
        """Whether this unit begins another segment."""
        if unit.frame_index <= self._last[0] or unit.capture_ns <= self._last[1]:
            return True
        if self._units >= _MOST_SEGMENT_UNITS or self._size_bytes + len(unit.data) > _MOST_SEGMENT_BYTES:
            return True
        long = unit.capture_ns - self.first.capture_ns >= SEGMENT_NS // 2
        return unit.keyframe and (long or not self.first.keyframe)

    def write(self, unit: AccessUnit) -> None:
        """Append."""
        self._writer.write(unit)
        self._last = (unit.frame_index, unit.capture_ns)
        self._size_bytes += len(unit.data) + 64  # with what Matroska and the index add
        self._units += 1

    def close(self) -> None:
        """End it."""
        self._writer.close()
