"""Bytes of an autopilot to MAVLink messages, version 1 and 2 alike."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega

__all__ = ["MAX_FRAME_BYTES", "FrameParser"]

MAX_FRAME_BYTES = 280
"""Header, 255 bytes of payload, checksum and signature of MAVLink 2."""


class FrameParser:
    """Of a stream, whose frames may begin in one read and end in the next, or of datagrams, whose frames do not."""

    def __init__(self, *, is_stream: bool) -> None:
        self._is_stream = is_stream
        self._parser = _new_parser()

    @property
    def buffered_bytes(self) -> int:
        """What waits for the rest of its frame."""
        return len(self._parser.buf)

    def messages(self, data: bytes) -> list[Any]:
        """All messages that end in ``data``; what is none is left out."""
        try:
            found = self._parser.parse_buffer(data) or []
        except Exception:  # noqa: BLE001 - whatever a parser of foreign bytes raises ends no flight
            self._parser = _new_parser()
            return []
        if not self._is_stream or self._parser.buf_len() > MAX_FRAME_BYTES:
            self._parser = _new_parser()
        else:  # the parser itself forgets what it has read only where a read ends with a frame
            del self._parser.buf[: self._parser.buf_index]
            self._parser.buf_index = 0
        return found


def _new_parser() -> Any:
    parser = ardupilotmega.MAVLink(None)
    parser.robust_parsing = True
    return parser
