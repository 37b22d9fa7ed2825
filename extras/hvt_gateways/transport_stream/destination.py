"""Destinations of a transport stream: a file, UDP, or SRT if PyAV is built with it."""

from __future__ import annotations

import errno
import logging
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, Protocol
from urllib.parse import SplitResult, parse_qs, urlsplit

import av
import av.error

from hvt_common.errors import UserError, named_path, telling
from hvt_common.files import check_there, created, has_nothing
from hvt_common.runtime.host_names import is_group, with_small_scheme

_log = logging.getLogger(__name__)

_ACCEPTED: Final = "give FILE.ts, a folder that is there, udp://HOST:PORT or srt://HOST:PORT"
_PACKET_BYTES: Final = 188
_DATAGRAM_BYTES: Final = 7 * _PACKET_BYTES
"""The size of all senders of MPEG-TS: seven packets fit an Ethernet frame."""
_SRT_WAITS: Final = {"connect_timeout": "3000", "listen_timeout": "5000000", "timeout": "3000000"}
"""Milliseconds, microseconds, microseconds, as libavformat has them: by default it waits for ever."""


@dataclass(frozen=True, slots=True)
class Address:
    """The address of a receiver; ``{edge}`` in it stands for the edge's id."""

    url: str

    @property
    def scheme(self) -> Literal["udp", "srt"]:
        return "srt" if self.url.startswith("srt:") else "udp"

    @property
    def shown(self) -> str:
        """Without the query behind a question mark, which may hold a secret."""
        return self.url.partition("?")[0]

    def of_edge(self, edge: str) -> Address:
        return replace(self, url=self.url.replace("{edge}", edge))

    @property
    def srt_url(self) -> str:
        """With bounds on its waits."""
        given = parse_qs(urlsplit(self.url).query, keep_blank_values=True)
        waits = "&".join(f"{name}={value}" for name, value in _SRT_WAITS.items() if name not in given)
        return f"{self.url}{'&' if given else '?'}{waits}"


def destination(text: str) -> Address | Path:
    """The destination in ``--ts``, a path if it is no URL. `UserError` if it can be neither, or not be sent to."""
    if "://" not in text:
        path = named_path(text, name="--ts")
        if path.suffix != ".ts" and not path.is_dir():
            raise UserError(f"--ts {text} is none of what it may be: {_ACCEPTED}")
        return path
    parts = _split(text)
    address = Address(with_small_scheme(text))
    if parts.scheme == "udp":
        _ttl(parts, text)
    if parts.scheme not in ("udp", "srt") or not parts.hostname or parts.path.strip("/") or parts.username:
        raise UserError(f"--ts {address.shown} is none of what it may be: {_ACCEPTED}")
    if address.scheme == "srt" and not _has_srt():
        raise UserError(
            f"--ts {address.shown} needs SRT, and this PyAV {av.__version__} is built without it: "
            "give udp://HOST:PORT, which ffmpeg or a media server makes SRT of"
        )
    return address


def _split(text: str) -> SplitResult:
    try:
        parts = urlsplit(text.replace("{edge}", "edge"))
        port = parts.port
    except ValueError:
        port = None
    if not port:
        raise UserError(f"--ts {Address(text).shown} has no port from 1 to 65535: {_ACCEPTED}")
    return parts


def _ttl(parts: SplitResult, text: str) -> int:
    """Hops that multicast may take; 1 where nothing is said."""
    given = parse_qs(parts.query, keep_blank_values=True)
    ttl = given.pop("ttl", ["1"])[-1]
    if given or not ttl.isdecimal() or not 1 <= int(ttl) <= 255:
        raise UserError(
            f"--ts {Address(text).shown} says behind the question mark what is not known: ttl=1 to ttl=255 is"
        )
    return int(ttl)


def _has_srt() -> bool:
    """Whether libavformat knows the protocol; without a port it gives up before it does anything."""
    try:
        av.open("srt://127.0.0.1").close()
    except av.error.ProtocolNotFoundError:
        return False
    except (av.error.FFmpegError, OSError, ValueError):
        pass
    return True


