"""The ledger's bytes against the kernel's, on a link between two network namespaces."""

import array
import fcntl
import json
import os
import shutil
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from hvt_common.protocol.channels import DELIVERIES, Channel, EdgeKeys
from hvt_common.protocol.ledger import overhead_bytes
from hvt_common.transport.inbox import Inbox
from hvt_common.transport.session import declare_publisher, open_session, subscribe
from hvt_common.transport.zenoh_config import LinkSettings

# Time that passes is keep-alives that are counted.
pytestmark = [pytest.mark.integration, pytest.mark.realtime]

KEYS = EdgeKeys("uav-1")
ATTACHMENT_BYTES = 39
ETHERNET_BYTES = 14
SIZES = (200, 830, 1_600, 5_400, 12_000, 30_000)
MESSAGES = 12
STRAY_BYTES = 4 * 52
"""Bare acknowledgements of the other side's keep-alives while one size is sent; the ledger leaves them out."""


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)


@pytest.fixture
def namespaces() -> Iterator[tuple[str, str]]:
    """Two network namespaces joined by a veth pair: 10.99.0.1 on ``veth-a``, 10.99.0.2 on ``veth-b``."""
    if shutil.which("ip") is None:
        pytest.skip("needs the ip command of iproute2")
    names = (f"hvt-{os.getpid()}-a", f"hvt-{os.getpid()}-b")
    try:
        ip("netns", "add", names[0])
    except subprocess.CalledProcessError as error:
        pytest.skip(f"may not make a network namespace: {error.stderr.strip()}")
    try:
        ip("netns", "add", names[1])
        pair = ("veth-a", "netns", names[0], "type", "veth", "peer", "name", "veth-b", "netns", names[1])
        ip("link", "add", *pair)
        ends = ("veth-a", "10.99.0.1/30"), ("veth-b", "10.99.0.2/30")
        for name, (end, address) in zip(names, ends, strict=True):
            ip("-n", name, "address", "add", address, "dev", end)
            # No neighbour discovery of IPv6 among the counted packets.
            no_ipv6 = "echo 1 > /proc/sys/net/ipv6/conf/all/disable_ipv6"
            within = ["ip", "netns", "exec", name, "sh", "-c", no_ipv6]
            subprocess.run(within, check=False, capture_output=True)
            ip("-n", name, "link", "set", "lo", "up")
            ip("-n", name, "link", "set", end, "up")
        yield names
    finally:
        for name in names:
            subprocess.run(["ip", "netns", "delete", name], check=False, capture_output=True)


def measure(names: tuple[str, str], links: int) -> list[dict]:
    """Run the two processes of this file and return what the sender wrote: one row for each size."""

    def process(namespace: str, *arguments: str) -> subprocess.Popen:
        command = ["ip", "netns", "exec", namespace, sys.executable, __file__, *arguments]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
        return subprocess.Popen(
            command, stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True, env=environment
        )

    endpoint = "tcp/10.99.0.2:7447"
    listener = process(names[1], "listen", endpoint)
    try:
        assert listener.stdout.readline() == "up\n"
        sender = process(names[0], "send", endpoint, "veth-a", str(links))
        out, _ = sender.communicate()
        assert sender.returncode == 0
    finally:
        listener.communicate("stop\n", timeout=20)
    return json.loads(out)


@pytest.mark.parametrize("links", [1, 2])
def test_the_ledger_agrees_with_the_kernel_on_a_link(namespaces, links):
    """The budget would be held on paper while the radio carries more."""
    rows = measure(namespaces, links)
    assert [row["size"] for row in rows] == list(SIZES)
    for row in rows:
        share = 0.01 * row["ip_bytes"]
        assert -share <= row["ip_bytes"] - row["ledger_bytes"] <= share + STRAY_BYTES
    video = [row for row in rows if row["size"] >= 1_600]
    on_device = sum(row["device_bytes"] for row in video)
    assert on_device == pytest.approx(sum(row["ledger_bytes"] for row in video), rel=0.03)


def listen(endpoint: str) -> None:
    with open_session(LinkSettings("ground", listen=(endpoint,), insecure=True)) as session:
        subscriber = subscribe(session, "hvt/*/base", put=Inbox(capacity=1).put)
        print("up", flush=True)
        sys.stdin.readline()
        subscriber.undeclare()


def send(endpoint: str, device: str, links: str) -> None:
    """Send some messages of each size at 15 a second and print what the kernel and the ledger counted."""
    _segment_in_software(device)
    rows = []
    with open_session(LinkSettings("edge", connect=(endpoint,), links=2 if links == "2" else 1)) as session:
        publisher = declare_publisher(session, Channel.BASE, keys=KEYS)
        while not publisher.matching_status.matching:
            time.sleep(0.01)
        time.sleep(0.5)
        for size in SIZES:
            before = _counters(device)
            for _ in range(MESSAGES):
                publisher.put(bytes(size), attachment=bytes(ATTACHMENT_BYTES))
                time.sleep(1 / 15)
            time.sleep(0.1)
            device_bytes, packets = (now - then for now, then in zip(_counters(device), before, strict=True))
            encoding = DELIVERIES[Channel.BASE].encoding
            overhead = overhead_bytes(size, ATTACHMENT_BYTES, key=KEYS[Channel.BASE], encoding=encoding)
            row = {
                "size": size,
                "device_bytes": device_bytes,
                "ip_bytes": device_bytes - ETHERNET_BYTES * packets,
            }
            rows.append(row | {"ledger_bytes": MESSAGES * (size + ATTACHMENT_BYTES + overhead)})
    print(json.dumps(rows), flush=True)


def _counters(device: str) -> tuple[int, int]:
    folder = Path("/sys/class/net", device, "statistics")
    return int((folder / "tx_bytes").read_text()), int((folder / "tx_packets").read_text())


def _segment_in_software(device: str) -> None:
    """Without this a veth counts 64 kB super-packets, as no real link carries them."""
    siocethtool, set_tso, set_gso = 0x8946, 0x1F, 0x24
    with socket.socket() as any_socket:
        for command in (set_tso, set_gso):
            value = array.array("B", struct.pack("II", command, 0))
            request = struct.pack("16sP", device.encode(), value.buffer_info()[0])
            fcntl.ioctl(any_socket.fileno(), siocethtool, request)


if __name__ == "__main__":
    {"listen": listen, "send": send}[sys.argv[1]](*sys.argv[2:])
