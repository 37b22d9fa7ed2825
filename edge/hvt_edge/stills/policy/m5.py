"""M5: the paper's utility per cost, ``S = (0.5 U + 0.3 S_small + 0.2 N) / C``, with every term in 0…1.

The paper gives weights and terms; how each is normalised is ours, and docs/methods.md says why.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from hvt_edge.perception.candidates import Candidate
from hvt_edge.stills.policy.base import Request, Step, ranked

__all__ = ["Utility"]


@dataclass(frozen=True, slots=True)
class Utility:
    """Highest score first, above a threshold that follows from the room in the budget."""

    uncertainty_weight: float = 0.5
    small_weight: float = 0.3
    novelty_weight: float = 0.2
    area_share: float = 0.015
    """Where ``S_small`` reaches 0."""
    novelty_s: float = 5.0
    """Time constant with which a track becomes new again after a still."""
    min_cost: float = 0.25
    """Least ``C``: keeps a wrong cost estimate from ruling the order."""
    min_score: float = 0.1
    """Nothing below it is sent, however much room there is."""
    name: str = field(default="M5", init=False)
    video_only: bool = field(default=False, init=False)

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:
        """As many of the best as the room holds, and always the best one, so that it waits for room, not its luck.

        The threshold is thereby the score of the last that fits: the distribution it is taken from is this step's.
        """
        wanted = [one for one in self._scored(candidates, step) if one.score >= self.min_score]
        spent = 0.0
        for count, request in enumerate(wanted):
            spent += step.cost.of(request.candidate)
            if spent > step.allowance_bytes:
                return wanted[: max(count, 1)]
        return wanted

    def score(self, candidate: Candidate, step: Step) -> float:
        """``S`` of one candidate."""
        gain = (
            self.uncertainty_weight * uncertainty(candidate)
            + self.small_weight * smallness(candidate, area_share=self.area_share)
            + self.novelty_weight * novelty(candidate, now_ns=step.now_ns, time_constant_s=self.novelty_s)
        )
        return gain / max(self.min_cost, step.cost.of(candidate) / step.cost.mean_bytes)

    def _scored(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:
        return ranked(candidates, score=lambda one: self.score(one, step), reason="utility")


def uncertainty(candidate: Candidate) -> float:
    """``U``: one minus the detector's confidence; once the ground has answered, ``1 - exp(-H)`` of its entropy.

    ``exp(H)`` is the perplexity, the number of classes still in play, so both are 0 for certainty and need no
    knowledge of how many classes there are.
    """
    if candidate.posterior is not None:
        return 1 - math.exp(-max(0.0, candidate.posterior.entropy_nats))
    return min(1.0, max(0.0, 1 - candidate.confidence))


def smallness(candidate: Candidate, *, area_share: float) -> float:
    """``S_small``: 1 for a point, falling in a straight line to 0 at ``area_share`` of the frame."""
    return max(0.0, 1 - candidate.area_share / area_share) if area_share > 0 else 0.0


def novelty(candidate: Candidate, *, now_ns: int, time_constant_s: float) -> float:
    """``N``: 1 while nothing was sent; after a still 0, and back towards 1 as ``1 - exp(-t / time_constant_s)``."""
    if candidate.last_sent_ns is None or time_constant_s <= 0:
        return 1.0
    return 1 - math.exp(-max(0, now_ns - candidate.last_sent_ns) / 1e9 / time_constant_s)
