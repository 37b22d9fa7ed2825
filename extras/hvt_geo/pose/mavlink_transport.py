"""From an autopilot's bytes, on a UDP port, a TCP server or a serial device, to messages. Nothing is sent to it."""

from __future__ import annotations

import logging
import os
import re
import socket
import termios
import threading
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, Self

import serial  # type: ignore[import-untyped]
from pymavlink.dialects.v20 import ardupilotmega

from hvt_common.errors import UserError, may_come

_log = logging.getLogger(__name__)

_ACCEPTED = "give mavlink:udpin:HOST:PORT, mavlink:tcp:HOST:PORT or mavlink:/dev/DEVICE[,BAUD]"
_KINDS = ("udpin", "tcp")
_HOST_PORT = re.compile(r"([^:\s\0]{1,255}):([0-9]{1,5})")
_DEVICE = re.compile(r"(/dev/[^\0]{1,255}?)(?:,([^,]*))?")
_BAUD = range(50, 4_000_001)
_USUAL_BAUD = 115_200
_POLL_S = 0.2
_CONNECT_S = 3.0
_SILENT_S = 10.0
"""A TCP server silent for longer may be gone without a word: an autopilot says something every second."""
_READ_BYTES = 8192
"""At most, of a stream and of a datagram; autopilots send datagrams of at most 1500, and the rest of a longer one is
dropped."""
_PAUSES_S = (0.5, 1.0, 2.0, 4.0, 8.0)


class Link(Protocol):
    """An open port."""

    sender: object
    """Whose the newest bytes are; of a stream always the same."""

    def read(self) -> bytes:
        """The bytes of one datagram at most; nothing after `_POLL_S`. Raises `OSError` once it is gone."""
        ...

    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class Address:
    """``udpin:HOST:PORT``, ``tcp:HOST:PORT`` or ``/dev/DEVICE[,BAUD]``."""

    text: str
    kind: str
    place: str
    """Host or device."""
    number: int
    """Port or baud rate."""

    @classmethod
    def parse(cls, text: str) -> Self:
        said = f"--pose mavlink:{text:.200}"
        kind, _, rest = text.partition(":")
        if kind in _KINDS:
            parts = _HOST_PORT.fullmatch(rest)
            if parts is None:
                raise UserError(f"{said} names no HOST:PORT: {_ACCEPTED}")
            port = int(parts[2])
            if not 1 <= port <= 65535:
                raise UserError(f"{said} has the port {port}, accepted is 1 to 65535: {_ACCEPTED}")
            return cls(text, kind, parts[1], port)
        parts = _DEVICE.fullmatch(text)
        if parts is None:
            raise UserError(f"{said} is no address: {_ACCEPTED}")
        baud = _USUAL_BAUD if parts[2] is None else _whole(parts[2])
        if baud not in _BAUD:
            raise UserError(
                f"{said} has the baud rate {parts[2]!r:.40}, accepted is {_BAUD[0]} to {_BAUD[-1]}: {_ACCEPTED}"
            )
        return cls(text, "serial", parts[1], baud)

    @property
    def is_stream(self) -> bool:
        """Whether a frame may come in parts."""
        return self.kind != "udpin"

    def open(self, *, silent_s: float) -> Link:
        """Open it; a TCP server may be silent for ``silent_s``. Raises `OSError` where that fails."""
        try:
            if self.kind == "udpin":
                return _UdpPort(self.place, self.number)
            if self.kind == "tcp":
                return _TcpStream(self.place, self.number, silent_s=silent_s)
            return _SerialDevice(self.place, self.number)
        except (UnicodeError, TypeError):  # no name of the domain name system; of bind the second
            raise OSError(0, "this is no name of a host") from None
        except (ValueError, termios.error) as error:  # of a serial device
            raise OSError(0, f"{error}") from None


