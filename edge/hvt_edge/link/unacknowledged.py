"""What was sent and is not yet acknowledged: stills to be sent again, and all that an outage has swallowed.

A report of the ground names the highest sequence of each stream that has come, and the stills missing below it. What
it names leaves here. A still that it ought to have named by now, and did not, is sent again once, while it is worth
seeing; the base stream never is, because a keyframe shows more. When the link is found to be away, what is left here
was on its way: `Unacknowledged.drain` hands it to whoever keeps it until the link is back.

Several grounds may report. One of them counts, as for the pacer (see `receivers`). What that one has counts as
received, whatever the others miss.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

from hvt_common.protocol.messages import Feedback
from hvt_common.values import AccessUnit, Still
from hvt_edge.link.receivers import PrimaryReceiver

__all__ = ["UnackedSettings", "Unacknowledged"]

_SECOND_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class UnackedSettings:
    """Bounds of what is kept, and when a still is overdue."""

    max_base_ns: int = 4 * _SECOND_NS
    max_base_bytes: int = 2 * 2**20
    max_stills: int = 64
    max_still_bytes: int = 2 * 2**20
    least_wait_ns: int = _SECOND_NS
    wait_round_trips: int = 3
    """A still is overdue after so many round trips, and after ``least_wait_ns`` at the earliest."""
    max_age_ns: int = 4 * _SECOND_NS
    """Sent longer ago, it shows a past the operator no longer looks at."""


@dataclass(slots=True)
class _SentStill:
    still: Still
    utility: float
    sent_ns: int
    again: bool = False


class Unacknowledged:
    """Bounded, the oldest leaves first. Thread-safe; time is an argument, the edge's clock in all calls."""

    def __init__(self, settings: UnackedSettings = UnackedSettings()) -> None:
        self._settings = settings
        self._lock = threading.Lock()
        self._base: deque[tuple[int, int, AccessUnit]] = deque()
        """(sequence, time of sending, unit)."""
        self._base_bytes = 0
        self._stills: dict[int, _SentStill] = {}
        """By sequence, in the order of first sending."""
        self._still_bytes = 0
        self._last_base = self._last_still = -1
        self._primary = PrimaryReceiver()

    def __len__(self) -> int:
        """Access units and stills together."""
        return len(self._base) + len(self._stills)

    @property
    def size_bytes(self) -> int:
        """Of what is kept."""
        return self._base_bytes + self._still_bytes

    # What goes out

    def sent_base(self, sequence: int, unit: AccessUnit, *, now_ns: int) -> None:
        """An access unit goes out."""
        settings = self._settings
        with self._lock:
            self._last_base = max(self._last_base, sequence)
            self._base.append((sequence, now_ns, unit))
            self._base_bytes += len(unit.data)
            while self._base and (
                self._base_bytes > settings.max_base_bytes or now_ns - self._base[0][1] > settings.max_base_ns
            ):
                self._forget_base()

    def sent_still(self, still: Still, *, utility: float, now_ns: int) -> None:
        """A still goes out, or goes out again; ``utility`` is what the method gave it."""
        settings = self._settings
        with self._lock:
            if still.sequence <= self._last_still:
                if still.sequence in self._stills:
                    self._stills[still.sequence].again = True
                return
            self._last_still = still.sequence
            self._stills[still.sequence] = _SentStill(still, utility, now_ns)
            self._still_bytes += len(still.data)
            while len(self._stills) > settings.max_stills or self._still_bytes > settings.max_still_bytes:
                self._forget_still(next(iter(self._stills)))

    # What comes back

    def hear(self, feedback: Feedback, *, now_ns: int) -> None:
        """Take in one report of this session."""
        with self._lock:
            # Numbers that were never sent mean nothing, and who names them is not followed.
            if feedback.base_sequence > self._last_base or feedback.still_sequence > self._last_still:
                return
            if self._primary.take(feedback.receiver_id, feedback.sequence, now_ns=now_ns) is None:
                return
            before = len(self)
            while self._base and self._base[0][0] <= feedback.base_sequence:
                self._forget_base()
            missing = set(feedback.missing_stills)
            for sequence in [one for one in self._stills if one <= feedback.still_sequence]:
                if sequence not in missing:
                    self._forget_still(sequence)
            if len(self) < before:
                self._primary.note_progress(now_ns)

    def overdue_stills(self, now_ns: int, *, round_trip_ns: int) -> list[tuple[Still, float]]:
        """Return those to be sent again, with their utility, most useful first.

        Each stays in the list until it has been sent again, is acknowledged or too old. Only what a report could
        have named counts: where none comes, nothing is known of what has arrived.
        """
        settings = self._settings
        wait_ns = max(settings.least_wait_ns, settings.wait_round_trips * round_trip_ns)
        with self._lock:
            overdue = [
                one
                for one in self._stills.values()
                if not one.again
                and self._primary.heard_ns - one.sent_ns >= wait_ns
                and now_ns - one.sent_ns <= settings.max_age_ns
            ]
        return [(one.still, one.utility) for one in sorted(overdue, key=lambda one: -one.utility)]

    def drain(self) -> tuple[list[AccessUnit], list[Still]]:
        """Return and forget all that may have been lost: access units in their order, stills most useful first."""
        with self._lock:
            units = [unit for _, _, unit in self._base]
            stills = [one.still for one in sorted(self._stills.values(), key=lambda one: -one.utility)]
            self._base.clear()
            self._stills.clear()
            self._base_bytes = self._still_bytes = 0
        return units, stills

    def _forget_base(self) -> None:
        self._base_bytes -= len(self._base.popleft()[2].data)

    def _forget_still(self, sequence: int) -> None:
        self._still_bytes -= len(self._stills.pop(sequence).still.data)
