"""The ground's end of the link: its subscriptions, sorted by edge. Knows Zenoh; knows nothing of frames.

Grounds may share a fleet as a group: each edge is served by one of them, and by another once that one is gone.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Protocol, Self

import zenoh

from hvt_common.protocol.channels import Channel, EdgeKeys, matches, parse_key, selector
from hvt_common.runtime.clock import SteadyClock
from hvt_common.runtime.failures import RetryPause, reason_of
from hvt_common.transport.inbox import Received
from hvt_common.transport.session import another_key, subscribe
from hvt_common.units import SECOND_NS
from hvt_ground.perception.stills.decode import readable_codecs
from hvt_ground.session.edge_port import EdgePort


@dataclass(frozen=True, slots=True)
class Elsewhere:
    """The member that serves an edge instead of this one."""

    member: str
    page: str
    """The address of its page for browsers; empty where it has none, or has not said."""


class Group(Protocol):
    """This ground as a member."""

    member: str

    @property
    def elsewhere(self) -> Mapping[str, Elsewhere]:
        """The other member that serves each edge."""

    def serves(self, edge: str) -> bool:
        """Whether the edge is to be served here now; claims it where it is this member's."""

    def release(self, edge: str) -> None:
        """It is not served here any more, and may be elsewhere; unless it is this member's again."""

    def forget(self, *, except_for: Iterable[str]) -> None:
        """Withdraw claims of edges that are gone."""


_log = logging.getLogger(__name__)

MAX_EDGES = 64
"""More edge ids than this are not served: each costs a thread, and ids cost a sender nothing. One that shows its
token takes the place of one that has neither a token nor a session; one that sends, too, of one that never has."""
_MOST_ALIVE = 16384
"""Tokens that are remembered, of edges of all members of a group together."""
_QUIET_NS, _MOST_QUIET_NS = 2 * SECOND_NS, 64 * SECOND_NS
"""A present edge reports within this time; the longest pause before a channel on which nothing comes is subscribed to
again."""
_SUBSCRIBED = (*(Channel.BASE, Channel.ROI, Channel.TRACKS), *(Channel.POSE, Channel.BACKLOG, Channel.STATUS))


