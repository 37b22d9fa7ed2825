"""When pictures were captured by the ground's clock, and never what cannot be."""

from __future__ import annotations

from hvt_common.protocol.clock_offset import ClockOffset
from hvt_common.units import SECOND_NS

_LONGEST_TRIP_NS = 60 * SECOND_NS
_EARLY_NS = 5 * SECOND_NS
"""More than half the round trip of any link that carries video."""


class CaptureClock:
    """The times of one camera by this ground's clock.

    A camera's clock may be years off, and an edge may say what it likes. A picture that came before it was captured,
    or a minute after, counts from its arrival, and so do those after it, as long as that can be.
    """

    def __init__(self, edge_clock: ClockOffset) -> None:
        self._edge_clock = edge_clock
        self._own_offset_ns: int | None = None

    def note(self, capture_ns: int, *, received_ns: int) -> None:
        """Take the time of something that has just come."""
        if -_EARLY_NS <= received_ns - self._edge_clock.to_local_ns(capture_ns) <= _LONGEST_TRIP_NS:
            self._own_offset_ns = None
        elif self.is_sound or not 0 <= received_ns - self.to_local_ns(capture_ns) <= _LONGEST_TRIP_NS:
            self._own_offset_ns = capture_ns - received_ns

    @property
    def is_sound(self) -> bool:
        """Whether the offset is that of the edge's clock, and not one from the arrival."""
        return self._own_offset_ns is None

    @property
    def offset_ns(self) -> int:
        """The camera's clock minus ours."""
        return self._edge_clock.offset_ns if self._own_offset_ns is None else self._own_offset_ns

    def to_local_ns(self, capture_ns: int) -> int:
        """A time of the camera as our clock would have shown it."""
        return capture_ns - self.offset_ns
