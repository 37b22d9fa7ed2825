"""The expected bytes of a still, estimated on line from the bytes of those already sent.

A still's size is close to a line in its number of pixels: a header with its tables, then so much a pixel. On 413
crops of the drone_carpark clip JPEG at quality 65 costs 639 bytes plus 0.119 a pixel, which is where the estimate
starts. Other codecs start elsewhere (`CostModel.of_codec`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from hvt_edge.perception.candidates import Candidate

_PRIOR_FIXED_BYTES = 640.0
_PRIOR_BYTES_PER_PX = 0.12
_PRIOR_MEAN_BYTES = 1500.0
_PRIOR_AREAS_PX = (1_000.0, 6_000.0, 30_000.0)
_PRIORS = {"residual": (100.0, 0.06), "h264-intra": (120.0, 0.09)}
"""(fixed bytes, bytes a pixel) between the cost of cars of 60 pixels and of vehicles of 15 at quality 65."""
_PRIOR_MEAN_PX = 7_000.0


@dataclass(frozen=True, slots=True)
class CostEstimate:
    """The line, frozen at one moment."""

    fixed_bytes: float = _PRIOR_FIXED_BYTES
    bytes_per_px: float = _PRIOR_BYTES_PER_PX
    mean_bytes: float = _PRIOR_MEAN_BYTES
    """Running mean size of the stills sent: the unit in which M5 counts cost."""

    def of(self, candidate: Candidate) -> float:
        """Expected payload bytes of a still of this candidate; never below 1."""
        return self.of_px(candidate.crop_area_px)

    def of_px(self, coded_px: float) -> float:
        """Expected payload bytes of a still of so many coded pixels; never below 1."""
        return max(1.0, self.fixed_bytes + self.bytes_per_px * coded_px)


class CostModel:
    """Least squares with forgetting, each still weighted by its relative error, so that large ones do not rule.

    The prior stays in as three points that weigh as much as ``prior_weight`` stills together: with all stills
    of one size the slope would be undetermined without it.
    """

    def __init__(
        self,
        *,
        memory: float = 0.98,
        mean_memory: float = 0.95,
        prior_weight: float = 0.5,
        prior: CostEstimate = CostEstimate(),
    ) -> None:
        self._memory = memory
        self._mean_memory = mean_memory
        self._mean = prior.mean_bytes
        self._prior = self._sums = np.zeros(5)
        for area in _PRIOR_AREAS_PX:
            self._prior = self._prior + _weighted(
                area, prior.of_px(area), prior_weight / len(_PRIOR_AREAS_PX)
            )

    @classmethod
    def of_codec(cls, name: str) -> CostModel:
        """Starts where that codec is known to lie; one that is not known starts as JPEG."""
        if name not in _PRIORS:
            return cls()
        fixed, slope = _PRIORS[name]
        return cls(prior=CostEstimate(fixed, slope, fixed + slope * _PRIOR_MEAN_PX))

    def observe(self, *, area_px: float, size_bytes: int) -> None:
        """A still of that many coded pixels took that many payload bytes."""
        self._sums = self._memory * self._sums + _weighted(area_px, float(size_bytes), 1.0)
        self._mean = self._mean_memory * self._mean + (1 - self._mean_memory) * size_bytes

    def estimate(self) -> CostEstimate:
        """The line as it stands; neither its height at zero nor its slope is ever negative."""
        one, x, y, xx, xy = (self._sums + self._prior).tolist()
        slope = (one * xy - x * y) / (one * xx - x * x)
        fixed = (y - slope * x) / one
        if slope < 0:
            fixed, slope = y / one, 0.0
        elif fixed < 0:
            fixed, slope = 0.0, xy / xx
        return CostEstimate(fixed_bytes=fixed, bytes_per_px=slope, mean_bytes=self._mean)


def _weighted(area_px: float, size_bytes: float, weight: float) -> npt.NDArray[np.float64]:
    # (5,): 1, area, size, area², area · size, by weight and relative error.
    w, x, y = weight / max(size_bytes, 1.0) ** 2, area_px, size_bytes
    return np.array((w, w * x, w * y, w * x * x, w * x * y))
