"""The web server: a thread of its own with a loop of its own, whose end nobody waits long for."""

from __future__ import annotations

import asyncio
import fcntl
import logging
import socket
import ssl
import struct
import threading
import time
from array import array
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, Self
from urllib.parse import urlsplit

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from hvt_common.errors import NotYetError, UserError, listening_trouble, may_come
from hvt_common.protocol.messages import Info
from hvt_common.runtime.failures import Awaited, Failures, reason_of
from hvt_common.runtime.host_names import host_and_port, is_loopback
from hvt_common.runtime.process import lower_priority
from hvt_ground.control import EdgeClient
from hvt_ground.events import Refinement
from hvt_ground.extras import Flight, Opening, Service
from hvt_ground.report.state import GroundState
from hvt_web.access import Access, crowding, own_tokens
from hvt_web.feed import SessionFeed, state_loads, state_message, still_name
from hvt_web.requests import EdgeRequests
from hvt_web.site import MOST_MESSAGE_BYTES, make_site
from hvt_web.viewers import EdgePage, Hub

MOST_CONNECTIONS = 256
MOST_OPEN = MOST_CONNECTIONS + 64
"""With those that are told that it is too many, or are in the middle of TLS."""
REQUEST_S = 10.0
"""The longest time of a client for TLS, and from an answer to the next whole request."""
STALL_S = 20.0
"""The longest time that a client may take none of the sent bytes."""
_PART = "web page"
_CLOSE_S = 5.0
"""The longest time of a closed connection for the rest."""
_END_S = 2.0
_LIST_ADDRESSES, _ROW_BYTES = 0x8912, 40 if struct.calcsize("P") == 8 else 32
"""SIOCGIFCONF and struct ifreq of netdevice(7)."""
_MOST_ADDRESSES = 3
_PAUSE_S = 5.0
"""The longest pause before a failed view is tried again."""


