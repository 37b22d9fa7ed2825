"""Two network namespaces whose packets pass through a program: the kernel's own TCP on the whole script.

Each side has a TUN device. One thread takes every IP packet that leaves one side, asks `pipe` when and whether
it arrives, and hands it to the other side then: rate, queue, delay, jitter, loss, reordering and darkness come from
the script and its seed, with no help from the kernel's netem. To TCP a full queue is a loss, as at any router.
"""

from __future__ import annotations

import fcntl
import heapq
import os
import selectors
import struct
import time
from collections.abc import Iterator

from lab.link.carriers.pipe import Pipe
from lab.link.carriers.sides import EDGE_HOST, GROUND_HOST, Sides, command
from lab.link.timeline import Script

_TUNSETIFF = 0x400454CA
_IFF_TUN = 0x0001
_IFF_NO_PI = 0x1000
"""From linux/if_tun.h. Without IFF_VNET_HDR the kernel cuts its super-packets before it hands them over."""
_MTU_BYTES = 1500
_MOST_PACKETS = 16_384
"""On their way in both directions together: 25 MB at most."""
_AT_ONCE = 64
"""Taken from one device before the other has its turn."""
_STOP_CHECK_S = 0.05
"""How often the thread looks whether it is to stop, when nothing comes."""
_IPV4 = 4


class Tunnel(Sides):
    """The namespaces of edge and ground, joined by a forwarding thread. A context manager that removes all of it.

    Before `begin` the link is as in the script's first moment and loses nothing.

    Attributes:
        up, down: the pipe from edge to ground, and the one back.
        devices: the names of the TUN devices, by side.
        left_out: packets that came while as many as may be were on their way.

    Raises:
        UnavailableError: iproute2, /dev/net/tun or the rights are missing.
    """

    def __init__(self, script: Script, *, seed: int = 0, clone: str = "/dev/net/tun") -> None:
        super().__init__()
        self._clone = clone
        self.devices = {side: f"hvt{self._token}{side[0]}" for side in ("edge", "ground")}
        self._script = script
        self._playing = script.still()
        self.up = Pipe(self._playing, seed=f"{seed}-up")
        self.down = Pipe(self._playing, seed=f"{seed}-down")
        self.left_out = 0
        self._descriptors: dict[str, int] = {}

    def begin(self) -> float:
        """The script begins now; return the Unix time."""
        # The thread takes it up before its next packet.
        self._playing = self._script.shifted(time.monotonic())
        return time.time()

    def _build(self) -> None:
        for side, own, peer in (("edge", EDGE_HOST, GROUND_HOST), ("ground", GROUND_HOST, EDGE_HOST)):
            space, device = self.names[side], self.devices[side]
            self._descriptors[side] = _device(device, clone=self._clone)
            command("ip", "link", "set", "dev", device, "netns", space)
            command("ip", "-n", space, "address", "add", own, "peer", peer, "dev", device)
            command("ip", "-n", space, "link", "set", "dev", device, "mtu", str(_MTU_BYTES), "up")
        self._start(self._forward, name="link-tunnel")

    def _leave(self) -> None:
        super()._leave()
        while self._descriptors:
            os.close(self._descriptors.popitem()[1])  # with its descriptor a device goes

    def _forward(self) -> None:
        edge, ground = self._descriptors["edge"], self._descriptors["ground"]
        flight = Flight(_MOST_PACKETS)
        # select() takes microseconds; epoll would round every arrival up to the next millisecond.
        with selectors.SelectSelector() as devices:
            devices.register(edge, selectors.EVENT_READ, (self.up, ground))
            devices.register(ground, selectors.EVENT_READ, (self.down, edge))
            while not self._stop.is_set():
                wait_s = min(_STOP_CHECK_S, flight.next_s - time.monotonic())
                ready = devices.select(max(0.0, wait_s))
                for key, _ in ready:
                    pipe, to = key.data
                    self._offer(key.fd, pipe, to, flight)
                for to, packet in flight.due(time.monotonic()):
                    os.write(to, packet)

    def _offer(self, device: int, pipe: Pipe, to: int, flight: Flight) -> None:
        for _ in range(_AT_ONCE):
            try:
                packet = os.read(device, _MTU_BYTES)
            except BlockingIOError:
                return
            if packet[0] >> 4 != _IPV4:
                continue  # IPv6 announcements of a new device are none of the script's packets
            pipe.script = self._playing
            arrives_s = pipe.datagram(len(packet), time.monotonic())
            if arrives_s is not None:
                self.left_out += not flight.put(packet, to=to, arrives_s=arrives_s)


class Flight:
    """Packets on their way, by the time of arrival; their number is bounded."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._heap: list[tuple[float, int, int, bytes]] = []
        self._number = 0
        """Orders packets that arrive at one moment: the first sent comes first."""

    def put(self, packet: bytes, *, to: int, arrives_s: float) -> bool:
        """Send it on its way; False where too many are."""
        if len(self._heap) >= self._most:
            return False
        self._number += 1
        heapq.heappush(self._heap, (arrives_s, self._number, to, packet))
        return True

    @property
    def next_s(self) -> float:
        """When the next one arrives; infinite where none does."""
        return self._heap[0][0] if self._heap else float("inf")

    def due(self, now_s: float) -> Iterator[tuple[int, bytes]]:
        """Take out arrived packets: where to, and the packet."""
        while self.next_s <= now_s:
            _, _, to, packet = heapq.heappop(self._heap)
            yield to, packet


def _device(name: str, *, clone: str) -> int:
    """A new TUN device; its file descriptor, which does not block."""
    device = os.open(clone, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _IFF_TUN | _IFF_NO_PI))
    except OSError as error:
        os.close(device)
        raise OSError(error.errno, error.strerror, clone) from None
    return device
