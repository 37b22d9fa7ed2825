"""The same script on the kernel's own TCP, between two network namespaces."""

import subprocess
import sys
from itertools import accumulate

import pytest

from lab.link.carriers.netns import Namespaces
from lab.link.carriers.sides import GROUND_HOST, UnavailableError
from lab.link.timeline import LinkState, Phase, Script
from programs.processes import eventually

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
one.settimeout(60)
came = 0
while (data := one.recv(2000)) != b"end":
    came += len(data) == 100
print(came)
"""
FLOOD = """
import socket, sys, time
one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
for _ in range(4000):
    one.sendto(bytes(100), (sys.argv[1], 7000))
    time.sleep(0.0004)
for _ in range(50):  # not all are lost
    one.sendto(b"end", (sys.argv[1], 7000))
"""
BURST_BYTES = 8_000
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
                    subprocess.run(send, check=True)
                    out, _ = receiver.communicate()
                finally:
                    receiver.kill()
        except UnavailableError as error:
            pytest.skip(str(error))
        return [(float(at) - began_s, int(size)) for at, size in map(str.split, out.splitlines())]

    return run


def script(*pieces: tuple[float, LinkState], lasts_s: float) -> Script:
    return Script(tuple(Phase(at, state) for at, state in pieces), lasts_s=lasts_s, queue_bytes=16_000)


def test_the_shaper_follows_the_script(wire_field):
    """The one carrier with a real TCP would be another link than the relay's: kinder, or no link at all."""
    slow_bps, rate_bps, step_s = 400_000, 1_000_000, 1.0
    line = script((0, LinkState(slow_bps)), (step_s, LinkState(rate_bps)), lasts_s=60)

    def line_bits(at_s: float) -> float:
        return slow_bps * min(at_s, step_s) + rate_bps * max(0.0, at_s - step_s)

    def is_filled() -> bool:
        got = wire_field(line, seconds=2.5)
        # A reader that is stopped reads late, and so does the script: neither makes the link quicker.
        for (at_s, _), size in zip(got, accumulate(size for _, size in got), strict=True):
            assert 8 * size <= 1.03 * ON_ETHERNET * line_bits(at_s) + 8 * BURST_BYTES
        return 8 * size > 0.6 * (line_bits(at_s) - line_bits(got[0][0]))

    assert any(is_filled() for _ in range(3)), "more than it was before the step, but where the sender stood"


def test_a_link_that_is_down_carries_nothing(wire_field):
    """As the relay's darkness."""
    states = (LinkState(2_000_000, dark=dark) for dark in (True, False))
    got = wire_field(script(*zip((0, 0.8), states, strict=True), lasts_s=2), seconds=0.2)
    assert got[0][0] >= 0.8
    assert sum(size for _, size in got) > 20_000


def test_loss_is_the_scripts_share():
    """Five percent of loss would be none. (Datagrams: under loss in both directions TCP's pace is a lottery)."""
    # A receiver that is stopped loses what its buffer does not hold.
    assert any(flooded_share() == pytest.approx(0.9, abs=0.02) for _ in range(3))


def flooded_share() -> float:
    """How much of a flood comes through a tenth of loss."""
    line = script((0, LinkState(20_000_000, loss=0.1)), lasts_s=60)
    try:
        with Namespaces(line) as link:
            receive = [*link.prefix("ground"), sys.executable, "-c", COUNT]
            with subprocess.Popen(receive, stdout=subprocess.PIPE, text=True) as receiver:
                assert receiver.stdout.readline() == "up\n"
                link.begin()
                rules = [*link.prefix("ground"), "iptables", "-S", "INPUT"]
                eventually(lambda: b"random" in subprocess.check_output(rules), what="it loses")
                send = [*link.prefix("edge"), sys.executable, "-c", FLOOD, GROUND_HOST]
                subprocess.run(send, check=True)
                return int(receiver.communicate()[0]) / 4000
    except UnavailableError as error:
        pytest.skip(str(error))
