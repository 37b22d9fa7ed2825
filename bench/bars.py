"""Every bar of `make bench` in one table, and the row that a measure becomes."""

from typing import Any

from lab.link.measures.rows import holds

BARS = {
    "edge at its defaults on the 1080p demo, peak MB": "<= 350",
    "ground of that edge, peak MB": "<= 380",
    "M0 on a 720p clip, peak MB of the edge": "<= 300",
    "M0 on a 720p clip, threads of the edge": "<= 12",
    "defaults on a 720p clip, peak MB of the edge": "<= 300",
    "defaults on a 720p clip, threads of the edge": "<= 12",
    "each further edge at the ground, MB": "<= 15",
    "each further edge at the ground, threads": "<= 6",  # five, and some that begin and end
    "capture to overlay p95 over its floor, a core each": "<= 1.3",
    "capture to overlay p95 over its floor, unpinned": "<= 1.6",
    "edge, frames a second over its floor's": ">= 0.95",
    "ground, frames a second over its floor's": ">= 0.90",
    "a late ground's first picture, in frames": "<= 15",
    "detector / bare call": "<= 1.10",
    "50 boxes, time / roboflow trackers": "<= 0.35",
    "provider / cpu, time": "<= 1.0",
    "F1 of provider against cpu": ">= 0.99",
    "hvt-edge imported, processor time over numpy alone": "<= 3.5",
    "hvt-ground imported, processor time over numpy alone": "<= 3.5",
    "M0, processor time of the edge over decode and x265 bare": "<= 1.15",
    "defaults, processor time of the edge over decode and x265 bare": "<= 1.6",
    "board: frames lost for want of processor time": "<= 0",
    "board: oldest boxes, s": "<= 1.5",
    "board: what the doctor's forecast is off by": "<= 0.2",
}


def measured(measure: str, value: float | None, *, of: str = "") -> dict[str, Any]:
    """One row; ``of`` says which of several it is."""
    bar = BARS.get(measure)
    said = None if bar is None or value is None else holds(value, bar)
    return {"measure": f"{of}: {measure}" if of else measure, "value": value, "bar": bar, "holds": said}
