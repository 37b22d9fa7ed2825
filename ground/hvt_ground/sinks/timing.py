"""Write when each message was captured, sent, received and shown: one line a message, each whole once it is written.

The columns, in this order (times are Unix nanoseconds, 0 where there is none):

- ``kind``: base, roi, tracks, status; backlog-still, backlog-base, backlog-info for a chunk of the backlog
- ``sequence``: the message's own number; ``frame_index``: of the frame it is about, -1 where it is about none
- ``capture_ns``, ``send_ns``: by the edge's clock; ``received_ns``, ``shown_ns``: by this one
- ``shown_ns``: when it was decoded and recorded (base), read by the classifier (roi), or taken in; 0: never, or
  a chunk of the past that did not complete an object, or one of no use
- ``line_bytes``: what it cost on the line, headers of Zenoh, TCP and IP included
- ``clock_offset_ns``: the edge's clock less this one, as known then: the delay of a message is
  ``received_ns - (capture_ns - clock_offset_ns)``
- ``edge``, ``session``: whose it is
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable
from pathlib import Path

from hvt_common.errors import UserError
from hvt_ground.events import Event, MessageTiming, StillsRead

__all__ = ["COLUMNS", "SessionTiming", "TimingTable"]

COLUMNS = (
    "kind",
    "sequence",
    "frame_index",
    "capture_ns",
    "send_ns",
    "received_ns",
    "shown_ns",
    "line_bytes",
    "clock_offset_ns",
    "edge",
    "session",
)
_MOST_UNREAD = 512
"""Stills whose line waits until they are read; more than the session's own queue holds."""


class TimingTable:
    """The file, for all sessions of this ground. Any thread may write; killing the process loses no line.

    Raises `UserError` where it cannot be created, or (from `line`) written any further.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_CLOEXEC
        try:
            self._file: int | None = os.open(path, flags, 0o644)
        except OSError as error:
            raise UserError(
                f"--timing {path} cannot be written ({error.strerror}): name a file that can"
            ) from None
        self.line(COLUMNS)

    def line(self, values: Iterable[object]) -> None:
        """Append one line; after `close` nothing."""
        text = ",".join(map(str, values)) + "\n"
        with self._lock:
            if self._file is None:  # a receiver that did not end in time still writes
                return
            try:
                os.write(self._file, text.encode("ascii"))
            except OSError as error:
                raise UserError(
                    f"--timing {self._path} cannot be written any further: {error.strerror}"
                ) from error

    def close(self) -> None:
        """After the last session has ended."""
        with self._lock:
            if self._file is not None:
                os.close(self._file)
                self._file = None


class SessionTiming:
    """The lines of one session, of its `MessageTiming` and `StillsRead` events."""

    def __init__(self, table: TimingTable, *, edge: str, session_id: int) -> None:
        self._table = table
        self._whose = (edge, f"{session_id:016x}")
        self._lock = threading.Lock()
        self._unread: dict[int, MessageTiming] = {}

    def log(self, event: Event) -> None:
        """Write a message that has been dealt with; a still's line is written when it has been read."""
        if not isinstance(event, MessageTiming | StillsRead):
            return
        with self._lock:
            if isinstance(event, StillsRead):
                for sequence in event.sequences:
                    if (still := self._unread.pop(sequence, None)) is not None:
                        self._write(still, handled_ns=event.at_ns)
            elif event.handled_ns is not None:
                self._write(event, handled_ns=event.handled_ns)
            else:
                self._unread[event.sequence] = event
                if len(self._unread) > _MOST_UNREAD:
                    self._write(self._unread.pop(next(iter(self._unread))), handled_ns=0)

    def close(self, *, quickly: bool = False) -> None:  # noqa: ARG002 - it is always quick
        """What was not read, never will be."""
        with self._lock:
            for still in self._unread.values():
                self._write(still, handled_ns=0)
            self._unread.clear()

    def _write(self, message: MessageTiming, *, handled_ns: int) -> None:
        self._table.line(
            (
                message.kind,
                message.sequence,
                message.frame_index,
                message.capture_ns,
                message.send_ns,
                message.received_ns,
                handled_ns,
                message.line_bytes,
                message.clock_offset_ns,
                *self._whose,
            )
        )
