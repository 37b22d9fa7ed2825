"""The time of a thread that is now and then kept from its messages: to open a recording may take it seconds. Pure."""

from __future__ import annotations

__all__ = ["Uptime"]


class Uptime:
    """Counts a gap between two messages only as far as both their arrival and their handling show it.

    While the thread was away the sender was not silent, so by arrival the gap is small. And a sender that waited for
    this side's answer in the meantime was not silent either: by handling that gap is small. Both clocks are one.
    """

    def __init__(self) -> None:
        self._lived_ns = 0
        self._arrived_ns: int | None = None
        self._handled_ns = 0

    def handle(self, *, arrived_ns: int, now_ns: int) -> int:
        """Return the time of the message that is taken up now; never less than before."""
        arrived_ns = min(arrived_ns, now_ns)
        if self._arrived_ns is None:
            self._lived_ns = now_ns
        else:
            self._lived_ns += max(0, min(arrived_ns - self._arrived_ns, now_ns - self._handled_ns))
            arrived_ns = max(arrived_ns, self._arrived_ns)
        self._arrived_ns, self._handled_ns = arrived_ns, now_ns
        return self._lived_ns

    def at(self, now_ns: int, *, waiting: bool) -> int:
        """Return the time now; with messages ``waiting`` it is still that of the last one taken up."""
        if self._arrived_ns is None:
            return now_ns
        return self._lived_ns + (0 if waiting else max(0, now_ns - self._handled_ns))