class WebPage(Service):
    """Serves the page at ``address`` (HOST:PORT) while the context lasts; ``clock`` is the ground's.

    An address that is not there yet, or a port that is not free, is waited for; without ``failures`` nobody hears.

    ``keys``, a certificate and its key, encrypt it beyond loopback. ``proxy`` is the host for which a reverse proxy
    on this machine answers. Raises `UserError` where the address, the tokens or the keys cannot be used.
    """

    part = _PART

    def __init__(
        self,
        address: str,
        *,
        clock: Callable[[], int],
        failures: Failures | None = None,
        keys: tuple[Path, Path] | None = None,
        proxy: str | None = None,
    ) -> None:
        host, port = host_and_port(address, name="--web", example="127.0.0.1:8080")
        if proxy is not None:
            _check_proxy(proxy, address, local=is_loopback(host))
        tokens = {} if is_loopback(host) else own_tokens()
        keys = keys if tokens else None
        if keys is not None:
            _check_keys(*keys)
        self._clock = clock
        self._failures = failures or Failures(clock)
        self._socket = Awaited(lambda: _bound(host, port), _PART, self._failures)
        self._stop = threading.Event()
        everywhere = host in ("0.0.0.0", "::")  # noqa: S104
        shown = socket.gethostname() if everywhere else f"[{host}]" if ":" in host else host
        start = f"{'http' if keys is None else 'https'}://{shown}:{port}/"
        self.address = start if proxy is None else f"https://{proxy}/"
        """Without a token."""
        self.shown_to_others = "" if proxy is None and not tokens else self.address
        scheme = start.partition(":")[0]
        others = [f"{scheme}://{one}:{port}/" for one in own_addresses()] if everywhere else []
        by_token = tuple(
            " or ".join(f"{where}?token={token}" for where in (start, *others)) + f" ({role})"
            for role, token in tokens.items()
        )
        self.links = by_token or (self.address,)
        """The links to open, one for each role."""
        self._client: EdgeClient | None = None
        self._loop = asyncio.new_event_loop()
        self._hub = Hub(self._loop)
        config = uvicorn.Config(
            make_site(Access(tokens, proxy), self._hub, EdgeRequests(self._control), clock=clock),
            ssl_certfile=None if keys is None else keys[0],
            ssl_keyfile=None if keys is None else keys[1],
            http=_BoundedProtocol,
            ws=_BoundedSocket,
            loop="asyncio",
            lifespan="off",
            proxy_headers=False,  # anybody may write them: one viewer would come from any number of addresses
            log_config=None,
            access_log=False,
            ws_max_size=MOST_MESSAGE_BYTES,
            ws_per_message_deflate=False,
            h11_max_incomplete_event_size=16384,
            timeout_keep_alive=round(REQUEST_S),
            timeout_graceful_shutdown=1,
            server_header=False,
        )
        logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)  # of bad requests
        self._server = _Server(config)
        self._thread = threading.Thread(target=self._run, name="hvt-web", daemon=True)

    def begin(self, client: EdgeClient) -> None:
        self._client = client

    def sinks(self, flight: Flight) -> Iterable[Opening]:
        opens = self.feed(flight.info)

        def give_way_and_open() -> SessionFeed:
            lower_priority()  # viewers never slow down the flight
            return opens()

        yield Opening(
            f"web page of {flight.info.edge}", give_way_and_open, waits=False, longest_pause_s=_PAUSE_S
        )

    def feed(self, info: Info) -> Callable[[], SessionFeed]:
        """Make the function that opens a sink for a session, in the sink's thread."""
        page = EdgePage(info.edge)
        return lambda: SessionFeed(info, page, self._hub, clock=self._clock)

    def still_address(self, info: Info, still: Refinement) -> str:
        """The address of a still's picture, as long as the page has it; without a token."""
        return f"{self.address}stills/{info.edge}/{still_name(info, still)}/still"

    def show(self, state: GroundState) -> None:
        """Give out how all edges are; for any thread."""
        message, loads = state_message(state), state_loads(state)
        known = frozenset(one.edge for one in state.edges)
        self._hub.post(lambda: self._hub.state(message, loads, known=known))

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._server.should_exit = True
        self._thread.join(_END_S + 1)

    def _control(self) -> EdgeClient:
        if self._client is None:
            raise UserError("the link is not open yet")
        return self._client

    def _run(self) -> None:
        try:
            with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
                runner.run(self._served())
        except Exception as error:  # noqa: BLE001 - the flight goes on, its status has it
            self._failures.failed(_PART, reason_of(error))

    async def _served(self) -> None:
        # Sessions' posts are taken meanwhile.
        bound = await asyncio.to_thread(self._socket.wait, self._stop)
        if bound is not None:
            with bound:
                await self._server.serve(sockets=[bound])


class _Listener(socket.socket):
    # Before TLS: each has a descriptor of the process. Who has fewer gets a place of who has most.

    _open: list[tuple[socket.socket, str]] | None = None

    def accept(self) -> tuple[socket.socket, Any]:
        """As of the base class; asyncio tries again after a `ConnectionAbortedError`."""
        connection, address = super().accept()
        self._open = [one for one in self._open or () if one[0].fileno() >= 0]
        if len(self._open) >= MOST_OPEN:
            crowd = crowding((one for _, one in self._open), address[0])
            if crowd is None:
                connection.close()
                raise ConnectionAbortedError
            last = max(at for at, (_, one) in enumerate(self._open) if one == crowd)
            with suppress(OSError):
                self._open.pop(last)[0].shutdown(socket.SHUT_RDWR)
        self._open.append((connection, address[0]))
        return connection, address


class _Server(uvicorn.Server):
    # One whose handshakes end, and that cuts off who does not take the rest of a closed connection.

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self._closing: dict[object, float] = {}

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Without lifespan; uvicorn's own leaves a silent TLS connection a minute."""
        config, loop = self.config, asyncio.get_running_loop()
        handshake_s, shutdown_s = (REQUEST_S, _CLOSE_S) if config.ssl else (None, None)

        def protocol() -> asyncio.Protocol:
            return _BoundedProtocol(config=config, server_state=self.server_state, app_state={}, _loop=loop)

        self.servers = [
            await loop.create_server(
                protocol,
                sock=one,
                ssl=config.ssl,
                ssl_handshake_timeout=handshake_s,
                ssl_shutdown_timeout=shutdown_s,
            )
            for one in sockets or ()
        ]
        self.started = True

    async def on_tick(self, counter: int) -> bool:
        """Each tenth of a second."""
        now_s = time.monotonic()
        transports = [one.transport for one in self.server_state.connections if one.transport.is_closing()]
        self._closing = {one: self._closing.get(one, now_s) for one in transports}
        for one in transports:
            if now_s - self._closing[one] > _CLOSE_S:
                one.abort()
        return await super().on_tick(counter)


