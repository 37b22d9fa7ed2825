"""``hvt-ground status``: how a ground that runs with ``--metrics`` is, from another shell."""

from __future__ import annotations

import argparse
import json
import time
import urllib.error
import urllib.request
from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from hvt_common.errors import FlightError, Parser
from hvt_common.runtime.reporting import say
from hvt_common.units import SECOND_NS, bitrate_text, counts_text

__all__ = ["DEFAULT_ADDRESS", "run"]

DEFAULT_ADDRESS = "127.0.0.1:9464"
_PATIENCE_S = 5.0
_MOST_BYTES = 16 * 2**20


def run(argv: Sequence[str]) -> int:
    """Print it once, or each second; `FlightError` where no ground answers."""
    arguments = _parser().parse_args(argv)
    address: str = arguments.at
    if not arguments.watch:
        state = _requested(address)
        if arguments.json:
            say(json.dumps(state))
        else:
            Console(highlight=False).print(_table(state))
        return 0
    try:
        if arguments.json:
            while True:
                print(json.dumps(_requested(address)), flush=True)
                time.sleep(1)
        with Live(_table(_requested(address)), refresh_per_second=4) as live:
            while True:
                time.sleep(1)
                live.update(_table(_requested(address)))
    except KeyboardInterrupt:
        return 0


def _requested(address: str) -> dict[str, Any]:
    try:
        with urllib.request.urlopen(f"http://{address}/state.json", timeout=_PATIENCE_S) as answer:
            state: dict[str, Any] = json.loads(answer.read(_MOST_BYTES))
            state["edges"][:0]
    except (OSError, urllib.error.URLError, ValueError, KeyError, TypeError):
        raise FlightError(
            f"no ground answers at {address}: start one with --metrics {address}, or say where it is with --at"
        ) from None
    return state


def _table(state: dict[str, Any]) -> Table:
    table = Table(title=f"hvt-ground {state['version']}, {state['detector']}", title_justify="left")
    for name in ("edge", "link", "of budget", "delay p95", "picture", "stills", "tracks", "does not work"):
        table.add_column(name)
    for one in state["edges"]:
        for_s = max(0, (state["at_ns"] - one["link_since_ns"]) / SECOND_NS)
        link = f"{one['link']} for {for_s:.0f} s"
        failed = [*one["failed"], *(one["session"] or {}).get("edge_failed", ())]
        table.add_row(
            one["edge"], link, *_session_cells(one["session"]), "; ".join(f["part"] for f in failed)
        )
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


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="hvt-ground status", description=__doc__)
    parser.add_argument(
        "--at", default=DEFAULT_ADDRESS, metavar="HOST:PORT", help=f"its --metrics [{DEFAULT_ADDRESS}]"
    )
    parser.add_argument("--watch", action="store_true", help="again each second, until Ctrl-C")
    parser.add_argument("--json", action="store_true", help="the whole state, a line each time")
    return parser
