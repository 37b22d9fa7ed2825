"""Access units under way: what an outage loses of them is stored, and what a ground misses is sent again."""

from __future__ import annotations

import threading
from collections.abc import Collection

from hvt_common.units import SECOND_NS
from hvt_common.values import AccessUnit

_MS = 1_000_000
_RESEND_NS = SECOND_NS
"""An access unit that is older is not sent again: a keyframe has been requested by then."""
_AGAIN_NS = 30 * _MS
"""Beyond one and a half round trips, until what was sent again counts as lost again."""


class BaseInFlight:
    """Access units that were sent and that no report has named, or that one misses; the oldest leaves first.

    Thread-safe.
    """

    def __init__(self, *, max_age_ns: int = 4 * SECOND_NS, max_bytes: int = 2 * 2**20) -> None:
        self._max_age_ns = max_age_ns
        self._max_bytes = max_bytes
        self._lock = threading.Lock()
        self._units: dict[int, tuple[int, AccessUnit]] = {}
        """Sequence → time of sending and unit, in order."""
        self._resent: dict[int, int] = {}
        """Sequence → when it went out again last."""
        self.size_bytes = 0

    def __len__(self) -> int:
        return len(self._units)

    def sent(self, sequence: int, unit: AccessUnit, *, now_ns: int) -> None:
        with self._lock:
            self._units[sequence] = now_ns, unit
            self.size_bytes += len(unit.data)
            while self._units:
                oldest = next(iter(self._units))
                if self.size_bytes <= self._max_bytes and now_ns - self._units[oldest][0] <= self._max_age_ns:
                    break
                self._forget(oldest)

    def on_report(self, base_sequence: int, missing: Collection[int] = ()) -> bool:
        """The primary receiver has come as far as this, without what is ``missing``; whether that is news."""
        with self._lock:
            come = [one for one in self._units if one <= base_sequence and one not in missing]
            for one in come:
                self._forget(one)
            return bool(come)

    def missing(self, sequence: int, *, now_ns: int, round_trip_ns: int) -> AccessUnit | None:
        """A unit that is worth sending again; None where it is too old, or a keyframe was sent since.

        Nor is one that went again less than about one and a half ``round_trip_ns`` ago: it may be there by now.
        """
        with self._lock:
            sent_ns, unit = self._units.get(sequence, (0, None))
            resent_ns = self._resent.get(sequence)
            on_its_way = resent_ns is not None and now_ns - resent_ns <= _AGAIN_NS + 3 * round_trip_ns // 2
            newer = (one for at, (_, one) in self._units.items() if at > sequence)
            useful = now_ns - sent_ns <= _RESEND_NS and not any(one.keyframe for one in newer)
            return unit if useful and not on_its_way else None

    def resent(self, sequence: int, *, now_ns: int) -> None:
        """It goes out again."""
        with self._lock:
            if sequence in self._units:
                self._resent[sequence] = now_ns

    def take(self) -> list[AccessUnit]:
        """Return and forget all that may be lost, in order."""
        with self._lock:
            units = [unit for _, unit in self._units.values()]
            self._units.clear()
            self._resent.clear()
            self.size_bytes = 0
        return units

    def _forget(self, sequence: int) -> None:
        self.size_bytes -= len(self._units.pop(sequence)[1].data)
        self._resent.pop(sequence, None)
