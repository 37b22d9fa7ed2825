"""Finds out, before an edge starts, whether another edge of its id is alive on the link."""

from __future__ import annotations

import json
import queue
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

import zenoh

from hvt_common.errors import UserError
from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.protocol.messages import READ_VERSIONS, Info, WireError
from hvt_common.transport.session import query
from hvt_common.transport.zenoh_config import LinkSettings, configure, connect_endpoints

_ANSWER_S = 1.0
_ATTEMPT_S = 2.5
"""Limit of one attempt: a link that drops everything must not keep an edge from starting."""
LEAVING_S = 5.0
"""An edge that is shutting down may still answer for this long; its successor is not refused because of it."""
_PAUSE_S = 0.5

# A client, because a router or a ground passes nothing on between two peers; and one attempt to connect, because an
# edge starts without a ground as well as with one.
_CONFIG: Mapping[str, Any] = {
    "mode": "client",
    "listen/endpoints": [],
    "connect/timeout_ms": 0,
    "connect/exit_on_failure": True,
}


def refuse_duplicate_edge(settings: LinkSettings, keys: EdgeKeys) -> None:
    """Raise `UserError` where an edge with these keys lives on the link; see `living_edge`."""
    other = living_edge(settings, keys)
    if other is not None:
        raise UserError(
            f"edge id {keys.edge!r} is in use: an edge of that id (session {other.session_id:08x}, version "
            f"{other.software:.32}) answers on this link; stop it, or give this one an --edge-id of its own"
        )


def living_edge(settings: LinkSettings, keys: EdgeKeys, *, patience: float = 1.0) -> Info | None:
    """Return the `Info` of the living edge with these keys; None where none is found within a second or two.

    One that is found is queried again for five seconds: it may be about to leave. A liveliness token alone is
    no proof: that of a killed process stays until the link's lease runs out, so the edge has to answer on
    ``info``. Searched where ``settings`` connect to; an edge that only listens cannot search. A fleet's
    access control does not let an edge query, and then none is found: the ground notices. ``patience``
    multiplies all time limits. Raises `UserError` where the settings cannot be used.
    """
    found = _attempt(settings, keys, patience)
    until_s = time.monotonic() + patience * LEAVING_S
    while found is not None and time.monotonic() < until_s:
        time.sleep(_PAUSE_S)
        found = _attempt(settings, keys, patience)
    return found


def _attempt(settings: LinkSettings, keys: EdgeKeys, patience: float) -> Info | None:
    config, _ = configure(replace(settings, listen=()))
    if not connect_endpoints(config):
        return None
    for path, value in _CONFIG.items():
        config.insert_json5(path, json.dumps(value))
    found: queue.SimpleQueue[Info | None] = queue.SimpleQueue()
    # Zenoh has no time-out of its own for an address that drops all packets.
    threading.Thread(
        target=lambda: found.put(_info(config, keys, answer_s=patience * _ANSWER_S)),
        name="hvt-duplicate-edge",
        daemon=True,
    ).start()
    with suppress(queue.Empty):
        return found.get(timeout=patience * _ATTEMPT_S)
    return None


def _info(config: zenoh.Config, keys: EdgeKeys, *, answer_s: float) -> Info | None:
    try:
        with zenoh.open(config) as session:
            tokens = session.liveliness().get(keys[Channel.ALIVE], timeout=answer_s)
            if not any(reply.ok is not None for reply in tokens):
                return None
            answers = query(session, Channel.INFO, keys=keys, question=b"", timeout_s=answer_s)
            return Info.parse(answers[0], versions=READ_VERSIONS) if answers else None
    except (zenoh.ZError, WireError):
        return None
