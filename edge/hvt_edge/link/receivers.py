"""Which ground steers: whose reports count where several may report, decided once for each report.

Several grounds see the same thin link, and what one of them has says nothing of the others. So one is the primary
receiver: the first that reports, until it is silent for a second, or names nothing new for as long although another
has had several messages since. At one frame a second there is nothing new for a second, and whichever of two healthy
grounds reports first would be the only one that has the newest. Numbers of reports cost a forger nothing, so one that
is too high silences a receiver for that second and no longer.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

from hvt_common.protocol.messages import Feedback

_OTHER_RECEIVER_NS = 1_000_000_000
_MISSED = 3
"""Base messages: one or two may be lost, or reported a moment later than by another."""


@dataclass(frozen=True, slots=True)
class Report:
    """A ground's report with the decisions on it. Pacer, outbox, store and inbox all get the same."""

    feedback: Feedback
    now_ns: int
    """When it came, this side's clock."""
    primary: bool
    """It is new and of the ground that steers."""
    first: bool = False
    """Another ground steers from now on, or this one began anew: measurements of its path no longer hold."""


class PrimaryReceiver:
    """Thread-safe; time is an argument."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._receiver_id: int | None = None
        self._sequence = -1
        self._named = (-1, -1)
        """The highest base and still sequences that it has named."""
        self._reported_ns = 0
        self._progress_ns = 0
        """When it last named something new."""

    def judge(self, feedback: Feedback, *, sent: tuple[int, int], now_ns: int) -> Report:
        """Decide on a report; ``sent`` are the last sequences of base and stills that went out.

        One that names what was never sent does not count.
        """
        with self._lock:
            if feedback.base_sequence > sent[0] or feedback.still_sequence > sent[1]:
                return Report(feedback, now_ns, primary=False)
            first = self._begins(feedback, sent, now_ns)
            if first is None:
                return Report(feedback, now_ns, primary=False)
            if first:
                self._named, self._progress_ns = (-1, -1), now_ns
            named = (
                max(self._named[0], feedback.base_sequence),
                max(self._named[1], feedback.still_sequence),
            )
            if named != self._named:
                self._named, self._progress_ns = named, now_ns
            self._receiver_id, self._sequence, self._reported_ns = (
                feedback.receiver_id,
                feedback.sequence,
                now_ns,
            )
            return Report(feedback, now_ns, primary=True, first=first)

    def forget(self) -> None:
        """Nobody can be reached: the next report counts, whose ever it is."""
        with self._lock:
            self._receiver_id, self._sequence = None, -1

    def _begins(self, feedback: Feedback, sent: tuple[int, int], now_ns: int) -> bool | None:
        # Whether the receiver begins (anew) with this report; None where it does not count.
        if self._receiver_id is None:
            return True
        quiet_ns = now_ns - self._reported_ns
        if feedback.receiver_id != self._receiver_id:
            # One that reports and never names anything new must not keep the edge from all the others; as long as it
            # has named nothing at all, everything that was sent counts.
            there = sent[0] if self._named == (-1, -1) else feedback.base_sequence
            if there - self._named[0] >= _MISSED:
                quiet_ns = max(quiet_ns, now_ns - self._progress_ns)
            return True if quiet_ns >= _OTHER_RECEIVER_NS else None
        if feedback.sequence > self._sequence:
            return False
        # Old, or a number was forged that the receiver itself will not reach for years.
        return True if quiet_ns >= _OTHER_RECEIVER_NS else None
