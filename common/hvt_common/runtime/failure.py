"""A part that fails in flight: what went wrong and when, and how long to leave it alone before it is tried again."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

from hvt_common.errors import UserError
from hvt_common.units import SECOND_NS

__all__ = ["Backoff", "Failure", "reason_of"]

_MOST_CHARACTERS = 300


def reason_of(error: BaseException) -> str:
    """What an error says, in one line: a sentence as it is, anything else after its kind."""
    text = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
    return " ".join(text.split())[:_MOST_CHARACTERS]


@dataclass(frozen=True, slots=True)
class Failure:
    """One part's failures in a row."""

    part: str
    reason: str
    at_ns: int
    """Unix nanoseconds, the last time."""
    times: int = 1

    @property
    def at(self) -> str:
        """The time of day, UTC."""
        return time.strftime("%H:%M:%S UTC", time.gmtime(self.at_ns // SECOND_NS))

    def again(self, reason: str, at_ns: int) -> Failure:
        """The same part has failed once more."""
        return replace(self, reason=reason, at_ns=at_ns, times=self.times + 1)

    def as_dict(self) -> dict[str, Any]:
        """For a summary."""
        return {"part": self.part, "reason": self.reason, "at": self.at, "times": self.times}


class Backoff:
    """After each failure in a row a pause twice as long, from ``first_s`` up to ``most_s``.

    Who goes on for as long as the longest pause after the last failure begins anew with the shortest. ``now_ns`` is
    one clock without steps in all calls.
    """

    def __init__(self, *, first_s: float = 1.0, most_s: float = 60.0) -> None:
        self._first_ns, self._most_ns = round(first_s * SECOND_NS), round(most_s * SECOND_NS)
        self._pause_ns = 0
        self._failed_ns = 0

    def failed(self, now_ns: int) -> None:
        """Note a failure."""
        if now_ns - self._failed_ns > self._pause_ns + self._most_ns:
            self._pause_ns = 0
        self._pause_ns = min(self._most_ns, max(self._first_ns, 2 * self._pause_ns))
        self._failed_ns = now_ns

    def ready(self, now_ns: int) -> bool:
        """Whether the part may be tried, or tried again."""
        return now_ns - self._failed_ns >= self._pause_ns
