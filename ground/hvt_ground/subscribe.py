"""The ground's end of the link: what it subscribes to, asks and reports. Knows Zenoh; knows nothing of frames."""

from __future__ import annotations

import logging
import threading
import time
from types import TracebackType
from typing import Self

import zenoh

from hvt_common.link.diagnose import control_unanswered
from hvt_common.link.inbox import Inbox, Received
from hvt_common.link.keys import EdgeKeys, Row, matches, parse_key, selector
from hvt_common.link.session import ask, declare_publisher, subscribe
from hvt_common.link.wire import Command, ControlRequest, Feedback, Info, WireError

__all__ = ["MAX_EDGES", "EdgePort", "GroundLink"]

_log = logging.getLogger(__name__)

MAX_EDGES = 64
"""More edge ids than this are not served: each costs a thread, and ids cost a sender nothing."""
_INBOX_MESSAGES = 1024
_SUBSCRIBED = (Row.BASE, Row.ROI, Row.TRACKS, Row.STATUS)
_ASK_S = 1.0
_UNANSWERED = 3
"""So many questions on control in a row without an answer are no accident."""


class EdgePort:
    """One edge as the link knows it: its messages in order of arrival, its presence, and a way to talk to it."""

    def __init__(self, session: zenoh.Session, edge: str) -> None:
        self.edge = edge
        self.inbox = Inbox(capacity=_INBOX_MESSAGES, overflow="newest")
        self.present = threading.Event()
        """Set while the edge's liveliness token is there."""
        self._unanswered = 0
        self._session = session
        self._keys = EdgeKeys(edge)
        self._feedback = declare_publisher(session, Row.FEEDBACK, keys=self._keys)

    def ask_info(self) -> tuple[Info, int, int] | None:
        """Return the session's facts with the times of asking and hearing (ns); None without an answer in time."""
        asked_ns = time.time_ns()
        try:
            data = ask(self._session, Row.INFO, keys=self._keys, question=b"", timeout_s=_ASK_S)
            heard_ns = time.time_ns()
            return None if data is None else (Info.parse(data), asked_ns, heard_ns)
        except (WireError, zenoh.ZError) as error:
            _log.warning("%s: its answer to info cannot be used: %s", self.edge, error)
            return None

    def request_keyframe(self) -> None:
        """Ask for a keyframe; does not wait for the answer, which is the keyframe."""
        request = ControlRequest(session_id=0, command=Command.KEYFRAME, arguments={})
        answered = threading.Event()
        handler: zenoh.handlers.Callback[zenoh.Reply] = zenoh.handlers.Callback(
            lambda _reply: answered.set(), lambda: self._note_control(answered=answered.is_set())
        )
        try:
            self._session.get(self._keys.key(Row.CONTROL), handler, payload=request.pack(), timeout=_ASK_S)
        except zenoh.ZError as error:
            _log.debug("%s: keyframe request not sent: %s", self.edge, error)

    def _note_control(self, *, answered: bool) -> None:
        """Say once that nothing is answered: a question without the right to ask is dropped in silence."""
        self._unanswered = 0 if answered else self._unanswered + 1
        if self._unanswered == _UNANSWERED and self.present.is_set():
            _log.warning("%s", control_unanswered(self.edge))

    def report(self, feedback: Feedback) -> None:
        """Publish a receiver report."""
        try:
            self._feedback.put(feedback.pack())
        except zenoh.ZError as error:
            _log.debug("%s: feedback not sent: %s", self.edge, error)


class GroundLink:
    """Sorts what comes by edge. `ports` grows as edges appear; ``edges`` is the pattern of ``--edges``."""

    def __init__(self, session: zenoh.Session, *, edges: str) -> None:
        self._session = session
        self._edges = edges
        self._lock = threading.Lock()
        self._ports: dict[str, EdgePort] = {}
        self.foreign = 0
        """Messages under keys that are none of ours, or of more edges than are served."""
        for row in _SUBSCRIBED:
            subscribe(session, selector(row, edges=edges), inbox=self)
        self._presence = session.liveliness().declare_subscriber(
            selector(Row.ALIVE, edges=edges), self._on_presence, history=True
        )

    def ports(self) -> list[EdgePort]:
        """All edges that have been seen so far."""
        with self._lock:
            return list(self._ports.values())

    def sees(self, edge: str) -> bool:
        """Whether this edge has shown itself, by its token or a message."""
        with self._lock:
            return edge in self._ports

    def put(self, item: Received) -> None:
        """Take a message from Zenoh's callback."""
        port = self._port(item.key)
        if port is not None:
            port.inbox.put(item)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for port in self.ports():
            port.inbox.close()
        if self.foreign:
            _log.warning("%d messages under keys that are not ours were skipped", self.foreign)

    def _port(self, key: str) -> EdgePort | None:
        parsed = parse_key(key)
        if parsed is None or not matches(parsed[0], edges=self._edges):
            self.foreign += 1
            return None
        edge = parsed[0]
        with self._lock:
            port = self._ports.get(edge)
            if port is None:
                if len(self._ports) >= MAX_EDGES:
                    self.foreign += 1
                    return None
                port = self._ports[edge] = EdgePort(self._session, edge)
            return port

    def _on_presence(self, sample: zenoh.Sample) -> None:
        port = self._port(str(sample.key_expr))
        if port is None:
            return
        if sample.kind == zenoh.SampleKind.PUT:  # the enums of the bindings fail `is`
            port.present.set()
        else:
            port.present.clear()
