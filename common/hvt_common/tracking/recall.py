"""The evidence of a missed detection: edge and ground have a detector each, and one of them reports nothing.

An edge-only object is listed from `EDGE_ONLY_CONFIDENCE` on. A ground-only object has the edge's missed detection
against it, and the edge mostly detects on the source: the weight of that depends on the share of sure objects that
the edge reports (its `Recall`, r). A calibrated detection of confidence c that it does not report is real with

    c (1 - r) / (c (1 - r) + 1 - c)                                                       (Bayes)

and is listed from `_LEAST_REAL` on: from a confidence of .8 if the edge reports nine of ten.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

EDGE_ONLY_CONFIDENCE: Final = 0.6
"""An edge-only object is listed from this confidence on. Below it one in two was real on drawn scenes, and hardly any
on real labelled pictures. A ground's object as sure as this counts as real."""
_LEAST_REAL: Final = 0.3
_LEAST_SHARE: Final = 0.5
"""A detector that reports less than this looks for other things: its misses say nothing."""
_STILL_SHARE: Final = 0.4
"""Once its misses count they do so down to here, or a list would come and go."""
_MOST_SHARE: Final = 0.9
"""Limit of the reported share: sure objects are easy to detect, and no more of the others are reported."""
_CAUTION: Final = 2
"""Unreported objects that are assumed at the start: after the first that both detect, nothing is known yet."""
_OTHERS: Final = 20
"""The rate over all classes counts as 20 objects of each: few are enough to learn that a detector does not know one
of them."""
_MEMORY_S: Final = 10.0


class Recall:
    """The share of sure objects that one detector reports; few objects count for little, and old ones fade.

    By class: a detector of each car may know no people. A class without counts has the share of all.
    """

    def __init__(self) -> None:
        self._counts: dict[int, npt.NDArray[np.float64]] = {}
        """By class, (2,) the number of objects, and how many of them were reported."""
        self._shares: dict[int, float] = {}
        self._share_of_others = 0.0
        """The same for classes without any count."""
        self._at_s: float | None = None

    def take(self, class_ids: npt.NDArray[Any], *, reported: npt.NDArray[np.bool_], at_s: float) -> None:
        """Count one picture: the classes (N,) of the sure objects, and whether each was ``reported`` (N,)."""
        fade = 0.0 if self._at_s is None else math.exp(-max(0.0, at_s - self._at_s) / _MEMORY_S)
        self._at_s = at_s
        self._counts = {class_id: fade * counts for class_id, counts in self._counts.items()}
        for class_id, is_reported in zip(class_ids.tolist(), reported.tolist(), strict=True):
            self._counts.setdefault(class_id, np.zeros(2))[:] += (1.0, is_reported)
        there, reports = sum(self._counts.values(), np.zeros(2)).tolist()
        of_all = reports / (there + _CAUTION)
        of_others = np.array([_OTHERS, _OTHERS * of_all])
        totals = {class_id: (counts + of_others).tolist() for class_id, counts in self._counts.items()}
        self._shares = {
            class_id: _limited(reported / there, before=self.share(class_id))
            for class_id, (there, reported) in totals.items()
        }
        self._share_of_others = _limited(of_all, before=self._share_of_others)

    def share(self, class_id: int) -> float:
        """0.4…0.9, or 0 if a miss says nothing."""
        return self._shares.get(class_id, self._share_of_others)

    def least_confidence(self, class_id: int) -> float:
        """From this confidence an unreported object is listed all the same; 0 if a missed detection says nothing."""
        share = self.share(class_id)
        return _LEAST_REAL / (_LEAST_REAL + (1 - _LEAST_REAL) * (1 - share)) if share else 0.0

    def real(self, confidence: float, class_id: int) -> float:
        """The probability that an unreported detection is real; see the module."""
        found = min(max(confidence, 0.0), 1.0)
        there = found * (1 - self.share(class_id))
        return there / max(there + 1 - found, 1e-9)


def _limited(share: float, *, before: float) -> float:
    return min(share, _MOST_SHARE) if share >= (_STILL_SHARE if before else _LEAST_SHARE) else 0.0
