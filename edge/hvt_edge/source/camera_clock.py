"""The capture time of a live frame, from the camera's own time stamps where it gives any. Pure."""

from __future__ import annotations

from collections import deque

from hvt_common.units import SECOND_NS

_MOST_DELAY_NS = 5 * SECOND_NS
"""A frame that seems older when it comes shows that the camera's clock is not set as ours is."""
_MEMORY_NS = 60 * SECOND_NS
"""The least delay of the last one to two of these counts: two clocks drift apart."""

_STEP_NS = SECOND_NS
"""From one frame to the next no delay changes by so much."""
_MOST_BEHIND_NS = 2 * SECOND_NS
"""Who is later than that, step by step, has another idea of a second: stamps of 25 a second on 24 frames."""
_RECENT = 32
"""Frames whose delays tell how unevenly they come."""
_MOST_JITTER_NS = SECOND_NS // 4


class CameraClock:
    """Turns a camera's time stamps into this process's time; one for each time that the camera was opened.

    A clock that is set as ours is (NTP) is taken at its word. Of any other only the differences count: the frame
    that came quickest is taken to have come at once. Times never go back: where they would, as when the camera first
    says what its clock reads, they go on at half the pace until they have met.
    """

    def __init__(self) -> None:
        self._least_ns: int | None = None
        self._former_ns: int | None = None
        self._delay_ns: int | None = None
        self._since_ns = 0
        self._last_ns = self._came_ns = 0
        """Capture time of the newest frame, and when it came."""
        self._recent: deque[int] = deque(maxlen=_RECENT)
        """Delays of the newest frames."""

    @property
    def jitter_ns(self) -> int:
        """By how much some frames of late came later than others: they come in bursts. At most a quarter second."""
        return min(_MOST_JITTER_NS, max(self._recent, default=0) - min(self._recent, default=0))

    def capture_ns(self, camera_ns: int | None, *, now_ns: int) -> int:
        """The capture time of the frame that has just come; ``camera_ns`` is None where the camera does not say."""
        taken_ns = now_ns if camera_ns is None else camera_ns + self._ahead_ns(now_ns - camera_ns, now_ns)
        taken_ns = min(taken_ns, now_ns)
        if taken_ns <= self._last_ns:
            taken_ns = self._last_ns + max(1, (now_ns - self._came_ns) // 2)
        self._last_ns, self._came_ns = taken_ns, now_ns
        self._recent.append(now_ns - self._last_ns)
        return self._last_ns

    def _ahead_ns(self, delay_ns: int, now_ns: int) -> int:
        if self._delay_ns is not None and abs(delay_ns - self._delay_ns) > _STEP_NS:
            self._least_ns = self._former_ns = None  # one of the two clocks was set
        elif self._least_ns is not None and delay_ns - self._least_ns > _MOST_BEHIND_NS:
            self._least_ns = self._former_ns = None
        self._delay_ns = delay_ns
        if self._least_ns is None or now_ns - self._since_ns > _MEMORY_NS:
            self._former_ns, self._least_ns, self._since_ns = self._least_ns, delay_ns, now_ns
        self._least_ns = min(self._least_ns, delay_ns)
        least_ns = self._least_ns if self._former_ns is None else min(self._least_ns, self._former_ns)
        return 0 if 0 <= least_ns <= _MOST_DELAY_NS else least_ns
