"""M2: a still when a track begins, and when it is found again after being lost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from hvt_edge.perception.candidates import Candidate
from hvt_edge.stills.policy.base import Request, Step, ranked

__all__ = ["OnStart"]


@dataclass(frozen=True, slots=True)
class OnStart:
    """One still a start. Those that wait longest come first."""

    patience_s: float = 1.0
    """How long a start may wait for its still, be it for room in the budget or to come away from the border."""
    name: str = field(default="M2", init=False)
    video_only: bool = field(default=False, init=False)

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:
        """Tracks whose last start has not been answered yet."""
        return ranked(candidates, score=lambda one: self._frames_unanswered(one, step), reason="new")

    def _frames_unanswered(self, candidate: Candidate, step: Step) -> float | None:
        start_frame = step.frame_index - candidate.frames_since_start
        if candidate.last_sent_frame is not None and candidate.last_sent_frame >= start_frame:
            return None
        elapsed = candidate.frames_since_start
        fresh = candidate.started or elapsed <= self.patience_s * step.fps
        return float(elapsed) if fresh else None
