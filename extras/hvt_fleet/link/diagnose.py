"""Explains why there is no link, and which peer is linked without the rights that it needs.

Zenoh reports neither: a refused connection is retried for ever, a message without permission is dropped. So a thread
checks the links and their peers, and probes the endpoints (`probe`) where there is no link.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Self

import zenoh

from hvt_common.errors import UserError
from hvt_common.protocol.channels import Channel, EdgeKeys, selector
from hvt_common.transport.link_doctor import LinkDoctor, LinkWatch
from hvt_common.transport.zenoh_config import LinkSettings, configure, connect_endpoints, end_of
from hvt_fleet.link.certificate import (
    SOON_S,
    Rights,
    TlsFiles,
    check_own_keys,
    dated,
    refusals,
    shown_to_callers,
)
from hvt_fleet.link.duplicate_edge import refuse_duplicate_edge
from hvt_fleet.link.probe import why_no_link
from hvt_fleet.link.stale_sockets import StaleSockets
from hvt_fleet.link.strangers import Strangers, listening_ports

_log = logging.getLogger(__name__)

_CHECK_S, _STRANGERS_S, _ANSWER_S = 1.0, 0.1, 1.0
PATIENCE_S = 4.0
_FIRST_PAUSE_S, _LAST_PAUSE_S = 10.0, 120.0
"""From one visit to the next: doubled each time, for a visit costs some kilobytes of a link that may be thin."""
_SAY_AGAIN_S = 300.0
_MOST_EVENTS = 1024
_MAX_NAMES = 256
"""Names that are remembered. Each takes a certificate of the CA, so a fleet of that size comes first."""


class Watch(LinkWatch):
    """Watches the links of one session, in a thread of its own; a context manager.

    ``served(name)`` says, in that thread, whether an edge of that name has appeared or a ground subscribes. A link
    slower than ``patience_s`` is explained; ``examine`` gives one sentence for each endpoint that this
    configuration connects to, and may block for seconds.
    """

    def __init__(
        self,
        session: zenoh.Session,
        settings: LinkSettings,
        *,
        served: Callable[[str], bool],
        patience_s: float = PATIENCE_S,
        examine: Callable[[zenoh.Config], list[str]] | None = None,
    ) -> None:
        self._config, listen = configure(settings)
        self._rights = Rights.of(self._config)
        self._session = session
        self._patience_s = patience_s
        self._examine = examine or visit
        self._strangers = Strangers(listening_ports(listen))
        # A link that stood for less than a look was one all the same.
        self._link_events = session.info.declare_link_events_listener(
            zenoh.handlers.RingChannel(_MOST_EVENTS), history=True
        )
        self._file = settings.zenoh_config
        self._edge = settings.name
        self._served = served
        self._shown = shown_to_callers(self._config, listen=listen)
        self._ages = min(1, self._age())
        """How often its age has been told: the start tells of one that ends soon."""
        self._trouble = ""
        self._said_s = 0.0
        self._two_links = _connected_twice(self._config)
        """Places that are called twice."""
        self._had_two: set[str] = set()
        self._halved_s: float | None = None
        """The time since which one link of two has been missing; infinite once that is reported."""
        self._ports = {end_of(one).rpartition(":")[2] for one in connect_endpoints(self._config)}
        self._calls_since_s: float | None = None if settings.role == "ground" else math.inf
        """The time since which a ground has had a link to a peer that it calls; infinite once that is judged."""
        self._first_seen_s: dict[str, float] = {}
        self._named: set[str] = set()
        self._unserved: dict[str, str] = {}
        """Whom nothing came of when that was said, and the sentence that takes it back."""
        self._stop = threading.Event()
        self._using = threading.Lock()
        """Held while the session is used, so that it is not closed meanwhile."""
        self._thread = threading.Thread(target=self._run, name="hvt-link-watch", daemon=True)

    @property
    def trouble(self) -> str:
        return self._trouble

    def may_command(self, edge: str) -> bool:
        return self._rights.may_query(edge, Channel.CONTROL)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        with self._using:
            pass
        # A probe in progress does not use the session and ends by itself within seconds: it is not waited for.
        self._thread.join(0.1)

    # The thread

    def _run(self) -> None:
        next_visit_s, pause_s = time.monotonic() + self._patience_s, _FIRST_PAUSE_S
        next_check_s = 0.0
        while not self._stop.wait(min(_STRANGERS_S, self._patience_s)):
            now_s = time.monotonic()
            self._check_strangers(now_s)
            if now_s < next_check_s:
                continue
            next_check_s = now_s + min(_CHECK_S, self._patience_s)
            self._check_age()
            if self._check(now_s):
                self._trouble = ""
                next_visit_s, pause_s = now_s + self._patience_s, _FIRST_PAUSE_S
            elif now_s >= next_visit_s:
                self._explain()
                next_visit_s, pause_s = time.monotonic() + pause_s, min(2 * pause_s, _LAST_PAUSE_S)

    def _age(self) -> int:
        # Of the certificate that callers see: 1 where it ends soon, 2 where it has ended.
        end_s = math.inf if self._shown is None else self._shown.not_after_s
        return (end_s < time.time() + SOON_S) + (end_s < time.time())

    def _check_age(self) -> None:
        if (age := self._age()) > self._ages and self._shown is not None:
            self._ages = age
            _log.warning(
                "the certificate with which this machine listens %s on %s: %s; make a new one with hvt-ground keys "
                "renew, copy it here and restart",
                "expires" if age == 1 else "expired",
                dated(self._shown.not_after_s),
                "after that nobody can connect" if age == 1 else "nobody can connect any more",
            )

    def _check(self, now_s: float) -> bool:
        with self._using:
            if self._stop.is_set():
                return True
            try:
                links = self._session.info.links()
                served = [name for name in self._unserved if self._served(name)]
                for sentence in dict.fromkeys(self._unserved.pop(name) for name in served):
                    _log.warning("%s", sentence)
                if links:
                    self._check_names(self._names(links), now_s)
                self._check_second_link(links, now_s)
                self._check_called(links, now_s)
            except zenoh.ZError:  # closed elsewhere
                return True
            return bool(links)

    def _check_strangers(self, now_s: float) -> None:
        with self._using:
            if self._stop.is_set():
                return
            try:
                while (event := self._link_events.try_recv()) is not None:
                    self._strangers.note_links(_ends(event.link))
                hosts = self._strangers.check(self._far_ends, now_s)
            except (OSError, zenoh.ZError):  # the session is closed elsewhere
                return
        for host in hosts:
            _log.warning(
                "somebody at %s connects again and again and is refused: it has no certificate of this CA, speaks no "
                "Zenoh, or its link keeps breaking; if it is one of yours, its own log says why "
                "(docs/security.md)",
                host,
            )

    def _far_ends(self) -> list[str]:
        return [end for link in self._session.info.links() for end in _ends(link)]

    def _names(self, links: list[zenoh.Link]) -> dict[str, bool]:
        # Who is at the other end of the links, each with whether it is a router.
        routers = {str(zid) for zid in self._session.info.routers_zid()}
        return {link.auth_identifier: str(link.zid) in routers for link in links if link.auth_identifier}

    def _check_second_link(self, links: list[zenoh.Link], now_s: float) -> None:
        # Zenoh does not reopen one link before all are lost, and says nothing of one that is refused.
        if not self._is_halved(links):
            self._halved_s = None
        elif self._halved_s is None:
            self._halved_s = now_s
        elif now_s - self._halved_s > self._patience_s:
            self._halved_s = math.inf
            _log.warning(
                "one of the two links is missing: answers and pictures share the other; either the other side takes "
                "one only (transport.unicast.max_links, an older HVT or a router), or it was lost on the way and "
                "comes back with the next outage of both"
            )

    def _is_halved(self, links: list[zenoh.Link]) -> bool:
        # One that called us, or that we call by another name than its address, may well have one link only.
        if not self._two_links:
            return False
        standing = Counter(str(link.zid) for link in links)
        twice = {zid for zid, count in standing.items() if count > 1}
        if len(self._had_two) < _MAX_NAMES:
            self._had_two |= twice
        called = {str(link.zid) for link in links if _bare(str(link.dst)) in self._two_links}
        return any(zid in self._had_two | called for zid in standing.keys() - twice)

    def _check_called(self, links: list[zenoh.Link], now_s: float) -> None:
        # A peer that a ground calls is an edge, or a ground, whose edges it never sees. A router serves any name.
        if self._calls_since_s == math.inf:
            return
        routers = {str(zid) for zid in self._session.info.routers_zid()}
        called = [
            str(link.dst)
            for link in links
            if str(link.zid) not in routers and end_of(link.dst).rpartition(":")[2] in self._ports
        ]
        if not called or self._calls_since_s is None:
            self._calls_since_s = now_s if called else self._calls_since_s
        elif now_s - self._calls_since_s > self._patience_s:
            self._calls_since_s = math.inf
            replies = self._session.liveliness().get(selector(Channel.ALIVE), timeout=_ANSWER_S)
            if not self._served("") and all(one.ok is None for one in replies):
                self._unserved[""] = "an edge is seen now, there or elsewhere"
                _log.warning(
                    "linked to %s, but no edge is seen there: if another ground listens there, it passes nothing on; "
                    "connect to the edge itself, or both grounds to a router (docs/deployment.md)",
                    _bare(called[0]),
                )

    def _explain(self) -> None:
        reasons = self._examine(self._config)
        if not reasons or self._check(time.monotonic()):  # it came meanwhile, or this ends
            return
        trouble = "; ".join(reasons)
        now_s = time.monotonic()
        if trouble != self._trouble or now_s - self._said_s > _SAY_AGAIN_S:
            self._said_s = now_s
            _log.warning("no link: %s", trouble)
        self._trouble = trouble

    def _check_names(self, names: dict[str, bool], now_s: float) -> None:
        if not self._rights.enabled:
            return
        for name, router in names.items():
            if name in self._named or len(self._first_seen_s) >= _MAX_NAMES:
                continue
            since_s = self._first_seen_s.setdefault(name, now_s)
            if not self._rights.knows(name):
                sentence = self._stranger(name)
            elif now_s - since_s > self._patience_s and not router and self._is_hiding(name):
                sentence = self._hidden(name)
                self._unserved[name] = f"{name} and this ground hear each other now"
                if self._edge is not None:  # Zenoh does not say whose subscription it is
                    self._unserved[name] = f"a ground hears {self._edge} now: {name!r} or another"
            else:
                continue
            self._named.add(name)
            _log.warning("%s", sentence)

    def _is_hiding(self, name: str) -> bool:
        if self._edge is None and not self._writes(name):
            return False  # another ground, or a router
        return not self._served(name)

    def _writes(self, name: str) -> bool:
        try:
            key = EdgeKeys(name)[Channel.STATUS]
        except UserError:
            return False
        return self._rights.allow(name, flow="ingress", message="put", key=key)

    def _stranger(self, name: str) -> str:
        kind = "add-ground" if self._edge else "add-edge or add-ground"
        mend = f"hvt-ground keys {kind} {name}, then copy the file here again"
        lost = "it gets no picture and no answer from here" if self._edge else "what it sends is dropped"
        return f"{name!r} has a certificate of this CA, but {self._file} does not name it: {lost} ({mend})"

    def _hidden(self, name: str) -> str:
        if self._edge is not None:
            return (
                f"{name!r} is linked, but listens to nothing of {self._edge}: its Zenoh configuration does not name "
                f"{self._edge} (hvt-ground keys add-edge {self._edge}, then copy {name}.json5 to it), or its --edges "
                "leaves it out"
            )
        return (
            f"{name!r} is linked, but nothing of edge {name} is seen here: its Zenoh configuration does not name "
            f"this ground (hvt-ground keys add-ground, then copy {name}.json5 to it), or it runs under another id "
            "than its certificate says, and all it sends is dropped"
        )


def visit(config: zenoh.Config) -> list[str]:
    """One sentence for each endpoint that this configuration connects to. Blocks for some seconds an endpoint."""
    try:
        files = TlsFiles.of(config)
        return [
            why_no_link(endpoint, files) for endpoint in dict.fromkeys(map(_bare, connect_endpoints(config)))
        ]
    except UserError as error:
        return [str(error)]


def _sharer() -> Callable[..., AbstractContextManager[Any]]:
    from hvt_fleet.link.group import GroundGroup  # noqa: PLC0415 - which imports the ground, and an edge has none

    return GroundGroup


class Doctor(LinkDoctor):
    """The one of this extra."""

    check_keys = staticmethod(check_own_keys)
    check_id = staticmethod(refuse_duplicate_edge)
    refusals = staticmethod(refusals)
    sharer = staticmethod(_sharer)
    why_no_link = staticmethod(visit)
    watch = staticmethod(Watch)
    mend = staticmethod(StaleSockets)


def _connected_twice(config: zenoh.Config) -> set[str]:
    places = Counter(map(_bare, connect_endpoints(config)))
    return {place for place, count in places.items() if count > 1}


def _ends(link: zenoh.Link) -> list[str]:
    return [end_of(end) for end in (link.src, link.dst)]


def _bare(endpoint: str) -> str:
    # Two links to one place by priority are one place.
    return endpoint.partition("#")[0].partition("?")[0]
