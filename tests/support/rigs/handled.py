"""What a test of the receiving thread can wait for, however slow the machine is: all is handled, and it has ended."""

from __future__ import annotations

import threading

from hvt_common.transport.inbox import Inbox, Received
from hvt_ground.session.edge_sessions import EdgeSessions


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
        """As any inbox does."""
        with self._watch:
            super().put(item)
            self._handled = False

    def get(self, *, timeout_s: float) -> Received | None:
        """As any inbox does."""
        with self._watch:
            self._handled |= len(self) == 0
        return super().get(timeout_s=timeout_s)


def check(edge: EdgeSessions) -> None:
    """Raise what ended the thread, or one of its sessions."""
    if edge.error is not None:
        raise edge.error
    assert not edge.failures.parts


def end(edge: EdgeSessions, *, failing: bool) -> None:
    """Close it, and check it; ``failing``: the test has failed already, and that is what is to be seen."""
    assert edge.join(timeout_s=60), "the thread of the edge did not end"
    if not failing:
        check(edge)
