"""M1: periodic stills. Every active track falls due at a fixed interval."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from hvt_edge.perception.candidates import Candidate
from hvt_edge.stills.policy.base import Request, Step, ranked

__all__ = ["Periodic"]


@dataclass(frozen=True, slots=True)
class Periodic:
    """Most overdue first. A track of which nothing was sent is due from its first frame."""

    every_frames: int = 15
    """The paper's interval: one second at 15 fps."""
    name: str = field(default="M1", init=False)
    video_only: bool = field(default=False, init=False)

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:
        """Tracks whose last still is ``every_frames`` or more behind."""
        return ranked(candidates, score=lambda one: self._overdue_frames(one, step), reason="due")

    def _overdue_frames(self, candidate: Candidate, step: Step) -> float | None:
        if candidate.last_sent_frame is None:
            return float(step.frame_index - candidate.born_frame)
        overdue = step.frame_index - candidate.last_sent_frame - self.every_frames
        return float(overdue) if overdue >= 0 else None
