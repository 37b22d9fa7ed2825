"""Frees Zenoh of TCP sockets that a dark line leaves behind (Linux only: /proc says which they are)."""

from __future__ import annotations

import atexit
import os
import re
import socket
import struct
import threading
import time
from collections.abc import Callable, Container, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self

import zenoh

from hvt_common.runtime.failures import Failures
from hvt_common.transport.own_sockets import (
    LISTENING,
    TCP_TABLES,
    end_in_table,
    end_of_name,
    ends_of,
    own_sockets,
)
from hvt_common.transport.zenoh_config import connect_endpoints, end_of

_LISTENER = "listener"
_EVERY_S = 0.25
_DEAF_EVERY_S, _DEAF_CHECKS = 1.0, 5
_TYPES = {"udp": socket.SOCK_DGRAM, "quic": socket.SOCK_DGRAM}
_TIMESTAMPS, _BOUND_INTERFACE = 35, 62
"""SO_TIMESTAMPNS and SO_BINDTOIFINDEX of Linux."""
_HANGS_S = 0.5
"""A handshake that lasts longer is doubted: the place is probed, and again at this interval."""
_PROBE_S = 3.0
_LINGER, _NO_LINGER = struct.pack("ii", 1, 10), struct.pack("ii", 0, 0)
_LAST_DATA_RECEIVED = 52
"""Offset of ``tcpi_last_data_recv`` (ms) in Linux's ``struct tcp_info``."""
_FAMILIES = (socket.AF_INET, socket.AF_INET6)
_CONNECTS, _NEW = 2, 7
_UNCONNECTED = (_CONNECTS, _NEW, 10)
"""States of Linux's TCP: a socket that connects, is new or listens has no other end that it could name."""
_INIT_SYN = bytes((4, 0, 0x01, 0x09, 0x01, 0x01))
"""The first message of Zenoh's protocol 9: its length, InitSyn, the version, a peer, its id of one byte. Whatever
listens there answers: Zenoh with an InitAck, TLS with an alert."""


@dataclass(frozen=True, slots=True)
class Connection:
    """One line of the kernel's table; an end is like ``10.0.0.2:7447`` or ``[::1]:7447``."""

    ours: str
    theirs: str
    inode: int


def connections(table: Path, *, inodes: Container[str] | None = None) -> Iterator[Connection]:
    """The sockets in one of `TCP_TABLES` but listening ones; with ``inodes`` only those, quickly out of thousands."""
    for line in table.read_text(encoding="ascii").splitlines()[1:]:
        _, ours, theirs, state, *_, inode = line.split(maxsplit=10)[:10]
        if state != LISTENING and (inodes is None or inode in inodes):
            yield Connection(end_in_table(ours), end_in_table(theirs), int(inode))


