"""The whole script on the kernel's own TCP, between two network namespaces and through a program."""

import hashlib
import itertools
import json
import random
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from lab.link.carriers.pipe import DATAGRAM_HEADER_BYTES, Pipe
from lab.link.carriers.sides import GROUND_HOST, UnavailableError
from lab.link.carriers.tunnel import Flight, Tunnel
from lab.link.laboratory import Run, run
from lab.link.measures.outcome import measures
from lab.link.script import load_scenario
from lab.link.timeline import LinkState, Phase, Script
from media.pictures import write_scene
from programs.processes import eventually

pytestmark = pytest.mark.integration

RECEIVE = """
import hashlib, json, socket
with socket.create_server(("", 7000)) as listener:
    print("up", flush=True)
    far, _ = listener.accept()
    came, digest = 0, hashlib.sha256()
    while data := far.recv(65536):
        came += len(data)
        digest.update(data)
    print(json.dumps([came, digest.hexdigest()]))
"""
SEND = """
import random, socket, sys
near = socket.create_connection((sys.argv[1], 7000))
near.sendall(random.Random(1).randbytes(int(sys.argv[2])))
"""
ECHO = """
import socket
with socket.create_server(("", 7000)) as listener:
    print("up", flush=True)
    far, _ = listener.accept()
    far.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    while data := far.recv(65536):
        far.sendall(data)
    print("null")
"""
PING = """
import json, socket, sys, time
near = socket.create_connection((sys.argv[1], 7000))
near.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
trips = []
for _ in range(3):
    began = time.monotonic()
    near.sendall(b"x")
    near.recv(1)
    trips.append(time.monotonic() - began)
print(json.dumps(trips))
"""
LISTEN = """
import socket
one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
one.bind(("", 7000))
print("up", flush=True)
while True:
    print(int.from_bytes(one.recv(2000)[:4], "big"), flush=True)
"""
UTTER = """
import json, socket, sys, time
one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
print("up", flush=True)
for line in sys.stdin:  # first number, how many, pause
    first, count, pause = json.loads(line)
    sent = []
    for number in range(first, first + count):
        one.sendto(number.to_bytes(4, "big") + bytes(96), (sys.argv[1], 7000))
        sent.append([number, time.time()])
        time.sleep(pause)
    print(json.dumps(sent), flush=True)
"""
SHOUT = """
import socket, sys
one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
one.sendto(b"there?", (sys.argv[1], 7000))
"""
EDGE = "--source-fps 10 --fps 10 --size 320x180 --preset ultrafast --detector motion"
UTTERED_BYTES = 100 + DATAGRAM_HEADER_BYTES


def script(*pieces: tuple[float, LinkState], lasts_s: float = 60.0) -> Script:
    return Script(tuple(Phase(at, state) for at, state in pieces), lasts_s=lasts_s, queue_bytes=64_000)


@contextmanager
def tunnel(wanted: Script, **more):
    """The link, or the reason why there is none here."""
    try:
        one = Tunnel(wanted, **more)
        with one:
            yield one
    except UnavailableError as error:
        pytest.skip(str(error))


@contextmanager
def program(link: Tunnel, side: str, text: str, *arguments: str):
    """A Python program on one side, once it says that it is up; killed at the end."""
    command = [*link.prefix(side), sys.executable, "-c", text, *arguments]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as one:
        try:
            assert one.stdout.readline() == "up\n"
            yield one
        finally:
            one.kill()


def over(wanted: Script, *, ground: str, edge: str, arguments: tuple[str, ...] = ()):
    """Both programs over the script from its begin; what each printed, and the link."""
    with tunnel(wanted) as link, program(link, "ground", ground) as far:
        link.begin()
        near = subprocess.run(
            [*link.prefix("edge"), sys.executable, "-c", edge, GROUND_HOST, *arguments],
            check=True,
            capture_output=True,
            text=True,
        )
        said = far.communicate()[0]
    return json.loads(said), json.loads(near.stdout or "null"), link


