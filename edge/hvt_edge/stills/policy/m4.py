"""M4: stills of what is small."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from hvt_edge.perception.candidates import Candidate
from hvt_edge.stills.policy.base import Request, Step, ranked

__all__ = ["Small"]


@dataclass(frozen=True, slots=True)
class Small:
    """Area below a threshold, smallest first."""

    area_share: float = 0.015
    """Of the base frame (the pilot's "small"): 118x118 pixels of 1280x720."""
    name: str = field(default="M4", init=False)
    video_only: bool = field(default=False, init=False)

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:  # noqa: ARG002
        """Tracks whose box takes less of the frame than ``area_share``."""
        return ranked(candidates, score=self._smallness, reason="small")

    def _smallness(self, candidate: Candidate) -> float | None:
        small = candidate.area_share < self.area_share
        return 1 - candidate.area_share / self.area_share if small else None
