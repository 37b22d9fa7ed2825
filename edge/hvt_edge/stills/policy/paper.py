"""The paper's methods M0 to M5, and R0, which every still has to beat. M6 is ours (`m6`).

M5 is the paper's utility per cost, ``S = (0.5 U + 0.3 S_small + 0.2 N) / C``, with every term in 0…1. The paper gives
weights and terms; the normalisation of each is ours, and docs/methods.md explains it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from hvt_edge.stills.policy.base import Method, Request, Step, ranked

if TYPE_CHECKING:
    from hvt_edge.perception.candidates import Candidate


@dataclass(frozen=True, slots=True)
class VideoOnly(Method):
    """M0, the baseline: no stills; the whole budget may go to the base stream."""

    name: ClassVar[str] = "M0"
    video_only: ClassVar[bool] = True

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:  # noqa: ARG002
        return []


@dataclass(frozen=True, slots=True)
class TracksFirst(VideoOnly):
    """R0: no stills, as M0; the encoder spends its bits on the tracks (``--roi-depth``)."""

    name: ClassVar[str] = "R0"


@dataclass(frozen=True, slots=True)
class Periodic(Method):
    """M1: each active track falls due at a fixed interval, from its first frame on; most overdue first."""

    every_frames: int = 15
    """The paper's interval: one second at 15 fps."""
    name: ClassVar[str] = "M1"

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:
        """Tracks whose last still is ``every_frames`` or more behind."""
        return ranked(candidates, score=lambda one: self._overdue_frames(one, step), reason="due")

    def _overdue_frames(self, candidate: Candidate, step: Step) -> float | None:
        if candidate.last_sent_frame is None:
            return float(step.frame_index - candidate.born_frame)
        overdue = step.frame_index - candidate.last_sent_frame - self.every_frames
        return float(overdue) if overdue >= 0 else None


@dataclass(frozen=True, slots=True)
class OnStart(Method):
    """M2: a still when a track begins, and when it is found again; the longest waiting come first."""

    patience_s: float = 1.0
    """How long a start may wait for its still, either for its allowance or to come away from the border."""
    name: ClassVar[str] = "M2"

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


@dataclass(frozen=True, slots=True)
class Uncertain(Method):
    """M3: confidence below a threshold: the classifier's once the ground has named the track, else the detector's."""

    detector_confidence: float = 0.5
    """Confidence below which the detector is unsure (0.50 is the strictest confidence in the pilot's table)."""
    classifier_confidence: float = 0.5
    """Confidence below which no class has the absolute majority."""
    name: ClassVar[str] = "M3"

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:  # noqa: ARG002
        return ranked(candidates, score=self._doubt, reason="uncertain")

    def _doubt(self, candidate: Candidate) -> float | None:
        if candidate.posterior is not None:
            confidence, limit = candidate.posterior.confidence, self.classifier_confidence
        else:
            confidence, limit = candidate.confidence, self.detector_confidence
        return 1 - confidence if confidence < limit else None


@dataclass(frozen=True, slots=True)
class Small(Method):
    """M4: area below a threshold, smallest first."""

    area_share: float = 0.015
    """Share of the base frame (the pilot's "small"): 118x118 pixels of 1280x720."""
    name: ClassVar[str] = "M4"

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:  # noqa: ARG002
        """Tracks whose box takes less of the frame than ``area_share``."""
        return ranked(candidates, score=self._smallness, reason="small")

    def _smallness(self, candidate: Candidate) -> float | None:
        small = candidate.area_share < self.area_share
        return 1 - candidate.area_share / self.area_share if small else None


@dataclass(frozen=True, slots=True)
class Utility(Method):
    """M5: highest score first, above a threshold that follows from the budget's allowance."""

    uncertainty_weight: float = 0.5
    small_weight: float = 0.3
    novelty_weight: float = 0.2
    area_share: float = 0.015
    """Share of the base frame at which ``S_small`` reaches 0."""
    novelty_s: float = 5.0
    """Time constant with which a track becomes new again after a still."""
    min_cost: float = 0.25
    """Least ``C``: keeps a wrong cost estimate from ruling the order."""
    min_score: float = 0.1
    """Least score of a still, whatever the budget allows."""
    name: ClassVar[str] = "M5"

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:
        """As many of the best as the allowance holds, and always the best one, so that it waits for its allowance.

        So the threshold is the score of the last request that fits, from the scores of this step alone.
        """
        scored = ranked(candidates, score=lambda one: self.score(one, step), reason="utility")
        wanted = [one for one in scored if one.score >= self.min_score]
        spent = 0.0
        for count, request in enumerate(wanted):
            spent += step.cost.of(request.candidate)
            if spent > step.allowance_bytes:
                return wanted[: max(count, 1)]
        return wanted

    def score(self, candidate: Candidate, step: Step) -> float:
        gain = (
            self.uncertainty_weight * uncertainty(candidate)
            + self.small_weight * smallness(candidate, area_share=self.area_share)
            + self.novelty_weight * novelty(candidate, now_ns=step.now_ns, time_constant_s=self.novelty_s)
        )
        return gain / max(self.min_cost, step.cost.of(candidate) / step.cost.mean_bytes)


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
