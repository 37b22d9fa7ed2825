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

import threading
from pathlib import Path

from hvt_ground.events import Event, MessageTiming, StillsRead
from hvt_ground.sinks.contract import Sink
from hvt_ground.sinks.line_file import LineFile

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


def timing_table(path: Path) -> LineFile:
    """The file, for all sessions of a ground."""
    return LineFile(path, COLUMNS)


class SessionTiming:
    """Makes the lines of one session, of its `MessageTiming` and `StillsRead` events, for any thread.

    ``table`` takes them; it is not closed with this.
    """

    def __init__(self, table: Sink[str], *, edge: str, session_id: int) -> None:
        self._table = table
        self._whose = (edge, f"{session_id:016x}")
        self._lock = threading.Lock()
        self._unread: dict[int, MessageTiming] = {}

    def log(self, item: Event) -> None:
        """Write a message that has been dealt with; a still's line is written when it has been read."""
        if not isinstance(item, MessageTiming | StillsRead):
            return
        with self._lock:
            if isinstance(item, StillsRead):
                for sequence in item.sequences:
                    if (still := self._unread.pop(sequence, None)) is not None:
                        self._write(still, handled_ns=item.at_ns)
            elif item.handled_ns is not None:
                self._write(item, handled_ns=item.handled_ns)
            else:
                self._unread[item.sequence] = item
                if len(self._unread) > _MOST_UNREAD:
                    self._write(self._unread.pop(next(iter(self._unread))), handled_ns=0)

    def close(self, hurry: threading.Event | None = None) -> None:  # noqa: ARG002 - it is always quick
        """Write the stills that were never read."""
        with self._lock:
            for still in self._unread.values():
                self._write(still, handled_ns=0)
            self._unread.clear()

    def _write(self, message: MessageTiming, *, handled_ns: int) -> None:
        values = (
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
        self._table.log(",".join(map(str, values)) + "\n")
