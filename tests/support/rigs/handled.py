"""What a test of the receiving thread can wait for, however slow the machine is: all is handled, and it has ended."""

import threading
import time
from collections.abc import Sequence
from typing import Any, Self, cast

from hvt_common.protocol.messages import Info
from hvt_common.transport.inbox import Inbox, Received
from hvt_ground.perception.session import SessionPerception
from hvt_ground.session.edge_port import EdgePort, ReceiverReports
from hvt_ground.session.edge_sessions import EdgeSessions, join
from hvt_ground.session.session import Session
from hvt_ground.sinks import Sink
from programs.processes import PATIENT_S, eventually
from rigs.flight import Flight, Port, patient_worker, pipeline_of


class WatchedInbox(Inbox):
    """An edge's inbox with one thread that takes: it has done with an item when it asks for the next."""

    def __init__(self) -> None:
        super().__init__(capacity=1024)
        self._handled = True
        self._watch = threading.Lock()

    @property
    def handled(self) -> bool:
        """Whether that thread has asked for more, and found none, since the last item was put."""
        return self._handled

    def put(self, item: Received) -> None:
        with self._watch:
            super().put(item)
            self._handled = False

    def get(self, *, timeout_s: float) -> Received | None:
        with self._watch:
            self._handled |= len(self) == 0
        return super().get(timeout_s=timeout_s)


class ReceiverRig:
    """An edge's port and receiving thread, and the sessions that it has opened and ended."""

    def __init__(
        self, flight: Flight | None, *, pipeline=pipeline_of, worker_of=patient_worker, **settings: Any
    ) -> None:
        self.port, self.flight = Port(), flight
        self.port.inbox = self.inbox = WatchedInbox()
        self.port.flight = flight
        self.opened: list[Session] = []
        self.ended: list[Session] = []
        self._pipeline, self._worker_of = pipeline, worker_of
        self.receiver = EdgeSessions(
            cast("EdgePort", self.port), open_session=self._open, on_ended=self.ended.append, **settings
        )
        self.receiver.start(drain_s=PATIENT_S)

    def sinks_of(self, _info: Info) -> Sequence[Sink]:
        return ()

    def backlog_perception(self, _info: Info) -> SessionPerception | None:
        return None

    def _open(self, info: Info, reports: ReceiverReports) -> Session:
        session = Session(
            info,
            sinks=self.sinks_of(info),
            pipeline_of=self._pipeline,
            clock=time.time_ns,
            reports=reports,
            backlog_perception=self.backlog_perception(info),
            worker_of=None if info.pace == "lockstep" else self._worker_of,
        )
        self.opened.append(session)
        return session

    def put(self, *items: Received) -> None:
        for item in items:
            self.inbox.put(item)

    def settle(self) -> None:
        """All that was put has been handled and seen."""
        self.wait_for(lambda: self.inbox.handled)
        for session in self.opened:
            self.wait_for(lambda one=session: one.idle)

    def wait_for(self, condition) -> None:
        """Until it is so; raise what ended the thread, or one of its sessions."""
        edge = self.receiver
        eventually(lambda: condition() or edge.error is not None or bool(edge.failures.parts))
        self._check()

    def _check(self) -> None:
        if self.receiver.error is not None:
            raise self.receiver.error
        assert not self.receiver.failures.parts

    @property
    def session(self) -> Session:
        assert self.receiver.session is not None
        return self.receiver.session

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind, *_) -> None:
        assert join([self.receiver], timeout_s=60), "the thread of the edge did not end"
        if kind is None:  # else the test has failed already, and that is what is to be seen
            self._check()
