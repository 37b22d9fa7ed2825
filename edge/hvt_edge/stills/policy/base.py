"""The contract of a method: a pure function from the candidates of a step to requests for stills, most useful first.

To add one: a frozen dataclass with its parameters in a file beside this one, and one row in `registry`.

Small objects that stand close together share one still where that takes fewer bytes (`group`). A still costs its
pixels and, whatever it shows, a fixed part: the codec's preamble, the header, framing and TCP. A crop around
two neighbours codes the ground between them as well, and saves one fixed part. Whether that pays follows from the
codec's own costs as learnt in this session.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from hvt_common.video.base_crop import MAX_SIDE_PX, coded_size
from hvt_edge.perception.candidates import Candidate, crop_box

ALSO_BYTES = 17.0
"""Bytes of the header for each further track: its id and its box in eighths of a pixel."""
MOST_ALSO = 15
_MOST_COMPARED = 96
"""Number of requests, the most useful ones, that are compared with each other; it bounds the time."""
_LEAST_SAVING_BYTES = 1.0
STILL_OVERHEAD_BYTES = 147.0
"""Bytes with the usual names: 56 of header and 83 of framing and TCP for JPEG, 9 more for a residual."""
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
    """The line of size over pixels, frozen at one moment."""

    fixed_bytes: float = _PRIOR_FIXED_BYTES
    bytes_per_px: float = _PRIOR_BYTES_PER_PX
    mean_bytes: float = _PRIOR_MEAN_BYTES
    """Running mean size of the stills sent: the unit in which M5 counts cost."""

    def of(self, candidate: Candidate) -> float:
        return self.of_px(candidate.crop_area_px)

    def of_px(self, coded_px: float) -> float:
        """Expected payload bytes of a still of ``coded_px`` pixels; never below 1."""
        return max(1.0, self.fixed_bytes + self.bytes_per_px * coded_px)


class CostModel:
    """The expected bytes of a still, from the bytes of stills already sent.

    A still's size is close to a line in its number of pixels: a header with its tables, then a cost per pixel. On 413
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
        """Starts at the known costs of that codec; an unknown codec starts as JPEG."""
        if name not in _PRIORS:
            return cls()
        fixed, slope = _PRIORS[name]
        return cls(CostEstimate(fixed, slope, fixed + slope * _PRIOR_MEAN_PX))

    def observe(self, *, area_px: float, size_bytes: int) -> None:
        """Add a still of ``area_px`` coded pixels that took ``size_bytes`` of payload."""
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
    base_size: tuple[int, int]
    """(width, height) in base pixels."""
    cost: CostEstimate
    """The expected cost of a still, learnt from stills already sent."""
    allowance_bytes: float
    still_overhead_bytes: float = STILL_OVERHEAD_BYTES
    """Line bytes that a still takes beside its payload: header, framing, transport."""
    from_source: bool = False
    """Whether candidates were detected on the source (``--candidates source``): the base may not show them."""


@dataclass(frozen=True, slots=True)
class Request:
    """A request for a still of one candidate."""

    candidate: Candidate
    reason: str
    """A word or two for the ledger, the wire and the viewer."""
    score: float
    """The queue sends the highest first; comparable within one method only."""
    also: tuple[Candidate, ...] = ()
    """Neighbours that the same still shows (`group`), by track id; never ``candidate`` itself."""

    def without_frame(self) -> Request:
        """The same with measurements of the frame made now: a pending still must not hold frames."""
        return replace(
            self, candidate=_measured(self.candidate), also=tuple(_measured(one) for one in self.also)
        )


class Method(Protocol):
    """A scheduling policy."""

    @property
    def name(self) -> str:
        """The name in ``--method`` and in tables."""
        ...

    @property
    def video_only(self) -> bool:
        """True if the method never requests a still, so that the base stream may take the whole budget."""
        return False

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:
        """The requests of this step, most useful first, at most one a track; the same for the same input."""
        ...


def ranked(
    candidates: Iterable[Candidate], *, score: Callable[[Candidate], float | None], reason: str
) -> list[Request]:
    """Requests for candidates with a score, highest first; ties go to the older track, whatever the input order."""
    wanted = [
        Request(candidate, reason, value)
        for candidate in candidates
        if (value := score(candidate)) is not None
    ]
    return _ordered(wanted)


def _ordered(requests: Iterable[Request]) -> list[Request]:
    return sorted(requests, key=lambda request: (-request.score, request.candidate.track_id))


