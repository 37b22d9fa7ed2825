"""A bad link between two programs of one machine, for where network namespaces are not to be had.

``with Relay(script, protocol="tcp", target_port=7447) as relay:`` listens on ``relay.port`` of loopback and passes on
to the target all packets that `pipe` lets through, in a thread of its own. Before `Relay.begin` the link is as in the
script's first moment and loses nothing. By hand: ``python -m lab.link.carriers.relay SCENARIO --target 7447``.

Memory is bounded: one queue of the script's size a direction, and for each of at most 32 connections the bytes in
flight. Where the queue is full, TCP is not read (back-pressure to the sender's socket), UDP is dropped.
"""

import argparse
import asyncio
import contextlib
import logging
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal, Self

from hvt_common.errors import exit_with_sentence
from lab.link.carriers.pipe import (
    DATAGRAM_HEADER_BYTES,
    SEGMENT_BYTES,
    SEGMENT_HEADER_BYTES,
    Pipe,
    Segment,
    Stream,
)
from lab.link.script import LENGTHS, load_scenario
from lab.link.timeline import Script

_log = logging.getLogger(__name__)

Protocol = Literal["tcp", "udp"]

_MOST_CONNECTIONS = 32
_SOCKET_BYTES = 8192
"""Buffer of the relay's own receiving sockets: bytes that wait do so where the sender notices it."""
_FLIGHT_SEGMENTS = 256
"""Most segments of a connection under way: the receive window of the far end, 370 kB."""
_FLIGHT_DATAGRAMS = 4096
_OUTLIVES_SCRIPT_S = 120.0
_CLOSE_WAIT = 8
"""Linux's number of the TCP state in which the peer has closed."""


class Relay:
    """A TCP or UDP relay between a port of its own and another of loopback. A context manager; ends by itself.

    Attributes:
        port: where it listens, on 127.0.0.1.
        up, down: the pipe towards the target, and the one back.
    """

    def __init__(
        self, script: Script, *, protocol: Protocol = "tcp", target_port: int, port: int = 0, seed: int = 0
    ) -> None:
        self._script = script
        self._target = ("127.0.0.1", target_port)
        self._protocol = protocol
        self._wanted_port = port
        self.port = 0
        self.up = Pipe(script.still(), seed=f"{seed}-up")
        self.down = Pipe(script.still(), seed=f"{seed}-down")
        self.connections = 0
        self._loop = asyncio.new_event_loop()
        self._stop = asyncio.Event()
        self._ready = threading.Event()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="link-relay", daemon=True)

    def begin(self) -> float:
        """The script begins now; return the Unix time."""
        script = self._script.shifted(time.monotonic())

        def start() -> None:
            self.up.script = self.down.script = script

        self._loop.call_soon_threadsafe(start)
        return time.time()

    def __enter__(self) -> Self:
        self._thread.start()
        self._ready.wait(10)
        if self._error is not None:
            raise self._error
        return self

    def __exit__(self, _kind: object, error: object, _trace: object) -> None:
        if self._thread.is_alive():
            with contextlib.suppress(RuntimeError):  # it may just have ended by itself
                self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(10)
        if self._error is not None and error is None:
            raise self._error

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._serve())
        except BaseException as error:  # noqa: BLE001 - raised where the relay is left
            self._error = error
        finally:
            self._ready.set()
            self._loop.close()

    async def _serve(self) -> None:
        ends_s = time.monotonic() + self._script.lasts_s + _OUTLIVES_SCRIPT_S
        serve = _tcp if self._protocol == "tcp" else _udp
        async with asyncio.TaskGroup() as group:
            serving = group.create_task(serve(self, group))
            while time.monotonic() < ends_s and not self._stop.is_set() and not serving.done():
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._stop.wait(), 1.0)
            # Whatever runs in the group is cancelled with it.
            for task in asyncio.all_tasks():
                if task is not asyncio.current_task():
                    task.cancel()

    def listening(self, port: int) -> None:
        """Say where (called by the relay's own thread)."""
        self.port = port
        self._ready.set()


