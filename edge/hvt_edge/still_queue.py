"""Stills that wait for room: a small queue, most useful first, bounded in number and age."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from hvt_common.values import Frame
from hvt_edge.methods.base import Request

__all__ = ["QueueSettings", "StillQueue", "Waiting"]


@dataclass(frozen=True, slots=True)
class QueueSettings:
    """A crop that waited longer than ``max_age_ns`` shows a past the operator no longer looks at."""

    max_length: int = 8
    max_age_ns: int = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Waiting:
    """A wish for a still, with the untouched frame that it is cut from."""

    request: Request
    frame: Frame
    since_ns: int


class StillQueue:
    """Holds at most one wish a track; a newer one takes the place of the older."""

    def __init__(self, settings: QueueSettings = QueueSettings()) -> None:
        self._settings = settings
        self._waiting: dict[int, Waiting] = {}

    def __len__(self) -> int:
        return len(self._waiting)

    def __iter__(self) -> Iterator[Waiting]:
        return iter(tuple(self._waiting.values()))

    def offer(self, waiting: Waiting) -> list[tuple[Waiting, str]]:
        """Take in one wish; return those that had to leave for it, with the reason."""
        track_id = waiting.request.candidate.track_id
        left: list[tuple[Waiting, str]] = []
        older = self._waiting.pop(track_id, None)
        if older is not None:
            left.append((older, "replaced"))
        self._waiting[track_id] = waiting
        if len(self._waiting) > self._settings.max_length:
            least = min(self._waiting.values(), key=_usefulness)
            left.append((self._waiting.pop(least.request.candidate.track_id), "queue_full"))
        return left

    def expire(self, now_ns: int) -> list[tuple[Waiting, str]]:
        """Remove and return what has waited too long."""
        limit_ns = now_ns - self._settings.max_age_ns
        old = [waiting for waiting in self._waiting.values() if waiting.since_ns < limit_ns]
        return [(self._waiting.pop(waiting.request.candidate.track_id), "stale") for waiting in old]

    def best(self) -> Waiting | None:
        """Return the most useful wish, without removing it."""
        return max(self._waiting.values(), key=_usefulness, default=None)

    def remove(self, waiting: Waiting) -> None:
        """Take a wish out: it was sent or given up."""
        self._waiting.pop(waiting.request.candidate.track_id, None)

    def clear(self) -> list[Waiting]:
        """Empty the queue and return what was in it."""
        left = list(self._waiting.values())
        self._waiting.clear()
        return left


def _usefulness(waiting: Waiting) -> tuple[float, int, int]:
    # Ties go to the older wish, then to the older track: the order is the same in every run.
    request = waiting.request
    return (request.score, -waiting.since_ns, -request.candidate.track_id)