class StaleSockets:
    """Watches the sockets of one session, in a thread; a context manager, left before the session is closed.

    Zenoh (1.10) closes with SO_LINGER: while nobody acknowledges the last bytes, close(2) holds one of its few
    threads for ten seconds, and with it the next connection, at either end, and others' messages. And a handshake
    that began in darkness has all of ``open_timeout``, even if the line is back: a tunnel or proxy on the way may
    have accepted it, and says nothing. So no socket lingers, and a handshake that hangs is shut down as soon as a
    probe that began after it was answered, and it was not: on a slow line the older has its answer first. The next
    one has its full time, should the other side be slow. Of a name with several addresses the first, where
    it is dark, would take all of ``open_timeout`` each time: it is shut down as soon as another one answers.

    A listener that hears nothing any more has failed, and ``failures`` says so: Zenoh's of UDP stands still for ever
    where two datagrams wait from a link that ended while the program was stopped, and one that is bound to an
    interface does not survive it. Nothing but another session helps: ``on_deaf()`` is told, once.

    Other sockets of the process are none of its business, even where they are connected to the same place: Zenoh's
    have the send buffer that its configuration says. A link of any session here is no handshake.
    """

    _sessions: ClassVar[list[zenoh.Session]] = []
    """All that are watched in this process."""

    def __init__(
        self,
        session: zenoh.Session,
        config: zenoh.Config,
        failures: Failures,
        *,
        on_deaf: Callable[[], None] | None = None,
    ) -> None:
        self._session = session
        self._failures = failures
        self._on_deaf = on_deaf
        self._open_s = int(config.get_json("transport/unicast/open_timeout")) / 1000
        self._tables = [one for one in TCP_TABLES if one.exists()]
        self._places = {end_of(one) for one in connect_endpoints(config)}
        self._ports = {one.rpartition(":")[2] for one in self._places}
        self._buffers = {_given_buffer(size) for size in _send_buffers(config)} if self._tables else set()
        self._known: dict[int, bool] = {}
        """Sockets of this process, and whether each is one of Zenoh's."""
        self._done: set[int] = set()
        """Sockets that linger no more."""
        self._pending_s: dict[int, float] = {}
        """Handshakes, and when each was first seen."""
        self._probed_s: dict[str, float] = {}
        self._answered_s: dict[str, float] = {}
        """When the last probe of a place began that was answered."""
        self._same_name: dict[str, list[str]] = {}
        """The other addresses of a name, of a place that was probed."""
        self._spare_until_s = 0.0
        listen = re.findall(r'"((\w+)/[^"]*?:(\d+)(?=["?#])[^"]*)', config.get_json("listen/endpoints"))
        self._listen_ports = {(_TYPES.get(kind, socket.SOCK_STREAM), int(port)) for _, kind, port in listen}
        """Type of the socket, and port."""
        self._deaf_ports = {
            (_TYPES.get(kind, socket.SOCK_STREAM), int(port))
            for one, kind, port in listen
            if kind == "udp" or re.search(r"%|\biface=", one)
        }
        """Of listeners that may go deaf."""
        self._first: dict[int, tuple[bytes, int]] = {}
        """What waits first at each UDP listener, and for how many checks."""
        self._next_deaf_s = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hvt-sockets", daemon=True)

    def __enter__(self) -> Self:
        if self._tables:
            self._sessions.append(self._session)
            self._thread.start()
            atexit.register(self._end)  # where nobody leaves: Python would end it within Zenoh, and abort
        return self

    def __exit__(self, *_: object) -> None:
        if self._tables:
            atexit.unregister(self._end)
            self._sessions.remove(self._session)
            self._end()

    def _end(self) -> None:
        self._stop.set()
        self._thread.join(1.0)

    def _run(self) -> None:
        while not self._stop.wait(_EVERY_S):
            with suppress(Exception):  # such as no thread for a probe: the next time is soon
                self._check(time.monotonic())

    def _check(self, now_s: float) -> None:
        if now_s >= self._next_deaf_s:
            self._next_deaf_s = now_s + _DEAF_EVERY_S
            self.check_listeners()
        own = self._zenohs()
        self._done = {inode for inode, fd in own.items() if inode in self._done or _linger_ended(fd, inode)}
        if not self._ports:
            return
        links = {(end_of(link.src), end_of(link.dst)) for link in self._links()}
        here = {}
        if any(self._may_hang(fd, inode, links) for inode, fd in own.items()):
            # 5 ms: the kernel goes through all places that the machine's connections might have.
            inodes = set(map(str, own))
            here = {one.inode: one for table in self._tables for one in connections(table, inodes=inodes)}
        pending = {
            inode: one.theirs
            for inode, one in here.items()
            if (one.ours, one.theirs) not in links and one.theirs.rpartition(":")[2] in self._ports
        }
        self._pending_s = {inode: self._pending_s.get(inode, now_s) for inode in pending}
        for inode, theirs in pending.items():
            if now_s - max(self._pending_s[inode], self._probed_s.get(theirs, 0.0)) >= _HANGS_S:
                self._probed_s[theirs] = now_s
                for probe in (self._probe, self._probe_others):
                    threading.Thread(target=probe, args=[theirs], name="hvt-probe", daemon=True).start()
        dark = [one for one, theirs in pending.items() if self._is_dark(own[one], one, theirs)]
        stale = [inode for inode, theirs in pending.items() if self._is_stale(own[inode], inode, theirs)]
        if stale and now_s > self._spare_until_s:
            self._spare_until_s = now_s + 2 * self._open_s  # the next begins after a pause
            dark += stale
        for inode in dark:
            _shut_down(own[inode], inode)

    def check_listeners(self) -> None:
        """Say of a listener that it hears nothing any more; call it about once a second."""
        if self._on_deaf is None or not self._deaf_ports:
            return
        deaf, before, self._first = set(), self._first, {}
        interfaces = {0, *(index for index, _ in socket.if_nameindex())}
        for inode, fd in own_sockets().items():
            with suppress(OSError), same_socket(fd, inode) as one:
                if not _is_listener(one, self._deaf_ports):
                    continue
                end = end_of_name(one.getsockname())
                if _interface_of(one) not in interfaces:
                    deaf.add(f"{end} hears nothing any more, since its interface was removed")
                elif one.type == socket.SOCK_DGRAM and (first := _first_of(one)):
                    known, checks = before.get(inode, (b"", 0))
                    self._first[inode] = first, checks + 1 if first == known else 0
                    if self._first[inode][1] >= _DEAF_CHECKS:
                        why = "is not read any more, as may happen to a program that was stopped for some seconds"
                        deaf.add(f"what comes to udp {end} {why}")
        if deaf:
            self._failures.failed(_LISTENER, f"{', '.join(sorted(deaf))}: the link is made anew", last=True)
            self._free_ports()
            self._on_deaf()
            self._on_deaf = None

    def _free_ports(self) -> None:
        # Zenoh cannot close a session whose listener stands still, and the next one could not listen: leave it
        # sockets without a port, and end its other links, or those at their other ends would stay with it.
        for inode, fd in own_sockets().items():
            with suppress(OSError), same_socket(fd, inode) as one:
                if _is_listener(one, self._listen_ports):
                    with socket.socket(one.family, one.type) as other:
                        os.dup2(other.fileno(), fd, inheritable=False)
                elif one.family in _FAMILIES and _type_and_port(one) in self._listen_ports:
                    one.shutdown(socket.SHUT_RDWR)

    def _zenohs(self) -> dict[int, int]:
        # Inode → descriptor. Each socket is looked at once: a host program may have thousands.
        own = own_sockets()
        self._known = {inode: self._known[inode] for inode in own.keys() & self._known.keys()}
        for inode in own.keys() - self._known.keys():
            with suppress(OSError), same_socket(own[inode], inode) as one:
                if one.family not in _FAMILIES or one.type != socket.SOCK_STREAM:
                    self._known[inode] = False
                elif _state(one) != _NEW:  # else it may get its buffer yet
                    size = one.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF)
                    self._known[inode] = size in self._buffers
        return {inode: fd for inode, fd in own.items() if self._known.get(inode)}

    def _links(self) -> Iterator[zenoh.Link]:
        for session in list(self._sessions):
            with suppress(zenoh.ZError):  # closed elsewhere
                yield from session.info.links()

    def _may_hang(self, fd: int, inode: int, links: Container[tuple[str, str]]) -> bool:
        with suppress(OSError), same_socket(fd, inode) as one:
            if (state := _state(one)) in _UNCONNECTED:
                return state == _CONNECTS
            ours, theirs = (end_of_name(name) for name in (one.getsockname(), one.getpeername()))
            return theirs.rpartition(":")[2] in self._ports and (ours, theirs) not in links
        return False

    def _is_stale(self, fd: int, inode: int, theirs: str) -> bool:
        answered_s = self._answered_s.get(theirs, 0.0)
        return self._pending_s[inode] < answered_s and _received_s(fd, inode) < answered_s

    def _is_dark(self, fd: int, inode: int, theirs: str) -> bool:
        others_s = [self._answered_s.get(one, 0.0) for one in self._same_name.get(theirs, ())]
        with suppress(OSError), same_socket(fd, inode) as one:
            return _state(one) == _CONNECTS and self._pending_s[inode] < max(others_s, default=0.0)
        return False

    def _probe_others(self, theirs: str) -> None:
        for place in self._places:
            ends = ends_of(place)
            if theirs in ends:
                self._same_name[theirs] = sorted(ends - {theirs})
        for one in self._same_name.get(theirs, ()):
            threading.Thread(target=self._probe, args=[one], name="hvt-probe", daemon=True).start()

    def _probe(self, theirs: str) -> None:
        began_s = time.monotonic()
        host, _, port = theirs.rpartition(":")
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with suppress(OSError), socket.socket(family) as probe:
            probe.settimeout(_PROBE_S)
            probe.connect((host.strip("[]"), int(port)))
            probe.sendall(_INIT_SYN)
            probe.recv(1)  # hung up: somebody was there, too
            self._answered_s[theirs] = max(began_s, self._answered_s.get(theirs, 0.0))


