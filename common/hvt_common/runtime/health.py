"""The door for who answers the programs that watch this one (``--metrics``): an extra, by ``hvt.health``."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Literal, cast

from hvt_common.errors import UserError, needs_extra
from hvt_common.runtime.failures import Failures
from hvt_common.runtime.plug_ins import the_one

_GROUP = "hvt.health"


def health_server(
    side: Literal["edge", "ground"],
    address: str,
    newest: Callable[[], Any],
    *,
    clock: Callable[[], int],
    stuck_s: float,
    failures: Failures,
    lacks: Callable[[Any], str] = lambda _state: "",
) -> AbstractContextManager[object]:
    """What serves a program's ``newest()`` state (None: none yet) at HOST:PORT while the context lasts.

    After ``stuck_s`` without another the program stands still; ``lacks(state)`` says what keeps it from serving
    though it is alive, empty for nothing. Raises `UserError` where the address can never be listened on, or what it
    takes is not installed.
    """
    entry = the_one(_GROUP, side, what="health server", built_in=False)
    if entry is None:
        raise UserError("--metrics is of an extra that is not installed: pip install 'hvt[metrics]'")
    with needs_extra("'hvt[metrics]'"):  # who is not watched needs no Prometheus
        serve = entry.load()
    server = serve(address, newest, clock=clock, stuck_s=stuck_s, failures=failures, lacks=lacks)
    return cast("AbstractContextManager[object]", server)
