"""M6: stills by expected gain per byte on the line.

    gain = P(the still helps) · [ (1 - k) · P(wrong before) + k · P(wrong after the last still) · better + detail ]
    score = 1000 · gain / (expected payload + line bytes beside it)

``gain`` is the chance that a still now makes the class right that the ground shows of a track, and ``k``
fades with the time since the last still. ``detail`` is content beside the class, such as a code on a roof;
it counts only with ``detail_weight`` above 0. docs/methods.md explains the terms and the sources of their
numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from hvt_common.inference.class_names import MOVING, same_kind
from hvt_edge.stills.policy.base import Method, Request, Step, ranked
from hvt_edge.stills.policy.paper import novelty

if TYPE_CHECKING:
    from hvt_edge.perception.candidates import Candidate

_SIDE_PX = 32.0
"""The size at which ``size_weight`` adds nothing."""
_MOST_WEIGHT = 1000.0
"""Limit of ``detail_weight``: beyond it classes count for nothing."""
_MOST_LOGIT = 50.0
"""Limit of certainty; keeps the exponential finite whatever weights a user tries."""


@dataclass(frozen=True, slots=True)
class ExpectedGain(Method):
    """Highest expected gain per byte first, from ``min_gain`` on, as many as ``lookahead`` times the allowance holds.

    Requests beyond the allowance are for neighbours that may share a still, and for the queue.
    """

    bias: float = 0.5
    confidence_weight: float = 6.0
    lost_weight: float = 2.3
    """Weight of the detail that the base has lost, for candidates detected on the decoded base."""
    lost_weight_source: float = 6.5
    """The same for candidates from the source, which the base may not show at all."""
    size_weight: float = 0.65
    """Weight of each doubling of the side, from 32 base pixels on; smaller objects count less."""
    unknown_lost: float = 0.5
    """Value of the lost detail where no base picture was at hand."""
    readable_px: float = 4.0
    """Side in source pixels at which a perfect still helps every second time."""
    readable_confidence: float = 0.22
    """Scale of a source detection's confidence: a still shows the object with 1 - exp(-confidence / scale)."""
    sharp_half: float = 20.0
    """Sharpness (variance of the Laplacian) at which a still is half as useful."""
    border_share: float = 0.2
    """The part of a still's use that a cut-off object loses."""
    covered_share: float = 0.3
    """The part of it that an object wholly covered by another would lose."""
    fade_s: float = 60.0
    """Time constant with which the effect of a still wears off; 0 forgets at once."""
    unanswered: float = 0.3
    """P(wrong after the last still) while the ground has not answered."""
    disagreement: float = 0.35
    """Least P(wrong after the last still) where ground and edge name different kinds."""
    again: float = 0.1
    """The use of another still of the same view, relative to the first."""
    detail_weight: float = 0.0
    """The worth of a large object's details that the base does not show at all, in corrected classes."""
    detail_px: float = 48.0
    """Side in source pixels at which an object has half of the details that a large one has."""
    min_gain: float = 0.02
    """Least gain of a still: about twice the rate at which a still spoils a class that was right."""
    lookahead: float = 3.0
    name: ClassVar[str] = "M6"

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:
        """Best first; always at least the best request, so that it waits for its allowance."""
        gains = {one.track_id: self.gain(one, step) for one in candidates}
        wanted = ranked(
            (one for one in candidates if gains[one.track_id] >= self.min_gain),
            score=lambda one: 1000 * gains[one.track_id] / _line_bytes(one, step),
            reason="gain",
        )
        spent = 0.0
        for count, request in enumerate(wanted):
            spent += _line_bytes(request.candidate, step)
            if spent > self.lookahead * step.allowance_bytes:
                return wanted[: max(count, 1)]
        return wanted

    def gain(self, candidate: Candidate, step: Step) -> float:
        """Chance that a still now corrects the class that the ground shows, 0…1, plus the worth of its details."""
        faded = novelty(candidate, now_ns=step.now_ns, time_constant_s=self.fade_s)  # 1 - k
        before = faded * self.doubt(candidate, from_source=step.from_source)
        after = (1 - faded) * self._doubt_left(candidate) * self._better(candidate)
        worth = before + after
        if self.detail_weight > 0:
            news = faded + (1 - faded) * self._better(candidate)
            worth += min(_MOST_WEIGHT, self.detail_weight) * news * self.hidden_detail(candidate)
        # Sharpness reads pixels: only where it can matter.
        return worth * self.use(candidate, from_source=step.from_source) if worth >= self.min_gain else 0.0

    def hidden_detail(self, candidate: Candidate) -> float:
        """0…1: the details in a still of an object that the base, at its size and rate, lacks: pixels on target."""
        area_px = max(0.0, candidate.area_px)
        half = max(1.0, self.detail_px)
        return self._lost(candidate) * area_px / (area_px + half * half)

    def doubt(self, candidate: Candidate, *, from_source: bool) -> float:
        """P(wrong before any still): the ground misses the object on the base, or names another class."""
        weight = self.lost_weight_source if from_source else self.lost_weight
        lost = self._lost(candidate)
        x1, y1, x2, y2 = candidate.box_base_px
        side_px = math.sqrt(max(1.0, (x2 - x1) * (y2 - y1)))
        logit = (
            self.bias
            - self.confidence_weight * candidate.confidence
            + weight * lost
            + self.size_weight * math.log2(side_px / _SIDE_PX)
        )
        return 1 / (1 + math.exp(-min(_MOST_LOGIT, max(-_MOST_LOGIT, logit))))

    def use(self, candidate: Candidate, *, from_source: bool) -> float:
        """P(the still helps): whether the source crop can be classified at all."""
        side_px = math.sqrt(max(1.0, candidate.area_px))
        use = side_px / (side_px + self.readable_px)
        if from_source and self.readable_confidence > 0:
            use *= 1 - math.exp(-candidate.confidence / self.readable_confidence)
        use *= 1 - min(1.0, self.covered_share) * candidate.covered_share
        if candidate.touches_border:
            use *= 1 - min(1.0, self.border_share)
        if candidate.sharpness is not None and self.sharp_half > 0:
            sharp = candidate.sharpness()
            use *= sharp / (sharp + self.sharp_half)
        return use

    def _lost(self, candidate: Candidate) -> float:
        return self.unknown_lost if candidate.loss is None else candidate.loss().detail_lost

    def _doubt_left(self, candidate: Candidate) -> float:
        # P(wrong after the last still): ``1 - exp(-H)`` of the ground's entropy, more where the two disagree.
        class_posterior = candidate.posterior
        if class_posterior is None:
            return min(1.0, self.unanswered)
        doubt = 1 - math.exp(-max(0.0, class_posterior.entropy_nats))
        known = MOVING not in (class_posterior.class_name, candidate.class_name)
        if known and not same_kind(class_posterior.class_name, candidate.class_name):
            doubt = max(doubt, min(1.0, self.disagreement))
        return doubt

    def _better(self, candidate: Candidate) -> float:
        # 0…1: how much more than the last still another would show; 1 for twice the side, or whole at last.
        if candidate.last_sent_at_border and not candidate.touches_border:
            return 1.0
        if not candidate.last_sent_area_px or candidate.area_px <= 0:
            return min(1.0, self.again)
        grown = math.log2(candidate.area_px / candidate.last_sent_area_px) / 2
        return min(1.0, max(self.again, grown))


def _line_bytes(candidate: Candidate, step: Step) -> float:
    return step.cost.of(candidate) + step.still_overhead_bytes
