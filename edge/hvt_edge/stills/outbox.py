"""Stills that wait for room: a small queue, most useful first, bounded in number and age."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from hvt_edge.stills.crop_job import CropJob
from hvt_edge.stills.policy.base import Request

__all__ = ["PendingStill", "QueueSettings", "StillQueue"]


@dataclass(frozen=True, slots=True)
class QueueSettings:
    """A crop that waited longer than ``max_age_ns`` shows a past the operator no longer looks at."""

    max_length: int = 8
    max_age_ns: int = 1_000_000_000


@dataclass(frozen=True, slots=True)
class PendingStill:
    """A wish for a still, with the crop that it is to show."""

    request: Request
    cut: CropJob
    since_ns: int
    again: bool = False
    """It was sent before, and the ground could make nothing of it."""

    @property
    def track_id(self) -> int:
        """Of the candidate that leads the wish."""
        return self.request.candidate.track_id

    @property
    def track_ids(self) -> set[int]:
        """Of all that the still will show."""
        return {self.track_id, *(one.track_id for one in self.request.also)}


class StillQueue:
    """Holds at most one wish a track; a newer one takes the place of the older."""

    def __init__(self, settings: QueueSettings = QueueSettings()) -> None:
        self._settings = settings
        self._waiting: dict[int, PendingStill] = {}
        """By the track that leads."""

    def __len__(self) -> int:
        return len(self._waiting)

    def __iter__(self) -> Iterator[PendingStill]:
        return iter(tuple(self._waiting.values()))

    def __contains__(self, track_id: int) -> bool:
        return any(track_id in waiting.track_ids for waiting in self._waiting.values())

    def admits(self, request: Request, *, now_ns: int) -> bool:
        """Whether this wish would stay if it were offered now."""
        full = len(self._waiting) >= self._settings.max_length
        if not full or request.candidate.track_id in self._waiting:
            return True
        least = min(_usefulness(waiting.request, waiting.since_ns) for waiting in self._waiting.values())
        return _usefulness(request, now_ns) > least

    def offer(self, waiting: PendingStill) -> list[tuple[PendingStill, str]]:
        """Take in one wish; return those that had to leave for it, with the reason.

        An older wish leaves where the new one shows the track that leads it; a track that rides with another's wish
        only gets off that one.
        """
        left: list[tuple[PendingStill, str]] = []
        for older in self:
            if older.track_id in waiting.track_ids:
                left.append((self._waiting.pop(older.track_id), "replaced"))
            elif older.track_ids & waiting.track_ids:
                self._waiting[older.track_id] = _without(older, waiting.track_ids)
        self._waiting[waiting.track_id] = waiting
        if len(self._waiting) > self._settings.max_length:
            least = min(self._waiting.values(), key=_order)
            left.append((self._waiting.pop(least.track_id), "queue_full"))
        return left

    def expire(self, now_ns: int) -> list[tuple[PendingStill, str]]:
        """Remove and return what has waited too long."""
        limit_ns = now_ns - self._settings.max_age_ns
        old = [waiting for waiting in self._waiting.values() if waiting.since_ns < limit_ns]
        return [(self._waiting.pop(waiting.track_id), "stale") for waiting in old]

    def best(self) -> PendingStill | None:
        """Return the most useful wish, without removing it."""
        return max(self._waiting.values(), key=_order, default=None)

    def remove(self, waiting: PendingStill) -> None:
        """Take a wish out: it was sent or given up."""
        self._waiting.pop(waiting.track_id, None)

    def clear(self) -> list[PendingStill]:
        """Empty the queue and return what was in it."""
        left = list(self._waiting.values())
        self._waiting.clear()
        return left


def _without(waiting: PendingStill, track_ids: set[int]) -> PendingStill:
    """The same wish, in which these tracks are named no more; its crop stays as it was cut."""
    also = tuple(one for one in waiting.request.also if one.track_id not in track_ids)
    named = tuple(shown for shown in waiting.cut.header.also if shown[0] not in track_ids)
    cut = replace(waiting.cut, header=replace(waiting.cut.header, also=named))
    return replace(waiting, request=replace(waiting.request, also=also), cut=cut)


def _order(waiting: PendingStill) -> tuple[float, int, int]:
    return _usefulness(waiting.request, waiting.since_ns)


def _usefulness(request: Request, since_ns: int) -> tuple[float, int, int]:
    # Ties go to the older wish, then to the older track: the order is the same in every run.
    return (request.score, -since_ns, -request.candidate.track_id)
