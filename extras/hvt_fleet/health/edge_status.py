"""``hvt-edge status``: a row for each thing that is known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.table import Table

from hvt_common.protocol.edge_words import counts_text
from hvt_common.units import SECOND_NS, bitrate_text
from hvt_fleet.health.status_command import StatusCommand


def run(argv: Sequence[str]) -> int:
    """Print it once, or each second; `FlightError` where no edge answers."""
    return StatusCommand("hvt-edge", "edge", "127.0.0.1:9465", _table).run(argv)


def _table(state: dict[str, Any]) -> Table:
    title = f"{state['edge']}: hvt-edge {state['version']}, {state['state']}"
    table = Table(title=title, title_justify="left", show_header=False)
    rows = {
        "link": _link(state["link"], state["at_ns"]),
        "sends": _sends(state),
        "bits": "" if state["total_bps"] is None else _bits(state),
        "stills": _stills(state),
        "frames": _frames(state),
        "takes": _takes(state),
        "store": "" if state["backlog"] is None else _store(state["backlog"]),
        "machine": _machine(state["system"]),
        "does not work": "; ".join(f"{one['part']}: {one['reason']}" for one in state["failed"]),
    }
    for name, text in rows.items():
        if text:
            table.add_row(name, text)
    return table


def _link(link: dict[str, Any], at_ns: int) -> str:
    ground = "a ground listens" if link["ground"] else f"no ground listens {link['trouble'] or ''}".rstrip()
    since = f"for {max(0, at_ns - link['since_ns']) / SECOND_NS:.0f} s"
    carries = "" if link["rate_bps"] is None else f"carries {bitrate_text(link['rate_bps'])}"
    return _listed(f"{ground}, {since}", _known(link["round_trip_ms"], "round trip {:.0f} ms"), carries)


def _sends(state: dict[str, Any]) -> str:
    operating = state["operating"]
    width, height = operating["base_size"]
    video = f"{width}x{height} at {operating['fps']:g} fps"
    return _listed(state["method"], video, operating["preset_says"], state["decisions"]["says"])


def _bits(state: dict[str, Any]) -> str:
    allowed = bitrate_text(state["operating"]["allowed_bps"])
    share = f"{bitrate_text(state['total_bps'])} of {allowed} ({100 * state['budget_share']:.0f} %)"
    return f"{share}: video {bitrate_text(state['base_bps'])}, stills {bitrate_text(state['roi_bps'])}"


def _stills(state: dict[str, Any]) -> str:
    why = counts_text(state["stills_not_sent"], most=3) if state["stills_not_sent"] else ""
    sent = f"{state['stills_sent']} sent, {state['stills_pending']} pending"
    return f"{sent}; not sent: {why}" if why else sent


def _frames(state: dict[str, Any]) -> str:
    frames = state["frames"]
    return _listed(frames["account"]["text"], _known(state["source_silent_s"], "newest {:.1f} s ago"))


def _takes(state: dict[str, Any]) -> str:
    return _listed(
        _known(state["encode_ms"], "{:.1f} ms to code a frame"),
        _known(state["perception_ms"], "{:.1f} ms to analyze one"),
        _known(state["boxes_age_s"], "boxes {:.1f} s behind"),
        _known(state["cores_needed"], "{:.1f} cores"),
        _known(state["cores_free"], "{:.1f} free"),
    )


def _store(backlog: dict[str, Any]) -> str:
    used, limit = backlog["disk_bytes"] / 1e6, backlog["limit_bytes"] / 1e6
    return _listed(
        f"{backlog['stills']} stills",
        f"{backlog['video_s']:.0f} s of video",
        f"{used:.1f} of {limit:.0f} MB",
        "storing now" if backlog["offline"] else "",
    )


def _machine(system: dict[str, Any]) -> str:
    return _listed(
        _known(system["temperature_c"], "{:.0f} °C"), _known(system["wireless_dbm"], "wireless {:.0f} dBm")
    )


def _listed(*said: str) -> str:
    return ", ".join(one for one in said if one)


def _known(value: float | None, form: str) -> str:
    return "" if value is None else form.format(value)
