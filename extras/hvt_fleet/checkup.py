"""A checkup: one check after the other, each bounded in time; one that fails keeps no other from its answer."""

from __future__ import annotations

import ctypes
import json
import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace

import zenoh
from rich.console import Console
from rich.table import Table
from rich.text import Text

from hvt_common.errors import UserError
from hvt_common.runtime.host_names import check_port
from hvt_common.runtime.reporting import Finding
from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import LinkSettings, configure
from hvt_fleet.link.diagnose import visit

_STYLES: Mapping[str, str] = {"ok": "green", "unknown": "cyan", "warning": "yellow", "wrong": "bold red"}

_PATIENCE_S = 30.0
_TIME_ERROR = 5
"""adjtimex(2): the clock is not synchronised."""
_TIMEX_BYTES = 512
"""More than ``struct timex`` has anywhere; with ``modes`` 0 the call changes nothing."""


def run_checks(
    checks: Mapping[str, Callable[[], Finding]], *, patience_s: float = _PATIENCE_S
) -> dict[str, Finding]:
    """Each in turn, by name. A `UserError` is a fault; a check without an end is left behind.

    The log of a check belongs to its finding: a warning turns ``ok`` into ``warning``.
    """
    return {name: _bounded(check, patience_s) for name, check in checks.items()}


def print_findings(title: str, findings: Mapping[str, Finding], *, as_json: bool) -> int:
    """Show them, and the remedies at the end. Returns the exit code: 2 if something is wrong."""
    if as_json:
        print(json.dumps([{"check": name, **asdict(one)} for name, one in findings.items()]))
    else:
        table = Table.grid(padding=(0, 2))
        for name, one in findings.items():
            table.add_row(Text(one.state, _STYLES[one.state]), Text(name), Text(one.found))
        console = Console(highlight=False)
        console.print(Text(title, "bold"), table, sep="\n")
        todo = Table.grid(padding=(0, 2))
        for name, one in findings.items():
            if one.todo:
                todo.add_row(Text(name, _STYLES[one.state]), Text(one.todo))
        if todo.row_count:
            console.print("", Text("What to do:", "bold"), todo, sep="\n")
    return 2 if any(one.state == "wrong" for one in findings.values()) else 0


def check_clock() -> Finding:
    """Whether the system keeps its clock by others: delays are differences of two clocks."""
    try:
        state = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES))
    except (OSError, AttributeError):
        state = -1
    if state < 0:
        return Finding("unknown", "this system does not say whether its clock is synchronised")
    if state == _TIME_ERROR:
        return Finding(
            "warning",
            "the clock is not synchronised",
            "start a time service such as systemd-timesyncd or chrony: certificates and recordings depend on it",
        )
    return Finding("ok", "the clock is synchronised")


def check_metrics(address: str | None) -> Finding:
    """Whether ``--metrics`` could be served."""
    if address is None:
        return Finding("ok", "no --metrics")
    check_port(address, name="--metrics", packages=["prometheus_client"])
    return Finding("ok", f"{address} is free for --metrics")


def _bounded(check: Callable[[], Finding], patience_s: float) -> Finding:
    found: list[Finding] = []

    def run() -> None:
        said = _Said(threading.get_ident())
        logger = logging.getLogger()
        logger.addHandler(said)
        try:
            found.append(said.within(check()))
        except UserError as error:
            what, _, todo = str(error).rpartition(": ")
            named_only = " " not in what  # the sentence tells what is wrong behind the colon
            found.append(Finding("wrong", str(error) if named_only else what, todo))
        except Exception as error:  # noqa: BLE001 - the others are checked all the same
            found.append(
                Finding("wrong", f"{type(error).__name__}: {error}", "report it: this should not happen")
            )
        finally:
            logger.removeHandler(said)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(patience_s)
    if found:
        return found[0]
    return Finding(
        "wrong", f"no answer within {patience_s:g} s", "see whether the device or the disk works at all"
    )


class _Said(logging.Handler):
    def __init__(self, thread: int) -> None:
        super().__init__(logging.INFO)
        self._thread = thread
        self._warnings: list[str] = []
        self._facts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self._thread:
            which = self._facts if record.levelno < logging.WARNING else self._warnings
            which.append(record.getMessage())

    def within(self, finding: Finding) -> Finding:
        finding = replace(finding, found="; ".join([finding.found, *self._facts]))
        if not self._warnings or finding.state not in ("ok", "unknown"):
            return finding
        return replace(finding, state="warning", todo="; ".join(self._warnings))


_PEER_S = 3.0
_SAMPLE_S = 0.1


def check_link(settings: LinkSettings, find_peer: Callable[[zenoh.Session], str], *, other: str) -> Finding:
    """Open the link for some seconds. ``find_peer`` says who of the ``other`` side is there; empty while nobody is.

    Raises `UserError` for endpoints, keys and ports that cannot be used.
    """
    with open_session(settings) as session:
        end_s = time.monotonic() + _PEER_S
        while time.monotonic() < end_s:
            if found := find_peer(session):
                return Finding("ok", found)
            time.sleep(_SAMPLE_S)
        linked = bool(session.info.links())
    if linked:
        return Finding("warning", f"there is a link, and no {other} on it", f"start the {other}")
    config, listen = configure(settings)
    explained = visit(config)
    if explained:
        return Finding("warning", "; ".join(explained), f"start the {other}, or mend what stands there")
    where = ", ".join(listen) or "nothing"
    return Finding(
        "warning", f"listens on {where}; no {other} came within {_PEER_S:.0f} s", f"start the {other}"
    )
