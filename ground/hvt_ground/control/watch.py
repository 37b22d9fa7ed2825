"""``hvt-ground status``: a row an edge."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.table import Table

from hvt_common.runtime.status_command import StatusCommand
from hvt_common.units import SECOND_NS, bitrate_text, counts_text

__all__ = ["run"]


def run(argv: Sequence[str]) -> int:
    """Print it once, or each second; `FlightError` where no ground answers."""
    return StatusCommand("hvt-ground", "ground", "127.0.0.1:9464", _table).run(argv)


def _table(state: dict[str, Any]) -> Table:
    title = f"hvt-ground {state['version']}, {', '.join(filter(None, (state['member'], state['detector'])))}"
    table = Table(title=title, title_justify="left")
    for name in ("edge", "link", "of budget", "delay p95", "picture", "stills", "tracks", "does not work"):
        table.add_column(name)
    for one in state["edges"]:
        for_s = max(0, (state["at_ns"] - one["link_since_ns"]) / SECOND_NS)
        link = f"{one['link']} for {for_s:.0f} s"
        failed = [*one["failed"], *(one["session"] or {}).get("edge_failed", ())]
        table.add_row(
            one["edge"], link, *_session_cells(one["session"]), "; ".join(f["part"] for f in failed)
        )
    for edge, one in state["elsewhere"].items():
        table.add_row(edge, f"at {one['member']}", *("",) * 6)
    table.caption = "; ".join(f"{one['part']}: {one['reason']}" for one in state["failed"]) or None
    return table


def _session_cells(session: dict[str, Any] | None) -> tuple[str, ...]:
    if session is None:
        return ("",) * 5
    rate = "no bits" if session["total_bps"] is None else bitrate_text(session["total_bps"])
    p95, age, why = session["delay_p95_ms"], session["picture_age_s"], session["stills_not_sent"]
    return (
        f"{rate} of {bitrate_text(session['budget_bps'])}",
        "" if p95 is None else f"{p95:.0f} ms",
        "" if age is None else f"{age:.1f} s old",
        f"{session['stills_received']}" + (f" (not sent: {counts_text(why, most=2)})" if why else ""),
        f"{session['tracks']}, {session['tracks_refined']} refined",
    )
