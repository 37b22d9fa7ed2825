"""Closes a live source from outside: one whose signal is lost would keep its reader waiting."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from hvt_edge.source.contract import Source

__all__ = ["closing_on"]


@contextmanager
def closing_on(stop: threading.Event, source: Source) -> Iterator[None]:
    """Close a live source as soon as ``stop`` is set: one whose signal is lost would keep its reader waiting."""

    def wait() -> None:
        stop.wait()
        source.close()

    threading.Thread(target=wait, name="hvt-stop", daemon=True).start()
    try:
        yield
    finally:
        stop.set()
