"""The contract of a method: a pure function from the candidates of a step to requests for stills, most useful first.

To add one: a frozen dataclass with its parameters in a file beside this one, and one row in `registry`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

from hvt_edge.stills.policy.cost import CostEstimate

if TYPE_CHECKING:
    from hvt_edge.perception.candidates import Candidate

STILL_OVERHEAD_BYTES = 147.0
"""With the usual names: 56 of header and 83 of framing and TCP for JPEG, 9 more for a residual."""


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
