"""The lab's own honesty: a relay that is kinder or harsher than its script would praise or blame HVT for nothing."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from itertools import pairwise

import psutil
import pytest

from link.pipe import DATAGRAM_HEADER_BYTES, SEGMENT_HEADER_BYTES, Pipe, Stream
from link.relay import Relay
from link.script import LinkState, Piece, Script

PACKET = 1200 + DATAGRAM_HEADER_BYTES


def script(*pieces: tuple[float, LinkState], lasts_s: float = 60.0, queue_bytes: int = 32_000) -> Script:
    """A script by hand."""
    return Script(tuple(Piece(at, state) for at, state in pieces), lasts_s=lasts_s, queue_bytes=queue_bytes)


def offered(pipe: Pipe, *, every_s: float, lasts_s: float) -> list[tuple[float, float | None]]:
    """Datagrams at a steady pace: when each was sent, and when it arrives."""
    return [(i * every_s, pipe.datagram(PACKET, i * every_s)) for i in range(int(lasts_s / every_s))]


@pytest.mark.parametrize("rate_bps", [200_000, 1_000_000])
def test_the_rate_is_the_scripts(rate_bps):
    """A link that carries a tenth more than said would hold bars that the radio does not."""
    pipe = Pipe(script((0, LinkState(rate_bps))), seed=1)
    got = [at for _, at in offered(pipe, every_s=0.004, lasts_s=20) if at is not None]
    assert 8 * PACKET * (len(got) - 1) / (got[-1] - got[0]) == pytest.approx(rate_bps, rel=0.03)


def test_the_rate_follows_a_step():
    """The step down would come late or half, and the adaptation look better than it is."""
    pipe = Pipe(script((0, LinkState(1_000_000)), (10, LinkState(200_000)), lasts_s=20), seed=1)
    got = [at for _, at in offered(pipe, every_s=0.004, lasts_s=20) if at is not None]
    for begin, end, rate_bps in ((2, 10, 1_000_000), (11, 20, 200_000)):
        passed = 8 * PACKET * sum(begin <= at < end for at in got) / (end - begin)
        assert passed == pytest.approx(rate_bps, rel=0.03)


def test_delay_and_jitter_are_within_their_bounds():
    """Delays of the product would be those of the lab."""
    state = LinkState(10_000_000, delay_s=0.05, jitter_s=0.02)
    own_s = 8 * PACKET / state.rate_bps
    delays = [
        at - sent - own_s for sent, at in offered(Pipe(script((0, state)), seed=1), every_s=0.01, lasts_s=10)
    ]
    assert min(delays) >= 0.05 - 1e-9
    assert max(delays) <= 0.07 + 1e-9
    assert sum(delays) / len(delays) == pytest.approx(0.06, abs=0.002)


def test_the_queue_is_bounded_and_seen_as_delay():
    """Bufferbloat is the enemy to be beaten: without a queue that fills there is nothing to beat."""
    pipe = Pipe(script((0, LinkState(1_000_000)), queue_bytes=25_000), seed=1)
    results = offered(pipe, every_s=0.005, lasts_s=5)
    waits = [at - sent for sent, at in results if at is not None]
    assert max(waits) == pytest.approx(8 * 25_000 / 1e6, rel=0.1)
    assert pipe.dropped == sum(at is None for _, at in results) > 0


def test_loss_and_reordering_are_the_scripts_share():
    """A bar at 5 % loss would be held at 2 %."""
    pipe = Pipe(script((0, LinkState(20_000_000, loss=0.05, reorder=0.1))), seed=3)
    arrivals = [at for _, at in offered(pipe, every_s=0.002, lasts_s=20)]
    assert sum(at is None for at in arrivals) / len(arrivals) == pytest.approx(0.05, abs=0.01)
    came = [at for at in arrivals if at is not None]
    late = sum(max(came[:i][-20:], default=0) > at for i, at in enumerate(came))
    assert late > 0.1 * len(came), "others overtake those that are held back"


def test_the_same_seed_decides_alike():
    """A failure could not be looked at twice."""
    state = LinkState(2_000_000, delay_s=0.02, jitter_s=0.01, loss=0.1, reorder=0.1)
    first, second, other = (
        offered(Pipe(script((0, state)), seed=seed), every_s=0.01, lasts_s=5) for seed in (1, 1, 2)
    )
    assert first == second != other


def test_darkness_is_black_for_datagrams():
    """An outage through which a few packets slip keeps leases alive that a real one ends."""
    light = LinkState(1_000_000, delay_s=0.02)
    pipe = Pipe(script((0, light), (4, LinkState(1_000_000, dark=True)), (7, light), lasts_s=10), seed=1)
    came = [at for _, at in offered(pipe, every_s=0.02, lasts_s=10) if at is not None]
    assert not [at for at in came if 4.03 < at < 7]
    assert max(b - a for a, b in pairwise(came)) == pytest.approx(3.0, abs=0.1)


def test_a_lost_segment_stalls_all_behind_it():
    """Over TCP a radio's loss is not a hole, but everything late at once."""
    stream = Stream(Pipe(script((0, LinkState(1_000_000, delay_s=0.02, loss=0.05))), seed=5))
    arrivals = [stream.segment(1000, i * 0.02) for i in range(500)]
    waits = [at - i * 0.02 for i, at in enumerate(arrivals)]
    assert arrivals == sorted(arrivals)
    stalled = [wait for wait in waits if wait > 0.1]
    assert len(stalled) > 0.05 * 500
    assert max(waits) <= 2 * (0.2 + 0.04 + 0.02) + 0.02
    assert min(waits) == pytest.approx(0.02 + 0.008, abs=1e-6)


