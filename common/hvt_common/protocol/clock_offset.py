"""The offset of a remote clock, from the four times of a request and its answer; times of a camera by ours. Pure."""

import threading
from collections import deque
from dataclasses import dataclass

from hvt_common.units import SECOND_NS

_DRIFT_PPM = 500
"""The most that two clocks drift apart (RFC 5905: NTP corrects 500 ppm)."""
_ROUNDING_NS = 1_000_000
_MOST_SAMPLES = 64
_LONGEST_TRIP_NS = 60 * SECOND_NS
_EARLY_NS = 5 * SECOND_NS
"""More than half the round trip of any link that carries video."""


@dataclass(frozen=True, slots=True)
class _Sample:
    at_ns: int
    offset_ns: int
    round_trip_ns: int


class ClockOffset:
    """The offset of a remote clock, from the recent exchange with the shortest round trip.

    ``t0``: request sent (local), ``t1``: received and ``t2``: answered (remote), ``t3``: answer received (local).
    The offset is ``((t1 - t0) + (t2 - t3)) / 2``, the round trip ``(t3 - t0) - (t2 - t1)`` (RFC 5905, section 8).
    The true offset lies within half a round trip of it. Two exchanges that exclude each other mean that a clock was
    set: those before the step are dropped. Safe for threads.
    """

    def __init__(self, *, window_ns: int = 60_000_000_000) -> None:
        """Samples older than ``window_ns`` before the newest are dropped, and the oldest beyond `_MOST_SAMPLES`."""
        self._window_ns = window_ns
        self._samples: deque[_Sample] = deque(maxlen=_MOST_SAMPLES)
        self._adding = threading.Lock()
        self._best: _Sample | None = None

    def add(self, *, t0_ns: int, t1_ns: int, t2_ns: int, t3_ns: int) -> bool:
        """Take one exchange; False if its times contradict each other (a stepped or hostile clock)."""
        held_ns = t2_ns - t1_ns
        round_trip_ns = (t3_ns - t0_ns) - held_ns
        if held_ns < 0 or round_trip_ns < 0:
            return False
        offset_ns = ((t1_ns - t0_ns) + (t2_ns - t3_ns)) // 2
        sample = _Sample(t3_ns, offset_ns, round_trip_ns)
        with self._adding:
            while self._samples and not _agree(self._samples[-1], sample):
                self._samples.pop()
            self._samples.append(sample)
            while self._samples[0].at_ns <= t3_ns - self._window_ns:
                self._samples.popleft()
            self._best = min(self._samples, key=lambda one: one.round_trip_ns)
        return True

    @property
    def estimate(self) -> tuple[int, int] | None:
        """Remote clock minus ours and the largest error of it, both of one exchange; None before the first.

        The error is half the round trip.
        """
        best = self._best
        return None if best is None else (best.offset_ns, (best.round_trip_ns + 1) // 2)

    @property
    def offset_ns(self) -> int:
        """Remote clock minus ours; 0 before the first exchange."""
        best = self._best
        return 0 if best is None else best.offset_ns

    def to_local_ns(self, remote_ns: int) -> int:
        """A time of the remote clock as ours would have shown it; unchanged before the first exchange."""
        return remote_ns - self.offset_ns


class CaptureClock:
    """The times of one camera by this ground's clock.

    A camera's clock may be years off, and an edge may report any time. A picture that arrived long before its capture
    time, or a minute after it, is timed by its arrival; so are the next ones while that stays possible. A picture
    that arrived a little before its capture time shows the least error of a clock exchange that waited in a queue.
    """

    def __init__(self, edge_clock: ClockOffset) -> None:
        self._edge_clock = edge_clock
        self._own_offset_ns: int | None = None
        self._least_offset_ns, self._noted_ns = -(2**63), 0
        """The camera's clock minus ours, if the quickest of the last pictures came at once; when one came last."""

    def note(self, capture_ns: int, *, received_ns: int) -> None:
        """Take the time of something that has just come."""
        if -_EARLY_NS <= received_ns - self._edge_clock.to_local_ns(capture_ns) <= _LONGEST_TRIP_NS:
            self._own_offset_ns = None
            offset_ns, error_ns = self._edge_clock.estimate or (0, 0)
            most_ns = offset_ns + error_ns
            before_ns = self._least_offset_ns - _drift_ns(received_ns - self._noted_ns)
            least_ns = min(capture_ns - received_ns, most_ns)
            # An exchange has shown this bound to be impossible: the clock was set since.
            self._least_offset_ns = max(least_ns, before_ns) if before_ns <= most_ns else least_ns
            self._noted_ns = received_ns
        elif self.is_sound or not 0 <= received_ns - self.to_local_ns(capture_ns) <= _LONGEST_TRIP_NS:
            self._own_offset_ns = capture_ns - received_ns

    @property
    def is_sound(self) -> bool:
        """Whether the offset is that of the edge's clock, and not one from the arrival."""
        return self._own_offset_ns is None

    @property
    def offset_ns(self) -> int:
        """The camera's clock minus ours."""
        if self._own_offset_ns is not None:
            return self._own_offset_ns
        offset_ns, error_ns = self._edge_clock.estimate or (0, 0)
        return min(max(offset_ns, self._least_offset_ns), offset_ns + error_ns)

    def to_local_ns(self, capture_ns: int) -> int:
        """A time of the camera as our clock would have shown it."""
        return capture_ns - self.offset_ns


def _agree(one: _Sample, other: _Sample) -> bool:
    # Whether some offset lies within the error of both, drift between them allowed for.
    drift_ns = _drift_ns(other.at_ns - one.at_ns) + _ROUNDING_NS
    return 2 * abs(one.offset_ns - other.offset_ns) <= one.round_trip_ns + other.round_trip_ns + 2 * drift_ns


def _drift_ns(passed_ns: int) -> int:
    return _DRIFT_PPM * abs(passed_ns) // 1_000_000
