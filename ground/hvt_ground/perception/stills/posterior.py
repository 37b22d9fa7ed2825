"""What stills have said of one track: the newest of them, and all of them fused.

Fusion is naive Bayes in log space over the classifier's classes, with a flat prior:

    log P(c) = sum over stills of n_i log max(p_i(c), 1e-4)  +  log b(c)  -  log Z

The floor keeps one confident mistake from being a veto for ever. ``n_i`` is how much the still showed that the base
did not, 0…1 (`still_stage`). ``b`` is what the detector says on the base stream *now*: its confidence for the class
that its track has voted for, the rest spread evenly over the others, and nothing at all below 1/C. It counts as one
still however often it was repeated, because the votes of successive frames are nearly the same measurement, and
only where the detector's class has a namesake among the classifier's. With half a still, and all stills alike, class
agreement on a car park at 200 kbps was 0.952 in place of 0.983, and 0.785 in place of 0.804 on small objects.

Log-probabilities are summed as integers (in units of 2^-20 nat): the sum does not depend on the order in which
stills arrive, to the last bit, and does not drift.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hvt_common.values import Posterior

__all__ = ["BASE_WEIGHT", "PROBABILITY_FLOOR", "ClassEstimate", "ClassNames", "TrackPosterior"]

PROBABILITY_FLOOR = 1e-4
BASE_WEIGHT = 1.0
_UNITS_PER_NAT = 1 << 20


@dataclass(frozen=True, slots=True)
class ClassEstimate:
    """A class with its probability and the entropy of the distribution it comes from."""

    class_name: str
    confidence: float
    entropy_nats: float


class ClassNames:
    """The detector's and the classifier's class names, and which of the former have a namesake in the latter."""

    def __init__(self, detector: tuple[str, ...], classifier: tuple[str, ...]) -> None:
        self.detector = detector
        self.classifier = classifier
        by_name = {name.strip().casefold(): index for index, name in enumerate(classifier)}
        self._namesakes = tuple(by_name.get(name.strip().casefold()) for name in detector)

    def base_log_vote(self, *, class_id: int, confidence: float) -> npt.NDArray[np.float64] | None:
        """(C,) ``log b`` over the classifier's classes; None where the class has no namesake there."""
        namesake, count = self._namesakes[class_id], len(self.classifier)
        if namesake is None or count < 2:
            return None
        own = min(max(confidence, 1 / count), 1 - PROBABILITY_FLOOR)
        vote = np.full(count, math.log((1 - own) / (count - 1)))
        vote[namesake] = math.log(own)
        return vote


class TrackPosterior:
    """What is known of one track of the ground."""

    __slots__ = ("_log_sum", "_newest", "_order", "last_frame")

    def __init__(self, frame_index: int) -> None:
        self.last_frame = frame_index
        """The newest frame in which the track was there."""
        self._newest: ClassEstimate | None = None
        self._order = (-1, -1)
        self._log_sum: npt.NDArray[np.int64] | None = None

    def update(
        self, posterior: Posterior, names: ClassNames, *, order: tuple[int, int], news: float = 1.0
    ) -> bool:
        """Take a still's posterior; True if it is the newest so far by ``order`` (frame index, sequence).

        ``news`` (0…1) is what it counts in the sum.

        ``ValueError`` if it does not have one probability for each of the classifier's classes.
        """
        said = posterior.probabilities.astype(np.float64)
        if said.shape != (len(names.classifier),):
            raise ValueError(f"a posterior over {len(names.classifier)} classes is wanted, not {said.shape}")
        said = np.where(
            np.isfinite(said), said, 0.0
        )  # a model that overflows says nothing, and vetoes nothing
        logs = np.rint(np.log(np.clip(said, PROBABILITY_FLOOR, 1.0)) * news * _UNITS_PER_NAT).astype(np.int64)
        self._log_sum = logs if self._log_sum is None else self._log_sum + logs
        if order < self._order:
            return False
        self._order = order
        self._newest = ClassEstimate(posterior.class_name, posterior.confidence, posterior.entropy_nats)
        return True

    def newest(self) -> ClassEstimate:
        """What the still of the newest frame said."""
        if self._newest is None:
            raise ValueError("no still has refined this track yet")
        return self._newest

    def fused(self, names: ClassNames, *, class_id: int, confidence: float) -> ClassEstimate:
        """All stills together with the detector's present vote (its class and confidence on the base)."""
        if self._log_sum is None:
            raise ValueError("no still has refined this track yet")
        logs = self._log_sum / _UNITS_PER_NAT
        vote = names.base_log_vote(class_id=class_id, confidence=confidence)
        if vote is not None:
            logs += BASE_WEIGHT * vote
        logs -= logs.max()
        logs -= math.log(np.exp(logs).sum())
        probabilities = np.exp(logs)
        best = int(probabilities.argmax())
        entropy_nats = max(0.0, -float(probabilities @ logs))
        return ClassEstimate(names.classifier[best], float(probabilities[best]), entropy_nats)