def group(
    requests: Sequence[Request],
    *,
    cost: CostEstimate,
    overhead_bytes: float,
    padding: float,
    source_size: tuple[int, int],
) -> list[Request]:
    """Join the requests of one step into stills, a request for each.

    The two stills that save most by becoming one are joined, and again, until no two save a byte; no still
    shows more than `MOST_ALSO` tracks beside its lead, nor a side of more than `MAX_SIDE_PX` where it shows several.
    ``overhead_bytes`` are the line bytes of a still beside its payload.

    The lead is the most useful request of its group and comes with ``also`` filled and a score of its own: the sum of
    all gains over the cost of the joint still, if scores are gains per byte; never less than its score alone. Most
    wanted first, ties by the lead's track id. Each request is in exactly one group.
    """
    compared = list(requests[:_MOST_COMPARED])
    crops = [
        crop_box(one.candidate.box_source_px, padding=padding, source_size=source_size) for one in compared
    ]
    single = np.array([cost.of(one.candidate) + overhead_bytes for one in compared], np.float64)
    board = _Board(
        cost=cost,
        overhead_bytes=overhead_bytes,
        crops=np.array(crops, np.int64).reshape(-1, 4),
        bytes=single.copy(),
        single_bytes=single,
        members=[[index] for index in range(len(compared))],
    )
    board.join()
    joined = [board.request(sorted(members), compared) for members in board.members if members]
    return _ordered([*joined, *requests[_MOST_COMPARED:]])


def union_crop(
    request: Request, *, padding: float, source_size: tuple[int, int]
) -> tuple[int, int, int, int]:
    """The area of its still: the smallest box around the padded crops of all its tracks, source pixels."""
    crops = [
        crop_box(one.box_source_px, padding=padding, source_size=source_size)
        for one in (request.candidate, *request.also)
    ]
    x1, y1, x2, y2 = zip(*crops, strict=True)
    return min(x1), min(y1), max(x2), max(y2)


def expected_bytes(
    request: Request, *, cost: CostEstimate, padding: float, source_size: tuple[int, int]
) -> float:
    """Expected payload of a still of this request, of one track or of several."""
    if not request.also:
        return cost.of(request.candidate)
    width, height = coded_size(union_crop(request, padding=padding, source_size=source_size))
    return cost.of_px(width * height)


@dataclass(slots=True)
class _Board:
    # Stills in progress: row ``i`` is the still that request ``i`` leads, until another absorbs it.

    cost: CostEstimate
    overhead_bytes: float
    crops: npt.NDArray[np.int64]
    bytes: npt.NDArray[np.float64]
    """(N,) expected line bytes."""
    single_bytes: npt.NDArray[np.float64]
    members: list[list[int]]
    """Empty where another still has absorbed this one."""

    def join(self) -> None:
        count = len(self.members)
        savings = np.full((count, count), -np.inf)
        for row in range(count):
            savings[row, row + 1 :] = self._savings(row)[row + 1 :]
        while count:
            # Of equal savings the first: the same requests give the same stills in every run.
            lead, other = divmod(int(savings.argmax()), count)
            if savings[lead, other] < _LEAST_SAVING_BYTES:
                return
            self._take_in(lead, other)
            savings[other, :] = savings[:, other] = -np.inf
            fresh = self._savings(lead)
            savings[lead, lead + 1 :] = fresh[lead + 1 :]
            savings[:lead, lead] = fresh[:lead]

    def request(self, members: list[int], requests: Sequence[Request]) -> Request:
        lead, *others = (requests[index] for index in members)
        if not others:
            return lead
        gain = sum(requests[index].score * self.single_bytes[index] for index in members)
        also = tuple(sorted((one.candidate for one in others), key=lambda one: one.track_id))
        return replace(lead, also=also, score=max(lead.score, float(gain / self.bytes[members[0]])))

    def _savings(self, row: int) -> npt.NDArray[np.float64]:
        # (N,) line bytes saved by joining this still with each other one; -inf where that is not allowed.
        low = np.minimum(self.crops[:, :2], self.crops[row, :2])
        high = np.maximum(self.crops[:, 2:], self.crops[row, 2:])
        sides = high - low
        tracks = np.array([len(members) for members in self.members], np.int64)
        together = tracks + tracks[row]
        union = self._line_bytes(sides.prod(axis=1), together)
        savings = np.asarray(self.bytes + self.bytes[row] - union, np.float64)
        savings[(sides.max(axis=1) > MAX_SIDE_PX) | (together > MOST_ALSO + 1) | (tracks == 0)] = -np.inf
        savings[row] = -np.inf
        return savings

    def _line_bytes(
        self, coded_px: npt.NDArray[np.int64], tracks: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.float64]:
        payload = np.maximum(1.0, self.cost.fixed_bytes + self.cost.bytes_per_px * coded_px)
        return np.asarray(payload + self.overhead_bytes + ALSO_BYTES * (tracks - 1), np.float64)

    def _take_in(self, lead: int, other: int) -> None:
        self.crops[lead, :2] = np.minimum(self.crops[lead, :2], self.crops[other, :2])
        self.crops[lead, 2:] = np.maximum(self.crops[lead, 2:], self.crops[other, 2:])
        self.members[lead] += self.members[other]
        self.members[other] = []
        px = self.crops[lead, 2:] - self.crops[lead, :2]
        self.bytes[lead] = self._line_bytes(
            px.prod(keepdims=True), np.array([len(self.members[lead])], np.int64)
        )[0]


def _measured(candidate: Candidate) -> Candidate:
    if candidate.sharpness is None:
        return replace(candidate, loss=None)
    value = candidate.sharpness()
    return replace(candidate, sharpness=lambda: value, loss=None)
