"""A wish that waits for room must not keep frames: what is measured on them is measured at once."""

from __future__ import annotations

from dataclasses import replace

from hvt_edge.perception.candidates import Candidate
from hvt_edge.stills.policy.base import Request

__all__ = ["without_frame"]


def without_frame(request: Request) -> Request:
    """The same request, with what is measured on the frame measured now."""
    return replace(
        request,
        candidate=_measured(request.candidate),
        also=tuple(_measured(one) for one in request.also),
    )


def _measured(candidate: Candidate) -> Candidate:
    if candidate.sharpness is None:
        return replace(candidate, loss=None)
    value = candidate.sharpness()
    return replace(candidate, sharpness=lambda: value, loss=None)
