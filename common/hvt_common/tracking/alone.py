"""What only one of two observers sees of one scene: edge and ground, each with a detector.

What the edge alone sees is listed from `ALONE_CONFIDENCE` on. What the ground alone sees has the edge's silence
against it, and the edge mostly looks at the source: how much that says depends on how much of what is surely there it
reports (its `Recall`, r). A detection of confidence c, calibrated, that it does not report is real with

    c (1 - r) / (c (1 - r) + 1 - c)                                                       (Bayes)

and is listed from `_LEAST_REAL` on: of a confidence of .8 where it reports nine of ten.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

__all__ = ["ALONE_CONFIDENCE", "Recall"]

ALONE_CONFIDENCE: Final = 0.6
"""What only the edge sees, in its source, is listed from this confidence on. Of what it reports at less, one in two
was there on drawn scenes and hardly any on real labelled pictures. What is as sure on the base counts as there."""
_LEAST_REAL: Final = 0.3
_LEAST_SHARE: Final = 0.5
"""Who reports less than this looks for other things: its silence says nothing."""
_STILL_SHARE: Final = 0.4
"""Once it says something it does so down to here, or a list would come and go."""
_MOST_SHARE: Final = 0.9
"""Limit of the reported share: sure objects are easy to detect, and no more of the others are reported."""
_CAUTION: Final = 2
"""Unreported objects that are assumed at the start: after the first that both detect, nothing is known yet."""
_OTHERS: Final = 20
"""What is known of all classes counts as so many objects of each: few are enough to learn that an observer does not
know one of them."""
_MEMORY_S: Final = 10.0


class Recall:
    """Which share of what is surely there one observer reports; few objects count for little, and old ones fade.

    By class: who reports each car may know no people. What is not known of a class is taken from all of them.
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
        self._shares = {
            class_id: _believed(_share(counts + of_others), before=self.share(class_id))
            for class_id, counts in self._counts.items()
        }
        self._share_of_others = _believed(of_all, before=self._share_of_others)

    def share(self, class_id: int) -> float:
        """0.4…0.9, or 0 where silence says nothing."""
        return self._shares.get(class_id, self._share_of_others)

    def least_confidence(self, class_id: int) -> float:
        """From this confidence an unreported object is listed all the same; 0 if a missed detection says nothing."""
        share = self.share(class_id)
        return _LEAST_REAL / (_LEAST_REAL + (1 - _LEAST_REAL) * (1 - share)) if share else 0.0

    def real(self, confidence: float, class_id: int) -> float:
        """The probability that a detection is real that is not reported; see the module."""
        found = min(max(confidence, 0.0), 1.0)
        there = found * (1 - self.share(class_id))
        return there / max(there + 1 - found, 1e-9)


def _share(counts: npt.NDArray[np.float64]) -> float:
    there, reports = counts.tolist()
    return float(reports / there)


def _believed(share: float, *, before: float) -> float:
    """What the share counts as, when it counted as so much ``before``."""
    return min(share, _MOST_SHARE) if share >= (_STILL_SHARE if before else _LEAST_SHARE) else 0.0
