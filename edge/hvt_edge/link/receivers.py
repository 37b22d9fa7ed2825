"""Which ground's reports count where several may report, and which of them is new.

Several grounds see the same thin link, and what one of them has says nothing of the others. So one is followed: the
first that reports, until it is silent for a second or names nothing new for as long. Numbers of reports cost a forger
nothing, so one that is too high silences a receiver for that second and no longer.
"""

from __future__ import annotations

from typing import Literal

__all__ = ["PrimaryReceiver"]

_OTHER_RECEIVER_NS = 1_000_000_000


class PrimaryReceiver:
    """Not thread-safe; time is an argument."""

    def __init__(self) -> None:
        self.receiver_id: int | None = None
        """None while nobody is followed."""
        self.heard_ns = 0
        """When the last report that counted came."""
        self.progress_ns = 0
        """When one last brought news, as `note_progress` was told."""
        self._sequence = -1

    def take(self, receiver_id: int, sequence: int, *, now_ns: int) -> Literal["next", "first"] | None:
        """Whether this report counts: None where not; ``first`` where what was known of the receiver no longer holds.

        That is at another receiver, and at one whose numbers begin anew.
        """
        kind: Literal["next", "first"] = "next"
        if receiver_id != self.receiver_id:
            # One that reports and never names anything new must not keep the edge from all the others.
            quiet_ns = max(now_ns - self.heard_ns, now_ns - self.progress_ns)
            if self.receiver_id is not None and quiet_ns < _OTHER_RECEIVER_NS:
                return None
            kind, self.receiver_id, self.progress_ns = "first", receiver_id, now_ns
        elif sequence <= self._sequence:
            # Old, or a number was forged that the receiver itself will not reach for years.
            if now_ns - self.heard_ns < _OTHER_RECEIVER_NS:
                return None
            kind = "first"
        self._sequence, self.heard_ns = sequence, now_ns
        return kind

    def note_progress(self, now_ns: int) -> None:
        """The last report named something new."""
        self.progress_ns = now_ns

    def forget(self) -> None:
        """Nobody is followed: the next report counts, whose ever it is."""
        self.receiver_id, self._sequence = None, -1