def test_a_connection_wakes_from_darkness_at_a_retransmission():
    """Old connections sleep on after the radio is back; a lab without this would not show why to open a new one."""
    light = LinkState(1_000_000)
    stream = Stream(Pipe(script((0, light), (4, LinkState(1_000_000, dark=True)), (12, light)), seed=1))
    assert stream.may_send_s(3.9) == 3.9
    assert stream.may_send_s(4.0) == pytest.approx(4 + 0.2 * (2**6 - 1))


# Real sockets


def exchange(relay: Relay, listener: socket.socket, *, seconds: float) -> list[tuple[float, int]]:
    """Send through the relay as fast as it takes; return when how many bytes came."""
    got: list[tuple[float, int]] = []

    def receive() -> None:
        with listener.accept()[0] as far:
            while data := far.recv(65536):
                got.append((time.monotonic(), len(data)))

    thread = threading.Thread(target=receive)
    thread.start()
    with socket.socket() as near:
        near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 8192)
        near.connect(("127.0.0.1", relay.port))
        ends_s = time.monotonic() + seconds
        while time.monotonic() < ends_s:
            near.sendall(bytes(1000))
    thread.join(20)
    assert not thread.is_alive()
    return got


@pytest.fixture
def listener():
    """A program that listens."""
    with socket.create_server(("127.0.0.1", 0)) as one:
        yield one


def test_a_tcp_sender_is_held_to_the_rate(listener):
    """The back-pressure is what the edge's own queues have to feel."""
    line = script((0, LinkState(800_000, delay_s=0.03)), queue_bytes=8_000)
    with Relay(line, target_port=listener.getsockname()[1]) as relay:
        relay.begin()
        got = exchange(relay, listener, seconds=4)
    began, ended = got[0][0] + 0.5, got[-1][0]
    carried = sum(size for at, size in got if at > began) * 8 / (ended - began)
    goodput = 800_000 * 1448 / (1448 + SEGMENT_HEADER_BYTES)
    assert carried == pytest.approx(goodput, rel=0.05), "segments are not all full, so a little less"
    assert relay.up.passed_bytes * 8 / (ended - got[0][0]) == pytest.approx(800_000, rel=0.05)


def test_a_tcp_connection_is_dark_in_darkness(listener):
    """As above, on real sockets."""
    light = LinkState(2_000_000)
    line = script(
        (0, light), (1.0, LinkState(2_000_000, dark=True)), (1.5, light), lasts_s=3, queue_bytes=8_000
    )
    with Relay(line, target_port=listener.getsockname()[1]) as relay:
        began = time.monotonic()
        relay.begin()
        got = exchange(relay, listener, seconds=2.5)
    assert not [at - began for at, _ in got if 1.05 < at - began < 1.5]
    assert [at for at, _ in got if at - began > 1.6], "and light again after it"


def test_who_gave_up_in_darkness_was_never_there(listener):
    """The ground would be busy with the corpses of the edge's tries, and late for the living one."""
    light = LinkState(2_000_000)
    line = script((0, light), (0.1, LinkState(2_000_000, dark=True)), (0.8, light), lasts_s=2)
    with Relay(line, target_port=listener.getsockname()[1]) as relay:
        relay.begin()
        time.sleep(0.2)
        for _ in range(3):
            socket.create_connection(("127.0.0.1", relay.port)).close()
        with socket.create_connection(("127.0.0.1", relay.port)) as stays:
            stays.sendall(b"here")
            far, _ = listener.accept()
            with far:
                assert far.recv(10) == b"here"
        listener.settimeout(0.2)
        with pytest.raises(TimeoutError):
            listener.accept()


def test_datagrams_pass_both_ways_and_are_counted():
    """Over UDP nothing would come back."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as target:
        target.bind(("127.0.0.1", 0))
        target.settimeout(5)
        line = script((0, LinkState(1_000_000, delay_s=0.05)))
        with (
            Relay(line, protocol="udp", target_port=target.getsockname()[1]) as relay,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client,
        ):
            client.settimeout(5)
            began = time.monotonic()
            client.sendto(b"there", ("127.0.0.1", relay.port))
            data, address = target.recvfrom(100)
            target.sendto(data + b" and back", address)
            assert client.recv(100) == b"there and back"
            assert time.monotonic() - began >= 0.1
            assert relay.up.passed_bytes == 5 + DATAGRAM_HEADER_BYTES


def test_a_relay_leaves_nothing_behind(listener):
    """Hours of scenarios in one process would run out of threads and descriptors."""
    own = psutil.Process()
    line = script((0, LinkState(50_000_000)))
    for _ in range(2):  # the first may open what Python keeps
        before = own.num_fds(), threading.enumerate()
        with Relay(line, target_port=listener.getsockname()[1]) as relay:
            exchange(relay, listener, seconds=0.1)
    assert (own.num_fds(), threading.enumerate()) == before


def test_a_relay_without_a_target_refuses_and_goes_on(listener):
    """An edge that starts before its ground would meet a lab that has crashed."""
    port = listener.getsockname()[1]
    listener.close()
    with Relay(script((0, LinkState(1_000_000))), target_port=port) as relay:
        for _ in range(3):
            with socket.create_connection(("127.0.0.1", relay.port), timeout=5) as near:
                near.settimeout(5)
                with contextlib.suppress(ConnectionResetError):
                    assert near.recv(10) == b""
