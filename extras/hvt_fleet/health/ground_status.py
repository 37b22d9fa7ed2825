"""``hvt-ground status``: a row an edge."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Any

from rich.table import Table

from hvt_common.protocol.edge_words import counts_text
from hvt_common.units import SECOND_NS, bitrate_text
from hvt_fleet.health.status_command import StatusCommand

_COLUMNS = ("edge", "link", "of budget", "delay p95", "picture", "stills", "tracks", "does not work")
_FRESH_S = 3.0
"""A pose comes about once a second: of an older one is said how old it is."""


def run(argv: Sequence[str]) -> int:
    """Print it once, or each second; `FlightError` where no ground answers."""
    return StatusCommand("hvt-ground", "ground", "127.0.0.1:9464", _table).run(argv)


def _table(state: dict[str, Any]) -> Table:
    title = f"hvt-ground {state['version']}, {', '.join(filter(None, (state['member'], state['detector'])))}"
    table = Table(title=title, title_justify="left")
    for name in _COLUMNS:
        table.add_column(name)
    for one in state["edges"]:
        for_s = max(0, (state["at_ns"] - one["link_since_ns"]) / SECOND_NS)
        link = f"{one['link']} for {for_s:.0f} s"
        failed = [*one["failed"], *(one["session"] or {}).get("edge_failed", ())]
        table.add_row(
            one["edge"], link, *_session_cells(one["session"]), "; ".join(f["part"] for f in failed)
        )
    for edge, one in state["elsewhere"].items():
        table.add_row(edge, f"at {one['member']}", *("",) * (len(_COLUMNS) - 2))
    said = [
        f"{one['edge']} is at {_place(one['session']['pose'])}"
        for one in state["edges"]
        if one["session"] and one["session"]["pose"]
    ]
    said += [
        f"{one['edge']}: {one['session']['edge_frames']['text']}"
        for one in state["edges"]
        if one["session"] and one["session"].get("edge_frames")
    ]
    said += ["detector loading"] * state.get("loading", False)
    parts = chain(state["failed"], *(one["failed"] for one in state["edges"]))
    said += [f"{one['part']}: {one['reason']}" for one in parts]
    table.caption = "; ".join(said) or None
    return table


def _place(pose: dict[str, Any]) -> str:
    place = f"{pose['latitude_deg']:.5f}, {pose['longitude_deg']:.5f}"
    return place if pose["age_s"] < _FRESH_S else f"{place} ({pose['age_s']:.0f} s old)"


def _session_cells(session: dict[str, Any] | None) -> tuple[str, ...]:
    if session is None:
        return ("",) * (len(_COLUMNS) - 3)
    rate = "unknown" if session["total_bps"] is None else bitrate_text(session["total_bps"])
    p95, age, why = session["delay_p95_ms"], session["picture_age_s"], session["stills_not_sent"]
    return (
        f"{rate} of {bitrate_text(session['budget_bps'])}",
        "" if p95 is None else f"{p95:.0f} ms",
        "" if age is None else f"{age:.1f} s old",
        f"{session['stills_received']}" + (f" (not sent: {counts_text(why, most=2)})" if why else ""),
        f"{session['tracks']}, {session['tracks_refined']} refined"
        + ", UNKNOWN VIEW" * session.get("view_unlike", False),
    )
