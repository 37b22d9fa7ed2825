"""``hvt-edge status``: a row for each thing that is known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from rich.table import Table

from hvt_common.runtime.status_command import StatusCommand
from hvt_common.units import SECOND_NS, bitrate_text, counts_text

__all__ = ["run"]


def run(argv: Sequence[str]) -> int:
    """Print it once, or each second; `FlightError` where no edge answers."""
    return StatusCommand("hvt-edge", "edge", "127.0.0.1:9465", _table).run(argv)


def _table(state: dict[str, Any]) -> Table:
    title = f"{state['edge']}: hvt-edge {state['version']}, {state['state']}"
    table = Table(title=title, title_justify="left", show_header=False)
    for name, text in _rows(state):
        if text:
            table.add_row(name, text)
    return table


def _rows(state: dict[str, Any]) -> Iterator[tuple[str, str]]:
    point, frames, link, backlog = state["operating"], state["frames"], state["link"], state["backlog"]
    since_s = max(0, state["at_ns"] - link["since_ns"]) / SECOND_NS
    ground = "a ground listens" if link["ground"] else f"no ground listens {link['trouble'] or ''}".rstrip()
    yield (
        "link",
        f"{ground}, for {since_s:.0f} s"
        + _said(link["round_trip_ms"], ", round trip {:.0f} ms")
        + ("" if link["rate_bps"] is None else f", carries {bitrate_text(link['rate_bps'])}"),
    )
    width, height = point["base_size"]
    yield (
        "sends",
        f"{state['method']}, {width}x{height} at {point['fps']:g} fps, {state['levers']['says']}".rstrip(
            ", "
        ),
    )
    if state["total_bps"] is not None:
        yield (
            "bits",
            f"{bitrate_text(state['total_bps'])} of {bitrate_text(point['allowed_bps'])} "
            f"({100 * state['budget_share']:.0f} %): video {bitrate_text(state['base_bps'])}, "
            f"stills {bitrate_text(state['roi_bps'])}",
        )
    yield (
        "stills",
        f"{state['stills_sent']} sent, {state['stills_pending']} pending"
        + (
            f"; not sent: {counts_text(state['stills_not_sent'], most=3)}" if state["stills_not_sent"] else ""
        ),
    )
    yield (
        "frames",
        f"{frames['captured']} captured, {frames['encoded']} coded; dropped {frames['dropped_link']} for the link, "
        f"{frames['dropped_cpu']} for want of CPU" + _said(state["source_silent_s"], "; newest {:.1f} s ago"),
    )
    yield (
        "takes",
        _said(state["encode_ms"], "{:.1f} ms to code a frame")
        + _said(state["perception_ms"], ", {:.1f} ms to analyze one")
        + _said(state["cores_needed"], "; {:.1f} cores")
        + _said(state["cores_free"], ", {:.1f} free"),
    )
    if backlog is not None:
        yield (
            "store",
            f"{backlog['stills']} stills, {backlog['video_s']:.0f} s of video, {backlog['disk_bytes'] / 1e6:.1f} of "
            f"{backlog['limit_bytes'] / 1e6:.0f} MB{', storing now' if backlog['offline'] else ''}",
        )
    system = state["system"]
    yield (
        "machine",
        ", ".join(
            filter(
                None,
                (
                    _said(system["temperature_c"], "{:.0f} °C"),
                    _said(system["wireless_dbm"], "wireless {:.0f} dBm"),
                ),
            )
        ),
    )
    yield "does not work", "; ".join(f"{one['part']}: {one['reason']}" for one in state["failed"])


def _said(value: float | None, form: str) -> str:
    return "" if value is None else form.format(value)
