"""Delay over a serial link of B_tot, by simulation (`hvt_study.flights.serial_link`): capture to arrival."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from hvt_study.flights.serial_link import LinkReport, SerialLink
from hvt_study.metrics.stills import StillArrival

__all__ = ["DelayScore", "Sent", "delay_score", "simulated"]


@dataclass(frozen=True, slots=True)
class Sent:
    """One message as it is handed to the link."""

    capture_ns: int
    """Of the frame that it carries, or was cut from."""
    enter_ns: int
    """When it is handed over; not before ``capture_ns``."""
    size_bytes: int
    """Line bytes."""
    urgent: bool
    """Of the base stream, which goes before everything that waits."""


@dataclass(frozen=True, slots=True)
class DelayScore:
    """Of one run."""

    base_p50_ms: float
    """Capture to arrival of the base frames that were sent; NaN without any."""
    base_p95_ms: float
    still_p50_ms: float
    """Capture of the frame that a still was cut from to its arrival; NaN without stills."""
    still_p95_ms: float
    worst_queue_bytes: int
    """The most that was handed over and had not arrived, of everything."""


def delay_score(base: LinkReport, stills: Sequence[StillArrival]) -> DelayScore:
    """Of a flight: the link's report of its base stream (``FlightReport.link``) and its stills as they came."""
    p50, p95 = _percentiles([1e3 * (one.arrived_s - one.cut_s) for one in stills])
    return DelayScore(base.delay_p50_ms, base.delay_p95_ms, p50, p95, base.worst_queue_bytes)


def simulated(messages: Iterable[Sent], *, rate_bps: float) -> DelayScore:
    """Of anything that was not flown: send ``messages`` over a serial link of ``rate_bps`` line bits a second.

    Raises:
        ValueError: the rate is not above 0.
    """
    link: SerialLink[Sent] = SerialLink(rate_bps=rate_bps)
    for one in messages:
        link.put(one, size_bytes=one.size_bytes, enter_ns=one.enter_ns, urgent=one.urgent)
    arrivals = link.arrived(None)
    delays: dict[bool, list[int]] = {True: [], False: []}
    for arrival in arrivals:
        delays[arrival.urgent].append(arrival.arrival_ns - arrival.message.capture_ns)
    base = _percentiles([delay / 1e6 for delay in delays[True]])
    stills = _percentiles([delay / 1e6 for delay in delays[False]])
    return DelayScore(*base, *stills, LinkReport.of((), arrivals).worst_queue_bytes)


def _percentiles(delays_ms: Sequence[float]) -> tuple[float, float]:
    if not delays_ms:
        return math.nan, math.nan
    p50, p95 = np.percentile(delays_ms, (50, 95)).tolist()
    return p50, p95