# TCP


async def _tcp(relay: Relay, group: asyncio.TaskGroup) -> None:
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SOCKET_BYTES)  # inherited by accepted sockets
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, SEGMENT_BYTES)
    listener.setblocking(False)
    with listener:
        listener.bind(("127.0.0.1", relay._wanted_port))
        listener.listen(_MOST_CONNECTIONS)
        relay.listening(listener.getsockname()[1])
        loop = asyncio.get_running_loop()
        open_now: set[asyncio.Task[None]] = set()
        while True:
            near, _ = await loop.sock_accept(listener)
            if len(open_now) >= _MOST_CONNECTIONS:
                near.close()
                continue
            relay.connections += 1
            task = group.create_task(_connection(relay, near))
            open_now.add(task)
            task.add_done_callback(open_now.discard)


async def _connection(relay: Relay, near: socket.socket) -> None:
    near.setblocking(False)
    # In darkness a first packet is lost too: who connects then hears nothing until the link is back.
    await _until(relay.up.script.light_s(time.monotonic()))
    if near.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0] == _CLOSE_WAIT:
        near.close()  # who has given up meanwhile was never heard of at the other end
        return
    far = socket.socket()
    far.setblocking(False)
    far.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SOCKET_BYTES)
    far.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, SEGMENT_BYTES)
    for one in (near, far):
        one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    with near, far:
        try:
            await asyncio.get_running_loop().sock_connect(far, relay._target)
            # One way may end before the other; an error ends both.
            async with asyncio.TaskGroup() as ways:
                ways.create_task(_way(near, far, relay.up))
                ways.create_task(_way(far, near, relay.down))
        except* OSError as ended:
            _log.debug("a connection ended: %s", ended.exceptions)


@dataclass(frozen=True, slots=True)
class _Flight:
    """Packets on their way, oldest first."""

    queue: asyncio.Queue[tuple[Segment, bytes]] = field(
        default_factory=lambda: asyncio.Queue(_FLIGHT_SEGMENTS)
    )
    later_sent: asyncio.Event = field(default_factory=asyncio.Event)
    """Another segment is on its way: those that were lost before it may come at another time."""


async def _way(source: socket.socket, sink: socket.socket, pipe: Pipe) -> None:
    flight = _Flight()
    async with asyncio.TaskGroup() as group:
        group.create_task(_offer(source, flight, pipe))
        group.create_task(_deliver(sink, flight))


async def _offer(source: socket.socket, flight: _Flight, pipe: Pipe) -> None:
    stream, loop = Stream(pipe), asyncio.get_running_loop()
    while True:
        data = await loop.sock_recv(source, SEGMENT_BYTES)
        size = len(data) + SEGMENT_HEADER_BYTES
        while (at_s := _admitted_s(pipe, stream, size)) > time.monotonic():
            await _until(at_s)
        segment = stream.segment(size, time.monotonic())
        flight.later_sent.set()
        await flight.queue.put((segment, data))
        if not data:
            return


def _admitted_s(pipe: Pipe, stream: Stream, size_bytes: int) -> float:
    now_s = time.monotonic()
    return max(stream.may_send_s(now_s), pipe.fits_at_s(size_bytes, now_s))


async def _deliver(sink: socket.socket, flight: _Flight) -> None:
    loop = asyncio.get_running_loop()
    while True:
        segment, data = await flight.queue.get()
        while (wait_s := segment.arrives_s - time.monotonic()) > 0:
            flight.later_sent.clear()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await flight.later_sent.wait()
        if not data:
            sink.shutdown(socket.SHUT_WR)
            return
        await loop.sock_sendall(sink, data)


async def _until(at_s: float) -> None:
    await asyncio.sleep(max(0.0, at_s - time.monotonic()))


# UDP


