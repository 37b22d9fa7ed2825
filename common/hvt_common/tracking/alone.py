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
_MOST_SHARE: Final = 0.9
"""What is surely there is easy to see; of what is not, nobody reports more."""
_CAUTION: Final = 2
"""So many objects not reported are added: after the first that both see nothing is known yet."""
_MEMORY_S: Final = 10.0


class Recall:
    """Which share of what is surely there one observer reports; few objects count for little, and old ones fade."""

    def __init__(self) -> None:
        self._there = 0.0
        self._reported = 0.0
        self._at_s: float | None = None

    def take(self, *, reported: int, there: int, at_s: float) -> None:
        """Of one picture: how many objects were surely there, and how many of them were reported."""
        fade = 0.0 if self._at_s is None else math.exp(-max(0.0, at_s - self._at_s) / _MEMORY_S)
        self._there = fade * self._there + there
        self._reported = fade * self._reported + reported
        self._at_s = at_s

    @property
    def share(self) -> float:
        """0.5…0.9, or 0 where silence says nothing."""
        share = self._reported / (self._there + _CAUTION)
        return min(share, _MOST_SHARE) if share >= _LEAST_SHARE else 0.0

    @property
    def least_confidence(self) -> float:
        """From where what is not reported is listed all the same; 0 where silence says nothing."""
        if not self.share:
            return 0.0
        return _LEAST_REAL / (_LEAST_REAL + (1 - _LEAST_REAL) * (1 - self.share))

    def real(self, confidences: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        """(N,) the probabilities that detections (N,) are real that are not reported; see the module."""
        found = np.clip(np.asarray(confidences, np.float64), 0, 1)
        there = found * (1 - self.share)
        return np.asarray(there / np.maximum(there + 1 - found, 1e-9), np.float64)