class GroundLink:
    """Sorts messages by edge. `ports` grows as edges appear that the pattern ``edges`` accepts.

    With a ``group`` only the edges that are this member's are subscribed to, and a port goes when its edge moves.
    ``log`` gets all that comes from an edge, in Zenoh's callbacks. ``still_codecs`` are those that edges are told to
    send; without it all that are installed here. ``loses``: whether a subscription may be lost on its way now.
    """

    def __init__(
        self,
        session: zenoh.Session,
        *,
        edges: str,
        clock: Callable[[], int] | None = None,
        group: Group | None = None,
        log: Callable[[Received], None] | None = None,
        still_codecs: tuple[str, ...] | None = None,
        loses: Callable[[], bool] = lambda: False,
    ) -> None:
        self._session = session
        self._loses = loses
        self._still_codecs = readable_codecs() if still_codecs is None else still_codecs
        self._group = group
        self._log = log
        self._alive: set[str] = set()
        """Edges that show their token, also those that others serve, or that found no place."""
        self._subscribers: dict[str, dict[Channel, list[zenoh.Subscriber[None]]]] = {}
        """Subscriptions by edge: all with a group, else those of channels that it may not know by the general ones.
        The newest counts; an edge may know no other than the one before."""
        self._newest: dict[tuple[str, Channel], int] = {}
        """The number of the newest."""
        self._leaving: set[str] = set()
        """Edges whose last session here is being closed; with a group."""
        self._clock = clock or SteadyClock()
        self._edges = edges
        self._lock = threading.Lock()
        self._ports: dict[str, EdgePort] = {}
        self.foreign = 0
        """Messages under keys that are none of ours, or of more edges than are served."""
        self._refused = False
        for row in () if group else _SUBSCRIBED:
            self._declare(selector(row, edges=edges), number=-1)
        self._presence = session.liveliness().declare_subscriber(
            selector(Channel.ALIVE, edges=edges), self._on_presence, history=True
        )

    def ports(self) -> list[EdgePort]:
        """All edges that are served; one without a session may leave again, and one that moved."""
        with self._lock:
            evicted = self._subscribers.keys() - self._ports.keys()
        for edge in evicted:
            self._unsubscribe(edge)
        if self._group is not None:
            self._share(self._group)
        with self._lock:
            ports = list(self._ports.values())
        if self._loses():
            for port in ports:
                self._subscribe_again(port)
        return ports

    def closed(self, port: EdgePort) -> None:
        """The last session of a port that had left is closed: with a group another member may serve the edge."""
        if self._group is not None:
            self._leaving.discard(port.edge)
            self._group.release(port.edge)

    def is_known(self, edge: str) -> bool:
        """Whether this edge, or any where it is "", has shown itself by its token or a message."""
        with self._lock:
            return (
                edge in self._ports or edge in self._alive or (not edge and bool(self._ports or self._alive))
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for port in self.ports():
            port.inbox.close()
        if self.foreign:
            _log.warning("%d messages under keys that are not ours were skipped", self.foreign)

    def _share(self, group: Group) -> None:
        with self._lock:
            known = self._alive | self._ports.keys()
        for edge in sorted(known - self._leaving):
            served, serves = edge in self._subscribers, group.serves(edge)
            if serves and not served:
                for row in _SUBSCRIBED if self._port(edge) is not None else ():
                    self._subscribe(edge, row, 0)
            elif served and not serves:
                self._leave(edge)
            elif not served:
                group.release(edge)
        group.forget(except_for=known | self._leaving)

    def _subscribe(self, edge: str, row: Channel, number: int) -> None:
        # Make the new one first, and keep the last one: the declaration of the new may be lost on the way, while the
        # withdrawal of the old arrives.
        own = self._subscribers.setdefault(edge, {})
        new = self._declare(another_key(EdgeKeys(edge)[row], row, number=number), number=number)
        self._newest[edge, row] = number
        former = own.get(row, [])
        own[row] = [new, *former[:1]]
        for one in former[1:]:
            one.undeclare()  # type: ignore[no-untyped-call]

    def _declare(self, key_expr: str, *, number: int) -> zenoh.Subscriber[None]:
        put = partial(self._put, number=number)
        return subscribe(self._session, key_expr, put=put, clock=self._clock, on_error=self._fail)

    def _put(self, item: Received, *, number: int) -> None:
        # Takes messages of a channel's newest subscription, or of that of all edges (-1) where it has none.
        parsed = self._parsed(item.key)
        if parsed is None or number != self._newest.get(parsed, -1):
            return
        port = self._ports.get(parsed[0]) if self._group else self._port(parsed[0], sends=True)
        if port is not None:
            port.put(item, parsed[1])

    def _subscribe_again(self, port: EdgePort) -> None:
        # Channels on which nothing has come since reports came: the subscription of each may be lost alone. A new one
        # of a channel that works could lose it. Zenoh withdraws the token of another way.
        now_ns, edge, there = self._clock(), port.edge, port.present.is_set()
        silent = now_ns - port.reported_ns >= _QUIET_NS
        if Channel.STATUS in port.used_channels and (silent or not there):
            port.used_channels.clear()
            port.resubscription = None
        if port.reported_ns and not there:
            return
        port.resubscription = pause = port.resubscription or RetryPause(_QUIET_NS, _MOST_QUIET_NS)
        if pause.due(now_ns) and (there or pause.pause_ns < _MOST_QUIET_NS):
            for row in _SUBSCRIBED if pause.pause_ns else ():
                if row not in port.used_channels:
                    self._subscribe(edge, row, max(0, self._newest.get((edge, row), -1)) + 1)
            pause.failed(now_ns)

    def _leave(self, edge: str) -> None:
        self._unsubscribe(edge)
        with self._lock:
            port = self._ports.pop(edge, None)
        if port is not None:  # or it has made space for another in this very round
            self._leaving.add(edge)
            port.close()

    def _unsubscribe(self, edge: str) -> None:
        # Not while the lock is held: Zenoh may wait for a callback that wants it.
        for row, subscribers in self._subscribers.pop(edge).items():
            del self._newest[edge, row]
            for one in subscribers:
                one.undeclare()  # type: ignore[no-untyped-call]

    def _parsed(self, key: str) -> tuple[str, Channel] | None:
        parsed = parse_key(key)
        if parsed is None or not matches(parsed[0], edges=self._edges):
            self.foreign += 1
            return None
        return parsed

    def _port(self, edge: str, *, sends: bool = False) -> EdgePort | None:
        with self._lock:
            port = self._ports.get(edge)
            if port is None:
                alive = edge in self._alive
                if len(self._ports) >= MAX_EDGES and not (alive and self._make_space(silent=sends)):
                    self.foreign += 1
                    self._say_refused(edge)
                    return None
                port = self._ports[edge] = EdgePort(
                    self._session, edge, clock=self._clock, log=self._log, still_codecs=self._still_codecs
                )
                if alive:  # its token came once, and does not come again
                    port.present.set()
            return port

    def _make_space(self, *, silent: bool) -> bool:
        # Leave one that is not there and has no session: a ground may run for years. Or a ``silent`` one.
        for edge, port in self._ports.items():
            waits = not port.present.is_set() or (silent and not port.used_channels)
            if waits and not port.used.is_set():
                del self._ports[edge]
                if self._group is not None and edge in self._subscribers:
                    self._leaving.add(edge)
                port.close()
                return True
        return False

    def _say_refused(self, edge: str) -> None:
        if not self._refused:
            self._refused = True
            _log.warning(
                "%s is not served: there are %d edge ids already, and more are not taken; narrow --edges, or see who "
                "invents names (docs/security.md has keys against that)",
                edge,
                MAX_EDGES,
            )

    def _on_presence(self, sample: zenoh.Sample) -> None:
        key, there = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT  # these enums fail `is`
        parsed = self._parsed(key)
        if parsed is None:
            return
        edge = parsed[0]
        try:
            with self._lock:
                if not there:
                    self._alive.discard(edge)
                elif len(self._alive) < _MOST_ALIVE:
                    self._alive.add(edge)
            # In a group it may be another's: there is a port for it only if it is served here.
            port = self._port(edge) if there and self._group is None else self._ports.get(edge)
        except Exception as error:  # noqa: BLE001 - for the edge's thread
            self._fail(key, error)
            return
        if port is not None:
            (port.present.set if there else port.present.clear)()

    def _fail(self, key: str, error: Exception) -> None:
        # Hand over the error of a callback: to the edge's thread, which ends its session for it.
        parsed = parse_key(key)
        with self._lock:
            port = None if parsed is None else self._ports.get(parsed[0])
        if port is not None:
            port.fail(error)
            return
        self.foreign += 1
        if self.foreign.bit_count() == 1:
            _log.error("a message under %.80s could not be taken in: %s", key, reason_of(error))