async def _udp(relay: Relay, _group: asyncio.TaskGroup) -> None:
    with contextlib.ExitStack() as sockets:
        near = sockets.enter_context(_datagram_socket())
        near.bind(("127.0.0.1", relay._wanted_port))
        relay.listening(near.getsockname()[1])
        forwarder = _Datagrams(relay, near, sockets)
        try:
            await asyncio.Event().wait()
        finally:
            forwarder.close()


class _Datagrams:
    """Hands datagrams on; every client has a socket towards the target."""

    def __init__(self, relay: Relay, near: socket.socket, sockets: contextlib.ExitStack) -> None:
        self._relay = relay
        self._near = near
        self._sockets = sockets
        self._loop = asyncio.get_running_loop()
        self._clients: dict[tuple[str, int], socket.socket] = {}
        self._in_flight = 0
        self._loop.add_reader(near, self._from_client)

    def close(self) -> None:
        for one in (self._near, *self._clients.values()):
            self._loop.remove_reader(one)

    def _from_client(self) -> None:
        with contextlib.suppress(OSError):
            data, address = self._near.recvfrom(65536)
            far = self._clients.get(address) or self._open(address)
            if far is not None:
                self._carry(self._relay.up, data, far.send)

    def _open(self, address: tuple[str, int]) -> socket.socket | None:
        if len(self._clients) >= _MOST_CONNECTIONS:
            return None
        self._relay.connections += 1
        far = self._clients[address] = self._sockets.enter_context(_datagram_socket())
        far.connect(self._relay._target)
        self._loop.add_reader(far, self._from_target, far, address)
        return far

    def _from_target(self, far: socket.socket, address: tuple[str, int]) -> None:
        with contextlib.suppress(OSError):
            self._carry(self._relay.down, far.recv(65536), lambda data: self._near.sendto(data, address))

    def _carry(self, pipe: Pipe, data: bytes, send: Callable[[bytes], object]) -> None:
        now_s = time.monotonic()
        arrives_s = pipe.datagram(len(data) + DATAGRAM_HEADER_BYTES, now_s)
        if arrives_s is not None and self._in_flight < _FLIGHT_DATAGRAMS:
            self._in_flight += 1
            self._loop.call_later(max(0.0, arrives_s - now_s), self._land, data, send)

    def _land(self, data: bytes, send: Callable[[bytes], object]) -> None:
        self._in_flight -= 1
        with contextlib.suppress(OSError):  # nobody listens there now
            send(data)


def _datagram_socket() -> socket.socket:
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    one.setblocking(False)
    return one


# By hand


def main(argv: Sequence[str] | None = None) -> int:
    """``python -m lab.link.carriers.relay SCENARIO --target PORT``."""
    return exit_with_sentence(_by_hand, program="link.relay", argv=argv)


def _by_hand(argv: Sequence[str] | None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenario", help="a name, or a file that ends in .toml")
    parser.add_argument("--target", type=int, required=True, help="port of 127.0.0.1 that it passes on to")
    parser.add_argument("--port", type=int, default=0, help="where it listens [a free one]")
    parser.add_argument("--protocol", choices=["tcp", "udp"], default="tcp")
    parser.add_argument("--length", choices=LENGTHS, default="full")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args(argv)
    script = load_scenario(arguments.scenario).script(arguments.length, seed=arguments.seed)
    with Relay(
        script,
        protocol=arguments.protocol,
        target_port=arguments.target,
        port=arguments.port,
        seed=arguments.seed,
    ) as relay:
        print(
            f"listening on {arguments.protocol}/127.0.0.1:{relay.port}; Enter begins the script", flush=True
        )
        sys.stdin.readline()
        relay.begin()
        with contextlib.suppress(KeyboardInterrupt):
            time.sleep(script.lasts_s)
    print(f"passed {relay.up.passed_bytes} bytes there, {relay.down.passed_bytes} back")
    return 0


if __name__ == "__main__":
    sys.exit(main())
