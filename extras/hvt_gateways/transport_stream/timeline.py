"""Capture times as times of a transport stream: they grow, whatever the edge's clock does."""

from __future__ import annotations

from fractions import Fraction
from typing import Final

from hvt_common.units import SECOND_NS

TIME_BASE: Final = Fraction(1, 90_000)
"""ISO/IEC 13818-1, 2.4.3.7."""
_LONGEST_S: Final = 3600
"""A longer pause is a clock that was set. The 33 bits of a time hold a day."""
_AHEAD_S: Final = 10
"""Lead at which the facts of a moment may be known before its picture comes."""
_PER_SECOND: Final = TIME_BASE.denominator


class Timeline:
    """The times of one stream, which begins with its first picture; ``fps`` is its rate if times do not say."""

    def __init__(self, *, fps: float) -> None:
        self._frame = max(1, round(_PER_SECOND / fps))
        self._zero_ns: int | None = None
        self._picture = -1
        self._metadata = -1

    @property
    def begun(self) -> bool:
        """Whether there was a picture."""
        return self._zero_ns is not None

    def picture(self, capture_ns: int) -> int:
        """The time of the next picture in `TIME_BASE`; after one that is later, or an hour earlier, a frame on."""
        if self._zero_ns is None:
            self._zero_ns = capture_ns
        at = self.of(capture_ns)
        if not self._picture < at <= self._picture + _LONGEST_S * _PER_SECOND:
            at = self._picture + self._frame
            self._zero_ns = capture_ns - at * SECOND_NS // _PER_SECOND
        self._picture = at
        return at

    def of(self, capture_ns: int) -> int:
        """The time of a moment; there was a picture."""
        assert self._zero_ns is not None
        return ((capture_ns - self._zero_ns) * _PER_SECOND + SECOND_NS // 2) // SECOND_NS

    def metadata(self, at: int) -> bool:
        """Whether metadata of this time may come next: newer than the last, and not far ahead of the pictures."""
        fits = self._metadata < at <= self._picture + _AHEAD_S * _PER_SECOND
        if fits:
            self._metadata = at
        return fits