def _send_buffers(config: zenoh.Config) -> list[int]:
    # Those that a configuration gives its sockets; an endpoint may have its own.
    texts = [config.get_json(f"transport/link/{kind}/so_sndbuf") for kind in ("tcp", "tls")]
    for side in ("connect", "listen"):
        texts += re.findall(r"so_sndbuf=(\d+)", config.get_json(f"{side}/endpoints"))
    return [int(text) for text in texts if text.isdigit()]


def _given_buffer(size: int) -> int:
    # The size that the kernel really gives.
    with socket.socket() as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, min(size, 2**31 - 1))
        return one.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF)


def _is_listener(one: socket.socket, ports: Container[tuple[int, int]]) -> bool:
    if one.family not in _FAMILIES or _type_and_port(one) not in ports:
        return False
    datagrams = one.type == socket.SOCK_DGRAM
    return datagrams or bool(one.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN))


def _type_and_port(one: socket.socket) -> tuple[int, int]:
    return one.type, one.getsockname()[1]


def _interface_of(one: socket.socket) -> int:
    with suppress(OSError):  # Linux before 5.1
        return one.getsockopt(socket.SOL_SOCKET, _BOUND_INTERFACE)
    return 0


def _first_of(one: socket.socket) -> bytes:
    # When the datagram came that waits there first, which tells it from all others; empty where none does.
    peek = socket.MSG_PEEK | socket.MSG_DONTWAIT
    with suppress(BlockingIOError):
        one.recvmsg(1, 0, peek)
        one.setsockopt(socket.SOL_SOCKET, _TIMESTAMPS, 1)
        try:
            return b"".join(data for *_, data in one.recvmsg(1, 64, peek)[1])
        finally:  # Zenoh's buffer has room for the address alone at which a datagram came
            one.setsockopt(socket.SOL_SOCKET, _TIMESTAMPS, 0)
    return b""


