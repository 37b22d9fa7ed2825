"""Bytes of an autopilot to MAVLink messages, version 1 and 2 alike."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega

MAX_FRAME_BYTES = 280
"""Header, 255 bytes of payload, checksum and signature of MAVLink 2."""


class FrameParser:
    """Of a stream, whose frames may begin in one read and end in the next, or of datagrams, which may be cut alike.

    Of a datagram what is left of the one before may be noise: it counts where more messages come out with it.
    """

    def __init__(self, *, is_stream: bool) -> None:
        self._is_stream = is_stream
        self._rest = b""

    @property
    def buffered_bytes(self) -> int:
        """Bytes that wait for the rest of their frame."""
        return len(self._rest)

    def messages(self, data: bytes) -> list[Any]:
        """All messages that end in ``data``; other bytes are left out."""
        found, rest = _parsed(self._rest + data)
        if not self._is_stream and self._rest:
            alone, rest_alone = _parsed(data)
            if len(alone) > len(found):
                found, rest = alone, rest_alone
        self._rest = rest if len(rest) <= MAX_FRAME_BYTES else b""
        return found


def _parsed(data: bytes) -> tuple[list[Any], bytes]:
    # The messages in it, and the beginning of one that is not there as a whole.
    parser = ardupilotmega.MAVLink(None)
    parser.robust_parsing = True
    try:
        found = parser.parse_buffer(data) or []
    except Exception:  # noqa: BLE001 - whatever a parser of foreign bytes raises ends no flight
        return [], b""
    return [one for one in found if one.get_type() != "BAD_DATA"], bytes(parser.buf[parser.buf_index :])
