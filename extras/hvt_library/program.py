"""A side that runs in a thread of a program that is not ours."""

from __future__ import annotations

import atexit
import threading
import time
from collections.abc import Callable
from typing import Any

_ZENOH_CALLBACK = "(pyo3-closure)"
"""Zenoh's Python package runs each callback in a thread of such a name, and joins none."""
_JOIN_WITHIN_S = 30.0


class InThread:
    """Runs one side in a thread until it ends or is stopped, at the program's end at the latest.

    ``stop()`` is to end it, from any thread. Its error is kept, with the summary of the flight before it.
    """

    def __init__(self, run: Callable[[], object], *, stop: Callable[[], None], name: str) -> None:
        self.error: BaseException | None = None
        self.summary: Any = None
        self._run_side, self._stop = run, stop
        self.thread = threading.Thread(target=self._run, name=name, daemon=True)
        self.thread.start()
        atexit.register(self._end)

    def end(self) -> None:
        """Stop it, and wait for its end."""
        atexit.unregister(self._end)
        self._end()

    def raise_error(self) -> None:
        if self.error is not None:
            raise self.error

    def _end(self) -> None:
        self._stop()
        self.thread.join()

    def _run(self) -> None:
        try:
            self.summary = self._run_side()
        except BaseException as error:  # noqa: BLE001 - handed to the program
            self.error, self.summary = error, getattr(error, "summary", None)


@atexit.register
def _join_threads() -> None:
    # Before Python finalizes a program that cannot end by `leave`, it waits for the threads that this project and
    # Zenoh have started. Those of a session end soon after it is closed.
    until_s = time.monotonic() + _JOIN_WITHIN_S
    for thread in threading.enumerate():
        if thread.name.startswith(("hvt-", "zenoh-")) or thread.name.endswith(_ZENOH_CALLBACK):
            thread.join(max(0.0, until_s - time.monotonic()))