@contextmanager
def datagrams(link: Tunnel):
    """Numbered datagrams from edge to ground: what sends so many and says the Unix time of each; and which came."""
    came: set[int] = set()
    with program(link, "ground", LISTEN) as far, program(link, "edge", UTTER, GROUND_HOST) as near:

        def send(first: int, count: int, *, pause_s: float = 0.0) -> dict[int, float]:
            near.stdin.write(json.dumps([first, count, pause_s]) + "\n")
            near.stdin.flush()
            return dict(json.loads(near.stdout.readline()))

        listening = threading.Thread(target=lambda: came.update(map(int, far.stdout)), daemon=True)
        listening.start()
        try:
            yield send, came
        finally:
            far.kill()
            listening.join()


def test_tcp_brings_every_byte_through_loss():
    """A tunnel that spoils packets would be taken for a bad link."""
    light = LinkState(20_000_000, delay_s=0.005)
    wanted = script((0, light), (0.001, LinkState(20_000_000, delay_s=0.005, loss=0.05)))
    (came, digest), _, link = over(wanted, ground=RECEIVE, edge=SEND, arguments=("600000",))
    assert came == 600_000
    assert digest == hashlib.sha256(random.Random(1).randbytes(600_000)).hexdigest()
    assert link.up.lost > 0
    assert link.up.passed_bytes > 600_000


def test_a_round_trip_takes_twice_the_delay():
    """A satellite would be as near as the next room."""
    _, trips, _ = over(script((0, LinkState(20_000_000, delay_s=0.1))), ground=ECHO, edge=PING)
    assert len(trips) == 3
    assert min(trips) >= 0.2


def test_darkness_is_dark():
    """An outage would be none; what is sent at its end may come, as the thread is not always quick."""
    # A sender that is stopped sends nothing in the dark, a carrier that is stopped carries later; a leak is in each.
    assert any(dark(light_s) for light_s in (3.0, 12.0, 40.0))


def dark(light_s: float) -> bool:
    """Whether of what was sent before the last half of the darkness nothing has come, when later things have."""
    there, away = LinkState(5_000_000, delay_s=0.02), LinkState(5_000_000, delay_s=0.02, dark=True)
    with tunnel(script((0, away), (light_s, there))) as link, datagrams(link) as (send, came):
        send(0, 10)
        eventually(lambda: came == set(range(10)), what="all came")
        began_s = link.begin()
        sent = send(10, 50, pause_s=0.01)
        in_darkness = {number for number, at_s in sent.items() if at_s < began_s + light_s / 2}
        later = itertools.count(60)
        eventually(lambda: send(next(later), 1, pause_s=0.05) and max(came) >= 60)
        return bool(in_darkness) and not came & in_darkness and link.up.dropped >= len(in_darkness)


def test_the_seed_says_which_packets_are_lost():
    """Two flights over one link would not be comparable."""
    rough = LinkState(50_000_000, loss=0.3)
    wanted, numbers = script((0, rough)), range(300)
    pipe = Pipe(wanted, seed="7-up")
    expected = {number for number in numbers if pipe.datagram(UTTERED_BYTES, 0.001 * number) is not None}
    with tunnel(wanted, seed=7) as link, datagrams(link) as (send, came):
        link.begin()
        time.sleep(0.2)
        send(0, len(numbers), pause_s=0.001)
        eventually(lambda: came >= expected, what="what is expected came")
        time.sleep(0.2)  # for any that should not come
        assert came == expected
    assert 50 < len(expected) < 290


def test_nothing_is_left_behind():
    """The machine would fill with namespaces, devices, descriptors and threads."""
    with tunnel(script((0, LinkState(5_000_000)))) as link:
        there = subprocess.check_output([*link.prefix("edge"), "ip", "link"], text=True)
        assert link.devices["edge"] in there
        names = list(link.names.values())
        assert all(name in _namespaces() for name in names)
        assert [target for target in _open_files() if "/dev/net/tun" in target]
    assert not any(name in _namespaces() for name in names)
    left = subprocess.check_output(["ip", "link"], text=True)
    assert not any(device in left for device in link.devices.values())
    assert not any("/dev/net/tun" in target for target in _open_files())
    assert "link-tunnel" not in [thread.name for thread in threading.enumerate()]


