"""What only one of two observers sees of one scene: edge and ground, each with a detector.

What the edge alone sees is listed from `ALONE_CONFIDENCE` on. What the ground alone sees has the edge's silence
against it, and the edge looks at the source: how much that says depends on how much of what is there it reports
(its `Recall`, r). A detection of confidence c, calibrated, that it does not report is real with

    c (1 - r) / (c (1 - r) + 1 - c)                                                       (Bayes)

and is listed from `_LEAST_REAL` on: of a confidence of .8 where it reports nine of ten, of 1 where it reports all.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt

__all__ = ["ALONE_CONFIDENCE", "Recall"]

ALONE_CONFIDENCE: Final = 0.6
"""What only the edge sees, in its source, is listed from this confidence on. Of what it reports at less, one in two
was there on drawn scenes and hardly any on real labelled pictures. What is as sure on the base counts as there."""
_LEAST_REAL: Final = 0.3
_LEAST_RECALL: Final = 0.5
"""Who reports less than this has another detector, such as one of moving objects: its silence says nothing."""
_CAUTION: Final = 2
"""So many objects not reported are added: after the first that both see nothing is known yet."""
_FADE: Final = 0.97
"""What a picture still counts at the next: of three a second those of the last ten seconds."""


class Recall:
    """Which share of what is surely there one observer reports; few objects count for little."""

    def __init__(self) -> None:
        self._there = 0.0
        self._reported = 0.0

    def take(self, *, reported: int, there: int) -> None:
        """Of one picture: how many objects were surely there, and how many of them he reported."""
        self._there = _FADE * self._there + there
        self._reported = _FADE * self._reported + reported

    @property
    def share(self) -> float:
        """0…1; 0 where his silence says nothing."""
        share = self._reported / (self._there + _CAUTION)
        return share if share >= _LEAST_RECALL else 0.0

    @property
    def least_confidence(self) -> float:
        """From where what he does not report is listed all the same; 0 where his silence says nothing."""
        if not self.share:
            return 0.0
        return _LEAST_REAL / (_LEAST_REAL + (1 - _LEAST_REAL) * (1 - self.share))

    def real(self, confidences: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        """(N,) the probabilities that detections (N,) are real that he does not report; see the module."""
        there = np.asarray(confidences, np.float64) * (1 - self.share)
        return np.asarray(there / np.maximum(there + 1 - confidences, 1e-9), np.float64)
