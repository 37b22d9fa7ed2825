"""The contract of a method: a pure function from the candidates of a step to requests for stills, most useful first.

To add one: a frozen dataclass with its parameters in a file beside this one, and one row in `registry`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from hvt_edge.perception.candidates import Candidate

STILL_OVERHEAD_BYTES = 147.0
"""With the usual names: 56 of header and 83 of framing and TCP for JPEG, 9 more for a residual."""
_PRIOR_FIXED_BYTES = 640.0
_PRIOR_BYTES_PER_PX = 0.12
_PRIOR_MEAN_BYTES = 1500.0
_PRIOR_AREAS_PX = (1_000.0, 6_000.0, 30_000.0)
_PRIORS = {"residual": (100.0, 0.06), "h264-intra": (120.0, 0.09)}
"""(fixed bytes, bytes a pixel) between the cost of cars of 60 pixels and of vehicles of 15 at quality 65."""
_PRIOR_MEAN_PX = 7_000.0
_PRIOR_WEIGHT = 0.5 / len(_PRIOR_AREAS_PX)
_MEMORY, _MEAN_MEMORY = 0.98, 0.95


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
    """The expected bytes of a still, from the bytes of those already sent.

    A still's size is close to a line in its number of pixels: a header with its tables, then so much a pixel. On 413
    crops of the drone_carpark clip JPEG at quality 65 costs 639 bytes plus 0.119 a pixel, which is where the estimate
    starts. Least squares with forgetting, each still weighted by its relative error, so that large ones do not rule.

    The prior stays in as three points that weigh as much as half a still together: with all stills of one size the
    slope would be undetermined without it.
    """

    def __init__(self, prior: CostEstimate = CostEstimate()) -> None:
        self._mean = prior.mean_bytes
        self._prior = self._sums = np.zeros(5)
        for area in _PRIOR_AREAS_PX:
            self._prior = self._prior + _weighted(area, prior.of_px(area), _PRIOR_WEIGHT)

    @classmethod
    def of_codec(cls, name: str) -> CostModel:
        """Starts where that codec is known to lie; one that is not known starts as JPEG."""
        if name not in _PRIORS:
            return cls()
        fixed, slope = _PRIORS[name]
        return cls(CostEstimate(fixed, slope, fixed + slope * _PRIOR_MEAN_PX))

    def observe(self, *, area_px: float, size_bytes: int) -> None:
        """A still of that many coded pixels took that many payload bytes."""
        self._sums = _MEMORY * self._sums + _weighted(area_px, float(size_bytes), 1.0)
        self._mean = _MEAN_MEMORY * self._mean + (1 - _MEAN_MEMORY) * size_bytes

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


@dataclass(frozen=True, slots=True)
class Step:
    """The facts of the moment that every method may use beside the candidates."""

    frame_index: int
    now_ns: int
    fps: float
    """Frames a second of the base stream."""
    base_size: tuple[int, int]
    """(width, height) in base pixels."""
    cost: CostEstimate
    """The expected cost of a still, learnt from those already sent."""
    allowance_bytes: float
    """The bytes that the rolling budget would admit now."""
    still_overhead_bytes: float = STILL_OVERHEAD_BYTES
    """Line bytes that a still takes beside its payload: header, framing, transport."""
    from_source: bool = False
    """Whether candidates were detected on the source (``--candidates source``): the base may not show them."""


@dataclass(frozen=True, slots=True)
class Request:
    """A request for a still of one candidate."""

    candidate: Candidate
    reason: str
    """In a word or two, for the ledger, the wire and the viewer."""
    score: float
    """The queue sends the highest first; comparable within one method only."""
    also: tuple[Candidate, ...] = ()
    """Neighbours that the same still shows (`hvt_edge.stills.merging`), by track id; never ``candidate`` itself."""

    def without_frame(self) -> Request:
        """The same with measurements of the frame made now: a pending still must not hold frames."""
        return replace(
            self, candidate=_measured(self.candidate), also=tuple(_measured(one) for one in self.also)
        )


class Method(Protocol):
    """A scheduling policy."""

    @property
    def name(self) -> str:
        """As ``--method`` and the tables say it."""
        ...

    @property
    def video_only(self) -> bool:
        """True where no still is ever wanted, so that the base stream may take the whole budget."""
        ...

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:
        """The requests of this step, most useful first, at most one a track; the same for the same input."""
        ...


def ranked(
    candidates: Iterable[Candidate], *, score: Callable[[Candidate], float | None], reason: str
) -> list[Request]:
    """Requests for those with a score, highest first; ties go to the older track, whatever the order they came in."""
    wanted = [
        Request(candidate, reason, value)
        for candidate in candidates
        if (value := score(candidate)) is not None
    ]
    return sorted(wanted, key=lambda request: (-request.score, request.candidate.track_id))


def _measured(candidate: Candidate) -> Candidate:
    if candidate.sharpness is None:
        return replace(candidate, loss=None)
    value = candidate.sharpness()
    return replace(candidate, sharpness=lambda: value, loss=None)