def test_without_what_it_needs_it_says_so_and_leaves_nothing(monkeypatch):
    """In a container without /dev/net/tun, or without iproute2, `make link CARRIER=tun` would end in a traceback."""
    with tunnel(script((0, LinkState(1)))):
        pass
    one = Tunnel(script((0, LinkState(1))), clone="/nonexistent/tun")
    with pytest.raises(UnavailableError, match="/nonexistent/tun"), one:
        pass
    assert not any(name in _namespaces() for name in one.names.values())
    monkeypatch.setenv("PATH", "/nonexistent")
    with pytest.raises(UnavailableError, match="needs the command ip"), Tunnel(script((0, LinkState(1)))):
        pass


def test_what_breaks_on_the_way_is_heard_of():
    """A flight over a carrier that has died would be told as an outage."""

    def broken() -> None:
        with tunnel(script((0, LinkState(5_000_000)))) as link:
            subprocess.run(["ip", "netns", "delete", link.names["ground"]], check=True)
            subprocess.run([*link.prefix("edge"), sys.executable, "-c", SHOUT, GROUND_HOST], check=False)
            names = lambda: [thread.name for thread in threading.enumerate()]  # noqa: E731
            eventually(lambda: "link-tunnel" not in names(), what="the carrier ends")

    with pytest.raises(OSError, match="in bad state"):
        broken()


def test_what_is_on_its_way_comes_by_time_and_is_bounded():
    """A link of some seconds' delay would fill the memory, and jitter would turn packets into others."""
    flight = Flight(3)
    assert flight.next_s == float("inf")
    assert flight.put(b"late", to=1, arrives_s=3.0)
    assert flight.put(b"first", to=2, arrives_s=1.0)
    assert flight.put(b"second", to=1, arrives_s=1.0)
    assert not flight.put(b"too many", to=1, arrives_s=0.5)
    assert flight.next_s == 1.0
    assert list(flight.due(2.0)) == [(2, b"first"), (1, b"second")]
    assert list(flight.due(2.0)) == []
    assert list(flight.due(3.0)) == [(1, b"late")]


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("carrier", "name", "transport"), [("tun", "burst-loss-udp", "udp"), ("netns", "steady-300k", "tcp")]
)
def test_edge_and_ground_fly_over_the_kernels_own_packets(tmp_path, carrier, name, transport):
    """The relay's model would be kind where the real thing is not, and datagrams never be flown."""
    (tmp_path / "scene").mkdir()
    write_scene(tmp_path / "scene", frames=300)
    with tunnel(script((0, LinkState(1)))):
        pass  # or skipped
    outcome = run(
        Run(
            scenario=load_scenario(name),
            source=str(tmp_path / "scene"),
            folder=tmp_path / "flight",
            length="short",
            carrier=carrier,
            edge_arguments=EDGE.split(),
            ground_arguments=["--detector", "motion", "--classifier", "none"],
        )
    )
    assert outcome.exit_codes == {"edge": 0, "ground": 0}, outcome.said
    assert not [text for text in outcome.said.values() if "Traceback" in text]
    assert f"{transport}/{GROUND_HOST}" in outcome.said["ground"]
    found = measures(outcome)
    assert found["frame delay p50, ms"] >= 1e3 * outcome.script.at(0).delay_s
    if transport == "tcp":
        assert (found["ledger difference, bytes"], found["decodable frames, %"]) == (0, 100)
    assert not psutil.Process().children(recursive=True), "a night of runs would fill the machine"


def _namespaces() -> str:
    return subprocess.check_output(["ip", "netns", "list"], text=True)


def _open_files() -> list[str]:
    return [str(one.readlink()) for one in Path("/proc/self/fd").iterdir() if one.is_symlink()]
