"""What a run knows of its stills: when each was cut and came, and what it did to which track."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class StillArrival:
    """One still at the ground. Times are media time, from the first frame's capture."""

    sequence: int
    """Of the edge; names the still."""
    capture_s: float
    """Capture of the frame that it was cut from."""
    sent_s: float
    """When it was handed to the link."""
    arrived_s: float
    """When its last bit was there."""
    size_bytes: int
    """Payload."""
    line_bytes: int
    """With header and transport."""
    reason: str
    """Why the edge's method sent it."""


@dataclass(frozen=True, slots=True)
class Opinion:
    """What a model says of one crop."""

    class_name: str
    confidence: float
    """Of ``class_name``, 0…1."""
    entropy_nats: float
    """Of the whole posterior."""


@dataclass(frozen=True, slots=True)
class RefinedObject:
    """One object in a still, and what the ground made of it; a still that shows several has one of these for each."""

    still_sequence: int
    track_id: int
    """The ground's; `contract.NO_ID` where no track matched."""
    at_s: float
    """Media time at which the ground knew."""
    name_before: str
    """Shown for the track until then."""
    name_after: str
    area_share: float
    """Of the object's box, of the base frame's area, 0…1."""
    base: Opinion | None = None
    """Of the object as the decoded base shows it; None where that was not asked or gave no answer."""
    still: Opinion | None = None
    """Of the object as the still shows it, by the same model."""


def still_delays_ms(stills: Sequence[StillArrival]) -> tuple[float, float]:
    """(median, 95th percentile) from the capture of a still's frame to its arrival; NaN without stills."""
    if not stills:
        return math.nan, math.nan
    p50, p95 = np.percentile([1e3 * (one.arrived_s - one.capture_s) for one in stills], (50, 95)).tolist()
    return p50, p95