def _state(one: socket.socket) -> int:
    return one.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0]


@contextmanager
def same_socket(fd: int, inode: int) -> Iterator[socket.socket]:
    """The socket of that descriptor; OSError where that is another's: Zenoh may close its own at any moment."""
    _check_same(fd, inode)  # closing a mere copy of a file would end all locks that this process has on it
    copy = os.dup(fd)
    try:
        _check_same(copy, inode)
        one = socket.socket(fileno=copy)
    except OSError:
        os.close(copy)
        raise
    with one:
        yield one


def _check_same(fd: int, inode: int) -> None:
    if os.fstat(fd).st_ino != inode:
        raise OSError("closed meanwhile")


def _linger_ended(fd: int, inode: int) -> bool:
    with suppress(OSError), same_socket(fd, inode) as one:
        if one.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, len(_LINGER)) == _LINGER:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _NO_LINGER)
            return True
    return False


def _shut_down(fd: int, inode: int) -> None:
    with suppress(OSError), same_socket(fd, inode) as one:
        one.shutdown(socket.SHUT_RDWR)


def _received_s(fd: int, inode: int) -> float:
    # When data came last, else when it was connected; long ago for a socket that still connects.
    with suppress(OSError), same_socket(fd, inode) as one:
        info = one.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 104)
        (ago_ms,) = struct.unpack_from("=I", info, _LAST_DATA_RECEIVED)
        return time.monotonic() - float(ago_ms) / 1000
    return time.monotonic()
