"""An inbox of which a test can tell when all that was put into it has been handled, however slow the machine is."""

from __future__ import annotations

from hvt_common.link.inbox import Inbox, Received

__all__ = ["WatchedInbox"]


class WatchedInbox(Inbox):
    """An edge's inbox with one thread that takes: it has done with an item when it asks for the next."""

    def __init__(self) -> None:
        super().__init__(capacity=1024, overflow="newest")
        self._handled = True

    @property
    def handled(self) -> bool:
        """Whether that thread has asked for more, and found none, since the last item was put."""
        return self._handled

    def put(self, item: Received) -> None:
        """As any inbox does."""
        with self._changed:
            super().put(item)
            self._handled = False

    def get(self, *, timeout_s: float) -> Received | None:
        """As any inbox does."""
        with self._changed:
            self._handled |= not self._items
            return super().get(timeout_s=timeout_s)
