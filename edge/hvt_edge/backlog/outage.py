"""Whether the link is down, and which frames were lost with it. Time is an argument.

It is down if nobody subscribes any more (Zenoh notices that some seconds after the link broke), or if a ground that
used to report is silent (it reports twice a second whatever it receives, so this is noticed much sooner).
"""

from __future__ import annotations

import threading
from collections import deque

from hvt_common.units import SECOND_NS
from hvt_common.values import AccessUnit

_MS = 1_000_000
SILENCE_NS = 1_500 * _MS
"""Three reports in a row that did not come."""
_LEFT_NS = 15 * SECOND_NS
"""Who is silent for so long on a link that Zenoh still has, has left; others may subscribe
that never report. The same as in `hvt_edge.link.pacer`."""


class Outage:
    """For one run of an edge. ``live``: the source is a camera, which waits for nobody."""

    def __init__(self, *, live: bool) -> None:
        self._live = live
        self._subscribed = False
        self._linked = False
        self._reported_ns: int | None = None
        self.reports = False
        """Whether a ground ever reported on this session: without reports nobody knows what has arrived."""

    def reported(self, now_ns: int) -> None:
        """A ground has reported on this session (any thread)."""
        self._reported_ns = now_ns
        self.reports = True

    def reports_now(self, now_ns: int) -> bool:
        """Whether a ground reports now."""
        reported_ns = self._reported_ns
        return reported_ns is not None and now_ns - reported_ns <= SILENCE_NS

    def offline(self, now_ns: int, *, linked: bool) -> bool:
        """Whether the link is away; called before each frame. ``linked``: Zenoh reports a subscriber.

        Before anybody ever subscribed, only a live source is stored: a clip plays again.
        """
        if not linked:
            self._linked = False
            return self._subscribed or self._live
        if not self._linked:  # a new path: the silence of before says nothing about it
            self._linked = self._subscribed = True
            self._reported_ns = None
        reported_ns = self._reported_ns
        if reported_ns is not None and now_ns - reported_ns > _LEFT_NS:
            self._reported_ns = reported_ns = None
        return reported_ns is not None and now_ns - reported_ns > SILENCE_NS


class BaseInFlight:
    """Access units that were sent and that no report has named; the oldest leaves first. Thread-safe."""

    def __init__(self, *, max_age_ns: int = 4 * SECOND_NS, max_bytes: int = 2 * 2**20) -> None:
        self._max_age_ns = max_age_ns
        self._max_bytes = max_bytes
        self._lock = threading.Lock()
        self._units: deque[tuple[int, int, AccessUnit]] = deque()
        """(sequence, time of sending, unit)."""
        self._size_bytes = 0

    def __len__(self) -> int:
        return len(self._units)

    @property
    def size_bytes(self) -> int:
        """The bytes of the access units."""
        return self._size_bytes

    def sent(self, sequence: int, unit: AccessUnit, *, now_ns: int) -> None:
        """An access unit goes out."""
        with self._lock:
            self._units.append((sequence, now_ns, unit))
            self._size_bytes += len(unit.data)
            while self._units and (
                self._size_bytes > self._max_bytes or now_ns - self._units[0][1] > self._max_age_ns
            ):
                self._forget()

    def on_report(self, base_sequence: int) -> bool:
        """The primary receiver has come as far as this; return whether that is news."""
        with self._lock:
            before = len(self._units)
            while self._units and self._units[0][0] <= base_sequence:
                self._forget()
            return len(self._units) < before

    def take(self) -> list[AccessUnit]:
        """Return and forget all that may be lost, in order."""
        with self._lock:
            units = [unit for _, _, unit in self._units]
            self._units.clear()
            self._size_bytes = 0
        return units

    def _forget(self) -> None:
        self._size_bytes -= len(self._units.popleft()[2].data)
