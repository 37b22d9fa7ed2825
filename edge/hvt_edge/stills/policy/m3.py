"""M3: stills of what is uncertain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from hvt_edge.perception.candidates import Candidate
from hvt_edge.stills.policy.base import Request, Step, ranked

__all__ = ["Uncertain"]


@dataclass(frozen=True, slots=True)
class Uncertain:
    """Confidence below a threshold: the classifier's once the ground has spoken of the track, else the detector's."""

    detector_confidence: float = 0.5
    """Below it the detector is unsure (0.50 is the strictest confidence in the pilot's table)."""
    classifier_confidence: float = 0.5
    """Below it no class has the absolute majority."""
    name: str = field(default="M3", init=False)
    video_only: bool = field(default=False, init=False)

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:  # noqa: ARG002
        """Least confident first."""
        return ranked(candidates, score=self._doubt, reason="uncertain")

    def _doubt(self, candidate: Candidate) -> float | None:
        if candidate.posterior is not None:
            confidence, limit = candidate.posterior.confidence, self.classifier_confidence
        else:
            confidence, limit = candidate.confidence, self.detector_confidence
        return 1 - confidence if confidence < limit else None
