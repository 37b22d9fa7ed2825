"""Every bar of `make bench` in one table, and the row that a measure becomes."""

from __future__ import annotations

from typing import Any, NamedTuple


class Bar(NamedTuple):
    at_most: bool
    limit: float

    def __str__(self) -> str:
        return f"{'<=' if self.at_most else '>='} {self.limit:g}"


def _at_most(limit: float) -> Bar:
    return Bar(at_most=True, limit=limit)


def _at_least(limit: float) -> Bar:
    return Bar(at_most=False, limit=limit)


BARS = {
    "edge at its defaults on the 1080p demo, peak MB": _at_most(350),
    "ground of that edge, peak MB": _at_most(380),
    "M0 on a 720p clip, peak MB of the edge": _at_most(300),
    "M0 on a 720p clip, threads of the edge": _at_most(12),
    "defaults on a 720p clip, peak MB of the edge": _at_most(300),
    "defaults on a 720p clip, threads of the edge": _at_most(12),
    "each further edge at the ground, MB": _at_most(15),
    "each further edge at the ground, threads": _at_most(6),  # five, and some that begin and end
    "capture to overlay p95 over its floor, a core each": _at_most(1.3),
    "capture to overlay p95 over its floor, unpinned": _at_most(1.6),
    "edge, frames a second over its floor's": _at_least(0.95),
    "ground, frames a second over its floor's": _at_least(0.90),
    "a late ground's first picture, in frames": _at_most(15),
    "detector / bare call": _at_most(1.10),
    "50 boxes, time / roboflow trackers": _at_most(0.35),
    "provider / cpu, time": _at_most(1.0),
    "F1 of provider against cpu": _at_least(0.99),
    "hvt-edge imported, processor time over numpy alone": _at_most(3.5),
    "hvt-ground imported, processor time over numpy alone": _at_most(3.5),
    "M0, processor time of the edge over decode and x265 bare": _at_most(1.15),
    "defaults, processor time of the edge over decode and x265 bare": _at_most(1.6),
    "board: frames lost for want of processor time": _at_most(0),
    "board: oldest boxes, s": _at_most(1.5),
    "board: what the doctor's forecast is off by": _at_most(0.2),
}


def measured(measure: str, value: float | None, *, of: str = "") -> dict[str, Any]:
    """One row; ``of`` says which of several it is."""
    bar = BARS.get(measure)
    holds = None
    if bar is not None and value is not None:
        holds = value <= bar.limit if bar.at_most else value >= bar.limit
    return {
        "measure": f"{of}: {measure}" if of else measure,
        "value": value,
        "bar": None if bar is None else str(bar),
        "holds": holds,
    }
