"""M0: video only, the paper's baseline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from hvt_edge.perception.candidates import Candidate
from hvt_edge.stills.policy.base import Request, Step

__all__ = ["VideoOnly"]


@dataclass(frozen=True, slots=True)
class VideoOnly:
    """No stills; the whole budget may go to the base stream."""

    name: str = field(default="M0", init=False)
    video_only: bool = field(default=True, init=False)

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:  # noqa: ARG002
        """Never anything."""
        return []
