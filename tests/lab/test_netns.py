"""The same script on the kernel's own TCP, between two network namespaces."""

from __future__ import annotations

import subprocess
import sys

import pytest

from lab.link.carriers.netns import GROUND_HOST, Namespaces, UnavailableError
from lab.link.timeline import LinkState, Phase, Script

pytestmark = pytest.mark.integration

RECEIVE = """
import socket, sys, time
with socket.create_server(("", 7000)) as listener:
    print("up", flush=True)
    far, _ = listener.accept()
    while data := far.recv(65536):
        print(time.time(), len(data))
"""
SEND = """
import socket, sys, time
near = socket.socket()
near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 8192)
near.connect((sys.argv[1], 7000))
ends = time.time() + float(sys.argv[2])
while time.time() < ends:
    near.sendall(bytes(1448))
"""
COUNT = """
import socket
one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
one.bind(("", 7000))
print("up", flush=True)
one.settimeout(10)
came = 0
try:
    while True:
        came += len(one.recv(2000)) == 100
        one.settimeout(1)
except TimeoutError:
    print(came)
"""
FLOOD = """
import socket, sys, time
time.sleep(0.5)
one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
for _ in range(4000):
    one.sendto(bytes(100), (sys.argv[1], 7000))
    time.sleep(0.0004)
"""
ON_ETHERNET = 1448 / (1448 + 52 + 14)


@pytest.fixture
def wire_field():
    """Runs a sender as fast as TCP takes it over a script; returns when (after its begin) how many bytes came."""

    def run(script: Script, *, seconds: float) -> list[tuple[float, int]]:
        try:
            with Namespaces(script) as link:
                receiver = subprocess.Popen(
                    [*link.prefix("ground"), sys.executable, "-c", RECEIVE], stdout=subprocess.PIPE, text=True
                )
                assert receiver.stdout.readline() == "up\n"
                began_s = link.begin()
                send = [*link.prefix("edge"), sys.executable, "-c", SEND, GROUND_HOST, str(seconds)]
                try:
                    subprocess.run(send, check=True, timeout=30)
                    out, _ = receiver.communicate(timeout=30)
                finally:
                    receiver.kill()
        except UnavailableError as error:
            pytest.skip(str(error))
        return [(float(at) - began_s, int(size)) for at, size in map(str.split, out.splitlines())]

    return run


def script(*pieces: tuple[float, LinkState], lasts_s: float) -> Script:
    """A script by hand."""
    return Script(tuple(Phase(at, state) for at, state in pieces), lasts_s=lasts_s, queue_bytes=16_000)


def namespaces() -> str:
    """All that there are on the machine."""
    return subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=True).stdout


def bps(got, begin_s: float, end_s: float) -> float:
    """Payload bits a second in a span."""
    return 8 * sum(size for at, size in got if begin_s <= at < end_s) / (end_s - begin_s)


def test_the_shaper_follows_the_script(wire_field):
    """The one carrier with a real TCP would be another link than the relay's."""
    line = script((0, LinkState(1_000_000)), (3, LinkState(400_000)), lasts_s=6)
    got = wire_field(line, seconds=6)
    assert bps(got, 1, 3) == pytest.approx(1_000_000 * ON_ETHERNET, rel=0.03)
    assert bps(got, 3.5, 6) == pytest.approx(400_000 * ON_ETHERNET, rel=0.03)


def test_a_link_that_is_down_carries_nothing(wire_field):
    """As the relay's darkness."""
    light = LinkState(2_000_000)
    line = script((0, light), (1, LinkState(2_000_000, dark=True)), (2, light), lasts_s=4)
    got = wire_field(line, seconds=4)
    assert bps(got, 0.3, 1.0) > 1e6
    assert bps(got, 1.1, 2.0) == 0
    assert bps(got, 3.0, 4.0) > 1e6


def test_loss_is_the_scripts_share():
    """Five percent of loss would be none. (Datagrams: under loss in both directions TCP's pace is a lottery)."""
    line = script((0, LinkState(20_000_000)), (0.01, LinkState(20_000_000, loss=0.1)), lasts_s=60)
    try:
        with Namespaces(line) as link:
            receive = [*link.prefix("ground"), sys.executable, "-c", COUNT]
            with subprocess.Popen(receive, stdout=subprocess.PIPE, text=True) as receiver:
                assert receiver.stdout.readline() == "up\n"
                link.begin()
                send = [*link.prefix("edge"), sys.executable, "-c", FLOOD, GROUND_HOST]
                subprocess.run(send, check=True, timeout=30)
                came = int(receiver.communicate(timeout=30)[0])
    except UnavailableError as error:
        pytest.skip(str(error))
    assert came / 4000 == pytest.approx(0.9, abs=0.02)


def test_nothing_is_left_behind():
    """The machine would fill with namespaces."""
    try:
        with Namespaces(script((0, LinkState(5_000_000)), lasts_s=1)) as link:
            link.begin()
            assert all(name in namespaces() for name in link.names.values())
    except UnavailableError as error:
        pytest.skip(str(error))
    assert not any(
        name in namespaces() for name in link.names.values()
    )  # another run may have some of its own


def test_what_is_missing_is_named(monkeypatch):
    """`make link CARRIER=netns` on a laptop would end in a traceback."""
    monkeypatch.setenv("PATH", "/nonexistent")
    with (
        pytest.raises(UnavailableError, match="needs the command ip"),
        Namespaces(script((0, LinkState(1)), lasts_s=1)),
    ):
        pass
