"""What a still will cost, estimated on line from the bytes of those already sent.

A still's size is close to a line in its number of pixels: a header with its tables, then so much a pixel. On 413
crops of the drone_carpark clip JPEG at quality 65 costs 639 bytes plus 0.119 a pixel, which is where the estimate
starts. Other codecs start elsewhere (`CostModel.of_codec`).
"""

from __future__ import annotations

from dataclasses import dataclass

from hvt_edge.perception.candidates import Candidate

__all__ = ["CostEstimate", "CostModel"]

_PRIOR_FIXED_BYTES = 640.0
_PRIOR_BYTES_PER_PX = 0.12
_PRIOR_MEAN_BYTES = 1500.0
_PRIOR_AREAS_PX = (1_000.0, 6_000.0, 30_000.0)
_PRIORS = {"residual": (100.0, 0.06), "h264-intra": (120.0, 0.09)}
"""(fixed bytes, bytes a pixel) between what cars of 60 pixels and vehicles of 15 took at quality 65."""
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
        self._prior = _Sums()
        for area in _PRIOR_AREAS_PX:
            size = prior.of_px(area)
            self._prior = self._prior.plus(area, size, weight=prior_weight / len(_PRIOR_AREAS_PX))
        self._sums = _Sums()

    @classmethod
    def of_codec(cls, name: str) -> CostModel:
        """Starts where that codec is known to lie; one that is not known starts as JPEG."""
        if name not in _PRIORS:
            return cls()
        fixed, slope = _PRIORS[name]
        return cls(prior=CostEstimate(fixed, slope, fixed + slope * _PRIOR_MEAN_PX))

    def observe(self, *, area_px: float, size_bytes: int) -> None:
        """A still of that many coded pixels took that many payload bytes."""
        self._sums = self._sums.faded(self._memory).plus(area_px, float(size_bytes), weight=1.0)
        self._mean = self._mean_memory * self._mean + (1 - self._mean_memory) * size_bytes

    def estimate(self) -> CostEstimate:
        """The line as it stands; neither its height at zero nor its slope is ever negative."""
        fixed, slope = self._sums.merged(self._prior).line()
        return CostEstimate(fixed_bytes=fixed, bytes_per_px=slope, mean_bytes=self._mean)


@dataclass(frozen=True, slots=True)
class _Sums:
    """Weighted sums of 1, area, size, area², area · size."""

    one: float = 0.0
    x: float = 0.0
    y: float = 0.0
    xx: float = 0.0
    xy: float = 0.0

    def plus(self, x: float, y: float, *, weight: float) -> _Sums:
        w = weight / max(y, 1.0) ** 2
        return _Sums(self.one + w, self.x + w * x, self.y + w * y, self.xx + w * x * x, self.xy + w * x * y)

    def faded(self, share: float) -> _Sums:
        return _Sums(*(share * value for value in (self.one, self.x, self.y, self.xx, self.xy)))

    def merged(self, other: _Sums) -> _Sums:
        return _Sums(
            self.one + other.one, self.x + other.x, self.y + other.y, self.xx + other.xx, self.xy + other.xy
        )

    def line(self) -> tuple[float, float]:
        slope = (self.one * self.xy - self.x * self.y) / (self.one * self.xx - self.x * self.x)
        if slope < 0:
            return self.y / self.one, 0.0
        fixed = (self.y - slope * self.x) / self.one
        return (fixed, slope) if fixed >= 0 else (0.0, self.xy / self.xx)