class _NoStall(asyncio.Protocol):
    # Ends a connection whose other side takes nothing: closing it would wait for it.

    transport: asyncio.Transport
    loop: asyncio.AbstractEventLoop
    _stalled: asyncio.TimerHandle | None = None

    def pause_writing(self) -> None:
        super().pause_writing()
        self._stalled = self.loop.call_later(STALL_S, self.transport.abort)

    def resume_writing(self) -> None:
        super().resume_writing()
        if self._stalled is not None:
            self._stalled.cancel()


class _BoundedSocket(_NoStall, WebSocketsSansIOProtocol):
    """A viewer's."""


class _BoundedProtocol(_NoStall, H11Protocol):
    # Closes connections that ask for nothing, or never come to the end of it.

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        if len(self.connections) > MOST_CONNECTIONS and not self._take_place():
            transport.write(
                b"HTTP/1.1 503 Service Unavailable\r\ncontent-length: 0\r\nconnection: close\r\n\r\n"
            )
            transport.close()
            return
        self._await_request(None)

    def _take_place(self) -> bool:
        # The place of the address with most connections; False where that is this client's.
        known: set[Any] = set(self.connections)
        others = {
            one: one.client[0]
            for one in known
            if one is not self and one.client and not one.transport.is_closing()
        }
        crowd = crowding(others.values(), self.client[0]) if self.client else None
        if crowd is None:
            return False
        next(one for one, place in others.items() if place == crowd).transport.abort()
        return True

    def on_response_complete(self) -> None:
        answered = self.cycle
        super().on_response_complete()
        self._await_request(answered)

    def _await_request(self, before: object) -> None:
        # A byte now and then is no request.
        self.loop.call_later(REQUEST_S, self._close_silent, before)

    def _close_silent(self, before: object) -> None:
        if self.cycle is before and self.transport.get_protocol() is self:
            self.transport.abort()


def own_addresses() -> list[str]:
    """IPv4 addresses of this machine beside loopback, the first few: a network may have no name server."""
    rows = array("B", bytes(_ROW_BYTES * 64))
    where, size_bytes = rows.buffer_info()
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            answer = fcntl.ioctl(probe, _LIST_ADDRESSES, struct.pack("iP", size_bytes, where))
    except OSError:  # this is no Linux
        return []
    used_bytes = struct.unpack("iP", answer)[0]
    known = (socket.inet_ntoa(rows[at + 20 : at + 24].tobytes()) for at in range(0, used_bytes, _ROW_BYTES))
    return [one for one in dict.fromkeys(known) if not is_loopback(one)][:_MOST_ADDRESSES]


def _check_proxy(proxy: str, address: str, *, local: bool) -> None:
    if not local:
        raise UserError(
            f"--web-proxy {proxy} needs a page on this machine alone, and --web is {address}: give "
            "127.0.0.1 as its host"
        )
    if urlsplit(f"//{proxy}").hostname != proxy:
        raise UserError(f"--web-proxy {proxy!r} is not accepted: give a host, such as hvt.example.org")


def _no_password() -> str:
    # OpenSSL would wait for it at the terminal, for ever.
    raise ssl.SSLError("the key is encrypted: a key without a password is needed")


def _check_keys(certificate: Path, key: Path) -> None:
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    try:
        context.load_cert_chain(certificate, key, password=_no_password)
    except (OSError, ssl.SSLError) as error:
        raise UserError(
            f"--web cannot use the keys {certificate} and {key} ({error.strerror or error})"
        ) from None


def _bound(host: str, port: int) -> socket.socket:
    made: socket.socket | None = None
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, *_, where = found[0]
        made = _Listener(family, socket.SOCK_STREAM)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind(where)
        made.listen(128)
    except OSError as error:
        if made is not None:
            made.close()
        kind = NotYetError if may_come(error) else UserError
        raise kind(f"--web {host}:{port} cannot be listened on: {listening_trouble(error)}") from None
    made.setblocking(False)
    return made
