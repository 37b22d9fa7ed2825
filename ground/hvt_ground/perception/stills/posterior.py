"""The stills' opinion of one track: the newest of them, and all of them fused.

Fusion is naive Bayes in log space over the classes of tracks (`Vocabulary`), with a flat prior:

    log P(c) = sum over stills of n_i log max(p_i(c), 1e-4)  +  log b(c)  -  log Z

The floor keeps one confident mistake from being a veto for ever. ``n_i`` is how much the still showed that the base
did not, 0…1 (`StillStage`). ``b`` is the detector's opinion of the base stream *now*: its confidence for the class
that its track has voted for, nothing at all below 1/C, and the rest over the others: half of it for *nothing of mine*
where the classifier can say that, for a detector that errs has mostly seen nothing. It counts as one still however
often it was repeated, because the votes of successive frames are nearly the same measurement. With half a still, and
all stills alike, class agreement on a car park at 200 kbps was 0.952 in place of 0.983, and 0.785 in place of 0.804
on small objects.

A class changes only where its probability exceeds that of the class on the base by `MARGIN`. Shown classes
are not remembered: the order in which stills arrive must not matter.

Log-probabilities are summed as integers (in units of 2^-20 nat): the sum does not depend on the order in which
stills arrive, to the last bit, and does not drift.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hvt_common.inference.class_names import MOVING
from hvt_common.values import Posterior
from hvt_ground.perception.stills.vocabulary import Vocabulary

PROBABILITY_FLOOR = 1e-4
BASE_WEIGHT = 1.0
MARGIN = 0.2
"""Lead that another class needs over that of the base: a toss-up leaves the class as it is."""
SURE = 0.9
"""Above it, a class that stills agree on is certain."""
LEAST_SURE_PX = 12
"""The shorter side of an object, source pixels, below which no still makes it certain: on ten pixels a shrub and
a person are alike, whatever a network says."""
_NOTHING_SHARE = 0.5
_UNITS_PER_NAT = 1 << 20
_Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ClassEstimate:
    """A class with its probability."""

    class_id: int
    """Index of `Vocabulary.names`."""
    confidence: float
    sure: bool = False
    """The newest still alone and all of them together give the class more than `SURE`: many stills of one object err
    alike, and their product says more than they know."""


class TrackPosterior:
    """The class posterior of one track of the ground."""

    __slots__ = ("_clear", "_log_sum", "_newest", "_order", "base_class_id", "last_frame")

    def __init__(self, frame_index: int) -> None:
        self.last_frame = frame_index
        """The newest frame in which the track was there."""
        self.base_class_id = -1
        """Its class on the base in the frame of the newest still."""
        self._newest: Posterior | None = None
        self._clear = False
        self._order = (-1, -1)
        self._log_sum = np.zeros((), np.int64)

    def update(self, said: Posterior, *, order: tuple[int, int], side_px: float, news: float = 1.0) -> bool:
        """Take a still's vote; True if it is the newest so far by ``order`` (frame index, sequence).

        ``side_px`` is the shorter side of the object in source pixels, ``news`` (0…1) its weight in the sum.
        """
        logs = np.log(np.clip(said.probabilities.astype(np.float64), PROBABILITY_FLOOR, 1.0))
        units = np.rint(logs * news * _UNITS_PER_NAT).astype(np.int64)
        self._log_sum = self._log_sum + units
        if order < self._order:
            return False
        self._order, self._newest, self._clear = order, said, side_px >= LEAST_SURE_PX
        return True

    def newest(self, vocabulary: Vocabulary, *, class_id: int) -> ClassEstimate:
        """The class in the still of the newest frame; the class on the base, if that means the same."""
        said = self._newest
        assert said is not None, "update() comes first"
        best = vocabulary.names.index(said.class_name)
        if said.probabilities[class_id] >= said.probabilities[best]:
            best = class_id
        sure = self._clear and said.confidence > SURE
        return ClassEstimate(best, said.confidence, sure=sure)

    def fused(self, vocabulary: Vocabulary, *, class_id: int, confidence: float) -> ClassEstimate:
        """All stills together with the detector's present vote (its class and confidence on the base)."""
        said = self._newest
        assert said is not None, "update() comes first"
        logs = self._log_sum / _UNITS_PER_NAT
        logs += BASE_WEIGHT * _base_log_vote(vocabulary, class_id=class_id, confidence=confidence)
        logs -= logs.max()
        logs -= math.log(np.exp(logs).sum())
        probabilities = np.exp(logs)
        best = int(probabilities.argmax())
        if probabilities[best] <= probabilities[class_id] + MARGIN:
            best = class_id
        now = float(probabilities[best])
        sure = self._clear and min(now, float(said.probabilities[best])) > SURE
        return ClassEstimate(best, now, sure=sure)


def _base_log_vote(vocabulary: Vocabulary, *, class_id: int, confidence: float) -> _Floats:
    # (C,) ``log b`` over the classes of tracks; flat where the detector says only that something moves.
    count = len(vocabulary.names)
    if count < 2 or vocabulary.names[class_id] == MOVING:
        return np.zeros(count)
    own = min(max(confidence, 1 / count), 1 - PROBABILITY_FLOOR)
    rest = np.full(count, (1 - own) / (count - 1))
    nothing = vocabulary.nothing
    if nothing is not None and nothing != class_id and count > 2:
        rest[:] = (1 - own) * (1 - _NOTHING_SHARE) / (count - 2)
        rest[nothing] = (1 - own) * _NOTHING_SHARE
    rest[class_id] = own
    return np.asarray(np.log(rest), np.float64)
