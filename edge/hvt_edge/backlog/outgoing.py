"""One piece at a time in a thread of its own: a link that is full for seconds must not hold up the disk."""

from __future__ import annotations

import threading
from collections.abc import Callable

from hvt_common.runtime.process import lower_priority
from hvt_edge.backlog.backfill import Chunk

__all__ = ["Outgoing"]


class Outgoing:
    """Sends what it is given. `put` and `take` from one thread; ``on_done()`` is called in its own after each piece.

    ``send(piece)`` returns the line bytes, 0 where it was not sent; it may block.
    """

    def __init__(self, send: Callable[[Chunk], int], *, on_done: Callable[[], None]) -> None:
        self._send = send
        self._on_done = on_done
        self._changed = threading.Condition()
        self._chunk: Chunk | None = None
        self._done: tuple[Chunk, int] | None = None
        self._closed = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="hvt-backlog", daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """Whether a piece is being sent, or was and nobody has asked what became of it."""
        return self._chunk is not None or self._done is not None

    def put(self, chunk: Chunk) -> None:
        """Send this; only where it is not `busy`."""
        assert not self.busy, "one at a time"
        with self._changed:
            self._chunk = chunk
            self._changed.notify()

    def take(self) -> tuple[Chunk, int] | None:
        """Return the piece that was sent last and its line bytes, once; None while there is none.

        Raises whatever ``send`` has raised.
        """
        with self._changed:
            if self._error is not None:
                raise self._error
            done, self._done = self._done, None
        return done

    def close(self, timeout_s: float) -> None:
        """Send no more; what is being sent has so long to go."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(timeout=timeout_s)

    def _run(self) -> None:
        lower_priority()
        while (chunk := self._next()) is not None:
            try:
                line_bytes = self._send(chunk)
            except BaseException as error:  # noqa: BLE001 - handed to the disk thread, which hands it on
                with self._changed:
                    self._error = error
                self._on_done()
                return
            with self._changed:
                self._done, self._chunk = (chunk, line_bytes), None
            self._on_done()

    def _next(self) -> Chunk | None:
        with self._changed:
            self._changed.wait_for(lambda: self._chunk is not None or self._closed)
            return None if self._closed else self._chunk