class Connection:
    """An address that is opened again where it is lost, after pauses that grow; used by one thread.

    An address that is not there yet is opened later, which the log says. Raises `UserError` for an impossible one.
    """

    def __init__(self, address: Address, *, stop: threading.Event, silent_s: float = _SILENT_S) -> None:
        self._open = partial(address.open, silent_s=silent_s)
        self._stop = stop
        self._failed = 0
        """Attempts, since something came."""
        self.trouble = ""
        """Why it is not open; read by any thread."""
        self._link: Link | None = None
        try:
            self._link = self._open()
        except OSError as error:
            said = f"--pose mavlink:{address.text:.200} cannot be opened: {_reason(error)}"
            if not may_come(error):
                raise UserError(f"{said}; {_ACCEPTED}") from None
            self._failed, self.trouble = 1, _reason(error)
            _log.warning("%s; all else goes on without a pose, and it is tried again", said)

    def read(self) -> bytes:
        """The bytes of a fraction of a second; nothing while it is not open."""
        try:
            if self._link is None:
                pause_s = _PAUSES_S[min(self._failed, len(_PAUSES_S)) - 1]
                if self._stop.wait(pause_s):
                    return b""
                self._link = self._open()
            data = self._link.read()
        except OSError as error:
            self.close()
            self._failed += 1
            self.trouble = _reason(error)
            return b""
        if data:
            self._failed, self.trouble = 0, ""
        return data

    @property
    def sender(self) -> object:
        """Whose the bytes are that `read` gave last."""
        return None if self._link is None else self._link.sender

    def close(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            with suppress(OSError):  # it is gone, which is why it is closed
                link.close()


class _UdpPort:
    sender: object = None

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except BaseException:
            self._socket.close()
            raise
        self._socket.settimeout(_POLL_S)

    def read(self) -> bytes:
        try:
            data, self.sender = self._socket.recvfrom(_READ_BYTES)
        except TimeoutError:
            return b""
        return data

    def close(self) -> None:
        self._socket.close()


class _TcpStream:
    sender: object = None

    def __init__(self, host: str, port: int, *, silent_s: float) -> None:
        self._socket = socket.create_connection((host, port), timeout=_CONNECT_S)
        self._socket.settimeout(_POLL_S)
        self._most_silent_s = silent_s
        self._silent_s = 0.0

    def read(self) -> bytes:
        try:
            data = self._socket.recv(_READ_BYTES)
        except TimeoutError:
            self._silent_s += _POLL_S
            if self._silent_s >= self._most_silent_s:
                raise ConnectionError(0, f"the server has said nothing for {self._silent_s:.0f} s") from None
            return b""
        if not data:
            raise ConnectionError(0, "the server has closed the connection")
        self._silent_s = 0.0
        return data

    def close(self) -> None:
        self._socket.close()


class _SerialDevice:
    sender: object = None

    def __init__(self, device: str, baud: int) -> None:
        self._port = serial.Serial(device, baud, timeout=_POLL_S)

    def read(self) -> bytes:
        first = self._port.read(1)
        more = min(self._port.in_waiting, _READ_BYTES) if first else 0
        return bytes(first + self._port.read(more) if more else first)

    def close(self) -> None:
        self._port.close()


def _whole(text: str) -> int:
    return int(text) if re.fullmatch(r"[0-9]{1,9}", text) else -1


def _reason(error: OSError) -> str:
    # In words; pyserial puts a number and the device into its own.
    if error.errno and error.errno > 0:
        return os.strerror(error.errno)
    return re.sub(r"\[Errno \d+\] |.*\(\d+, '|'\)$", "", error.strerror or f"{error}") or type(error).__name__


MAX_FRAME_BYTES = 280
"""Header, 255 bytes of payload, checksum and signature of MAVLink 2."""


class FrameParser:
    """Parses a stream, whose frames may begin in one read and end in the next, or datagrams, which may be cut alike.

    The rest of the datagram before may be noise: it counts where more messages come out with it.
    """

    def __init__(self, *, is_stream: bool) -> None:
        self._is_stream = is_stream
        self.rest = b""
        """Bytes that wait for the rest of their frame."""

    def messages(self, data: bytes) -> list[Any]:
        """All messages that end in ``data``; other bytes are left out."""
        found, rest = _parsed(self.rest + data)
        if not self._is_stream and self.rest:
            alone, rest_alone = _parsed(data)
            if len(alone) > len(found):
                found, rest = alone, rest_alone
        self.rest = rest if len(rest) <= MAX_FRAME_BYTES else b""
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
