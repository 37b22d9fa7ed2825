"""Whether the other side is there, without saying anything to it: for a checkup before a flight."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import zenoh

from hvt_common.runtime.reporting import Finding
from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import LinkSettings, configure
from hvt_fleet.link.diagnose import visit

_PATIENCE_S = 3.0
_SAMPLE_S = 0.1


def check_link(settings: LinkSettings, find_peer: Callable[[zenoh.Session], str], *, other: str) -> Finding:
    """Open the link for some seconds. ``find_peer`` says who of the ``other`` side is there; empty while nobody is.

    Raises `UserError` for endpoints, keys and ports that cannot be used.
    """
    with open_session(settings) as session:
        for _ in _until(_PATIENCE_S):
            found = find_peer(session)
            if found:
                return Finding("ok", found)
        linked = bool(session.info.links())
    if linked:
        return Finding("warning", f"there is a link, and no {other} on it", f"start the {other}")
    config, listen = configure(settings)
    explained = visit(config)
    if explained:
        return Finding("warning", "; ".join(explained), f"start the {other}, or mend what stands there")
    where = ", ".join(listen) or "nothing"
    return Finding(
        "warning", f"listens on {where}; no {other} came within {_PATIENCE_S:.0f} s", f"start the {other}"
    )


def _until(seconds: float) -> Iterator[None]:
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        yield
        time.sleep(_SAMPLE_S)
