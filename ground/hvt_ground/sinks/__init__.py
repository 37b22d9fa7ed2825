"""Where events go: recordings, live views, tables. A sink takes every event and uses those that it knows."""

from __future__ import annotations

from typing import Protocol

from hvt_ground.events import Event

__all__ = ["Sink"]


class Sink(Protocol):
    """Takes the events of one session."""

    def log(self, event: Event) -> None:
        """Take an event; may be called by any thread."""
        ...

    def close(self, *, quickly: bool = False) -> None:
        """Write what is buffered; ``quickly`` leaves out what only helps and may take seconds."""
        ...