class Addresses:
    """Those in use: two streams at one port would be none. For any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users: dict[str, str] = {}

    @contextmanager
    def taken(self, address: Address, *, edge: str) -> Iterator[None]:
        """Taken, and free again where the next steps fail; `UserError` where another stream goes there."""
        with self._lock:
            user = self._users.get(address.url)
            if user == edge:
                raise UserError(f"--ts {address.shown} is still taken by the session before")
            if user is not None:
                raise UserError(
                    f"--ts {address.shown} is taken by edge {user}: put {{edge}} into it, or give a folder"
                )
            self._users[address.url] = edge
        try:
            yield
        except BaseException:
            self.free(address)
            raise

    def free(self, address: Address) -> None:
        with self._lock:
            self._users.pop(address.url, None)


class Output(Protocol):
    """Takes whole packets of a transport stream, in runs."""

    def write(self, data: bytes) -> int:
        """Take them; how many bytes those were."""

    def close(self) -> None:
        """The last came; a second call does nothing."""


class AsynchronousKlv:
    """Calls the packets of KLV private stream 1, as MISB ST 1402 has it of asynchronous carriage.

    libavformat gives them that stream type, and the stream id of the synchronous one (0xFC); with the right id it
    leaves out the times, which many readers want.
    """

    def __init__(self, output: Output) -> None:
        self._output = output

    def write(self, data: bytes) -> int:
        named = bytearray(data)
        for at in range(0, len(data) - _PACKET_BYTES + 1, _PACKET_BYTES):
            begins, adapts = data[at + 1] & 0x40, data[at + 3] & 0x20
            head = at + 4 + (1 + data[at + 4] if adapts else 0)
            if begins and data[head : head + 4] == b"\0\0\1\xfc":
                named[head + 3] = 0xBD
        return self._output.write(bytes(named))

    def close(self) -> None:
        self._output.close()


class StreamFile:
    """A file; takes the place of one of that name. `UserError` where it cannot be written, or no further.

    One to which nothing could be written is removed: each try on a full disk would leave one more.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._leaves_none = path, has_nothing(path)
        with telling(f"MPEG-TS file {path} cannot be created: "):
            self._file = created(path)

    def write(self, data: bytes) -> int:
        left = memoryview(data)
        with telling(f"MPEG-TS file {self._path} cannot be written any further: "):
            check_there(self._file, self._path)
            while left:
                left = left[os.write(self._file, left) :]
                self._leaves_none = False
        return len(data)

    def close(self) -> None:
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
            if self._leaves_none and has_nothing(self._path):
                self._path.unlink(missing_ok=True)


class Datagrams:
    """UDP to one host or group; never waits. `UserError` where the name leads nowhere.

    A datagram that the network does not take is lost, and that is said once: the receiver may come later.
    """

    def __init__(self, address: Address) -> None:
        parts = _split(address.url)
        assert parts.port is not None, "else it is refused"
        try:
            family, kind, protocol, _, where = socket.getaddrinfo(
                parts.hostname, parts.port, type=socket.SOCK_DGRAM
            )[0]
        except (OSError, UnicodeError) as error:
            reason = (error.strerror if isinstance(error, OSError) else None) or error
            raise UserError(f"--ts {address.shown} has no host that can be found: {reason}") from None
        self._shown = address.shown
        self._said = False
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setblocking(False)
        ttl = _ttl(parts, address.url)
        if family == socket.AF_INET6:
            self._socket.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS, ttl)
        else:
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, ttl)
        self._where = where

    def write(self, data: bytes) -> int:
        for begin in range(0, len(data), _DATAGRAM_BYTES):
            try:
                self._socket.sendto(data[begin : begin + _DATAGRAM_BYTES], self._where)
            except OSError as error:
                if not self._said:
                    self._said = True
                    why = error.strerror
                    if error.errno == errno.ENETUNREACH and is_group(str(self._where[0])):
                        why = "no route leads to the group (ip route add 224.0.0.0/4 dev INTERFACE makes one)"
                    _log.warning("%s does not take all: %s; what is lost is lost", self._shown, why)
        return len(data)

    def close(self) -> None:
        self._socket.close()
