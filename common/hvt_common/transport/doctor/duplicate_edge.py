"""Whether an edge of an id lives on the link: looked for once, before another of that id speaks."""

from __future__ import annotations

import json
import logging
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
from hvt_common.protocol.messages import Info, WireError
from hvt_common.transport.session import ask
from hvt_common.transport.zenoh_config import LinkSettings, configure

__all__ = ["living_edge", "refuse_same_id"]

_log = logging.getLogger(__name__)

_ANSWER_S = 1.0
_WITHIN_S = 2.5
"""For one look: a link that swallows what is sent must not keep an edge on the ground."""
_LEAVING_S = 5.0
"""An edge that says goodbye still answers for so long; its successor is not refused because of it."""
_LOOK_AGAIN_S = 0.5

# A client, because a router or a ground passes nothing on between two peers; and one try, because an edge starts
# without a ground as well as with one.
_LOOKER: Mapping[str, Any] = {
    "mode": "client",
    "listen/endpoints": [],
    "connect/timeout_ms": 0,
    "connect/exit_on_failure": True,
}


def refuse_same_id(settings: LinkSettings, keys: EdgeKeys) -> None:
    """Raise `UserError` where an edge with these keys lives on the link; see `living_edge`."""
    other = living_edge(settings, keys)
    if other is not None:
        raise UserError(
            f"edge id {keys.edge!r} is in use: an edge of that id (session {other.session_id:016x}, version "
            f"{other.software:.32}) answers on this link; stop it, or give this one an --edge-id of its own"
        )


def living_edge(settings: LinkSettings, keys: EdgeKeys) -> Info | None:
    """Return what the living edge with these keys says of itself; None where none is found within a second or two.

    One that is found is looked for again for five seconds: it may be about to leave.

    A token alone is no life: that of a process that was killed stays until the link's lease runs out. So the edge has
    to answer on ``info``. Looked for where ``settings`` connect to; who only listens cannot look. A fleet's access
    control does not let an edge ask, and then none is found: the ground notices.

    Raises:
        UserError: the settings cannot be used.
    """
    found = _look_within(settings, keys)
    until_s = time.monotonic() + _LEAVING_S
    while found is not None and time.monotonic() < until_s:
        time.sleep(_LOOK_AGAIN_S)
        found = _look_within(settings, keys)
    return found


def _look_within(settings: LinkSettings, keys: EdgeKeys) -> Info | None:
    config, _ = configure(replace(settings, listen=()))
    if not json.loads(config.get_json("connect/endpoints")):
        return None
    for path, value in _LOOKER.items():
        config.insert_json5(path, json.dumps(value))
    found: queue.SimpleQueue[Info | None] = queue.SimpleQueue()
    # Zenoh has no time-out of its own for an address that swallows what is sent to it.
    threading.Thread(target=lambda: found.put(_look(config, keys)), name="hvt-same-id", daemon=True).start()
    with suppress(queue.Empty):
        return found.get(timeout=_WITHIN_S)
    return None


def _look(config: zenoh.Config, keys: EdgeKeys) -> Info | None:
    try:
        with zenoh.open(config) as session:
            tokens = session.liveliness().get(keys.key(Channel.ALIVE), timeout=_ANSWER_S)
            if not any(reply.ok is not None for reply in tokens):
                return None
            answer = ask(session, Channel.INFO, keys=keys, question=b"", timeout_s=_ANSWER_S)
            return None if answer is None else Info.parse(answer)
    except (zenoh.ZError, WireError) as error:
        _log.debug("no edge of this id was found: %s", error)
        return None
