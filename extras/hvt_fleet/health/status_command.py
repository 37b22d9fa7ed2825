"""``status``: how a program that runs with ``--metrics`` is, from another shell."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from http import HTTPStatus
from http.client import HTTPConnection, HTTPException
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from hvt_common.errors import FlightError, Parser
from hvt_common.runtime.host_names import host_and_port
from hvt_common.units import shown_text

_PATIENCE_S = 5.0
_MOST_BYTES = 16 * 2**20
_MOST_WORD = 200
_REFUSALS = (HTTPStatus.FORBIDDEN, HTTPStatus.SERVICE_UNAVAILABLE)
"""Asked by a name that is not its own; or it stands still, or has not begun."""


@dataclass(frozen=True, slots=True)
class StatusCommand:
    """``PROGRAM status``: prints the state as ``table`` makes it, which raises where it is another program's."""

    program: str
    what: str
    """The kind of program, for people."""
    address: str
    """The default address."""
    table: Callable[[dict[str, Any]], Table]

    def run(self, argv: Sequence[str]) -> int:
        """Print it once, or each second; `FlightError` where none answers, `UserError` where none can."""
        arguments = self._parser().parse_args(argv)
        address: str = arguments.at
        console = Console(highlight=False, markup=False)  # an address or a device may have brackets in it
        if not arguments.watch:
            state, table = self._requested(address)
            if arguments.json:
                print(json.dumps(state))
            else:
                console.print(table)
            return 0
        try:
            if arguments.json:
                while True:
                    print(json.dumps(self._requested(address)[0]), flush=True)
                    time.sleep(1)
            with Live(self._requested(address)[1], console=console, refresh_per_second=4) as live:
                while True:
                    time.sleep(1)
                    live.update(self._requested(address)[1])
        except KeyboardInterrupt:
            return 0

    def _requested(self, address: str) -> tuple[dict[str, Any], Table]:
        host, port = host_and_port(address, name="--at", example=self.address)
        try:
            # The program itself, whatever proxy the environment names for web sites.
            with closing(HTTPConnection(host, port, timeout=_PATIENCE_S)) as connection:
                connection.request("GET", "/state.json")
                answer = connection.getresponse()
                data = answer.read(_MOST_BYTES)
            if answer.status in _REFUSALS:
                word = shown_text(data[:_MOST_WORD].decode(errors="replace").strip())
                raise FlightError(f"what answers at {address} says: {word}")
            state: dict[str, Any] = json.loads(data)
            return state, self.table(state)
        except (OSError, HTTPException, ValueError, RecursionError, KeyError, TypeError, AttributeError):
            raise FlightError(
                f"no {self.what} answers at {address}: start one with --metrics {address}, or say where it is with "
                "--at"
            ) from None

    def _parser(self) -> argparse.ArgumentParser:
        parser = Parser(prog=f"{self.program} status", description=__doc__)
        parser.add_argument(
            "--at", default=self.address, metavar="HOST:PORT", help=f"its --metrics [{self.address}]"
        )
        parser.add_argument("--watch", action="store_true", help="again each second, until Ctrl-C")
        parser.add_argument("--json", action="store_true", help="the whole state, a line each time")
        return parser
