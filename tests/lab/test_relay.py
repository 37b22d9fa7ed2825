"""The lab's own honesty: a relay that is kinder or harsher than its script would praise or blame HVT for nothing."""

import contextlib
import gc
import random
import socket
import threading
import time
from itertools import accumulate, pairwise

import psutil
import pytest

from lab.link.carriers.pipe import DATAGRAM_HEADER_BYTES, SEGMENT_HEADER_BYTES, Pipe, Segment, Stream
from lab.link.carriers.relay import Relay
from lab.link.timeline import LinkState, Phase, Script
from programs.processes import eventually

PACKET = 1200 + DATAGRAM_HEADER_BYTES


def script(*pieces: tuple[float, LinkState], lasts_s: float = 60.0, queue_bytes: int = 32_000) -> Script:
    return Script(tuple(Phase(at, state) for at, state in pieces), lasts_s=lasts_s, queue_bytes=queue_bytes)


def offered(pipe: Pipe, *, every_s: float, lasts_s: float) -> list[tuple[float, float | None]]:
    """Datagrams at a steady pace: when each was sent, and when it arrives."""
    return [(i * every_s, pipe.datagram(PACKET, i * every_s)) for i in range(int(lasts_s / every_s))]


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


def delivered(segments: list[Segment]) -> list[float]:
    return list(accumulate((segment.arrives_s for segment in segments), max))


def test_a_lost_segment_stalls_all_behind_it():
    """Over TCP a radio's loss is not a hole, but everything late at once."""
    stream = Stream(Pipe(script((0, LinkState(1_000_000, delay_s=0.02, loss=0.05))), seed=5))
    segments = [stream.segment(1000, i * 0.02) for i in range(500)]
    waits = [at - i * 0.02 for i, at in enumerate(delivered(segments))]
    stalled = [wait for wait in waits if wait > 0.04]
    assert len(stalled) > 0.05 * 500
    assert max(waits) <= 2 * (0.2 + 0.04 + 0.02) + 0.02
    assert min(waits) == pytest.approx(0.02 + 0.008, abs=1e-6)


DELAY_S, FRAME_S, ON_LINE_S = 0.03, 0.067, 0.001
ROUND_S = 2 * DELAY_S
TIMER_S = 0.2 + ROUND_S


def lossy(*spans_s: tuple[float, float]) -> Stream:
    """A connection whose packets of 1000 bytes take 1 ms of the line; all of these spans are lost."""
    light, lost = (LinkState(8_000_000, delay_s=DELAY_S, loss=share) for share in (0.0, 1.0))
    pieces = [piece for begin, end in spans_s for piece in ((begin, lost), (end, light))]
    return Stream(Pipe(script((0, light), *pieces), seed=1))


@pytest.mark.parametrize("behind_s", [0.004, 0.012, FRAME_S, 0.15])
def test_a_loss_is_mended_one_round_trip_after_what_follows_it(behind_s):
    """A lab that waited for the timer at each loss would blame HVT for stalls that no Linux has."""
    stream = lossy((1, 1.0015))
    segment = stream.segment(1000, 1.0)
    later = stream.segment(1000, 1 + behind_s)
    assert later.arrives_s == pytest.approx(1 + behind_s + ON_LINE_S + DELAY_S)
    window_s = max(0.0, ROUND_S / 4 - behind_s)
    assert segment.arrives_s == pytest.approx(later.arrives_s + DELAY_S + window_s + DELAY_S)
    assert segment.arrives_s <= 1 + behind_s + ON_LINE_S + 1.5 * ROUND_S + ROUND_S / 4
    healed_s = segment.arrives_s
    stream.segment(1000, 1.2)
    assert segment.arrives_s == healed_s, "what comes after it changes nothing"


def test_a_loss_with_nothing_behind_it_waits_for_the_timer():
    """The last packet of what is sent seldom, a keyframe asked for, would come too early."""
    stream = lossy((1, 1.01))
    first, second, third = (stream.segment(1000, 1.0) for _ in range(3))
    assert first.arrives_s == pytest.approx(1 + ON_LINE_S + TIMER_S + DELAY_S)
    assert second.arrives_s == third.arrives_s == pytest.approx(first.arrives_s + ROUND_S)
    stream.segment(1000, 1 + TIMER_S)
    assert first.arrives_s == pytest.approx(1 + ON_LINE_S + TIMER_S + DELAY_S), "the timer was earlier"


def test_a_burst_longer_than_the_timer_ends_with_what_follows_it():
    """After half a second of loss a connection that goes on sending would sleep for as long again."""
    stream = lossy((1, 1.5))
    segments = [stream.segment(1000, 1 + i * FRAME_S) for i in range(7)]
    assert all(segment.arrives_s > 1 + 3 * TIMER_S for segment in segments), "the timer's second"
    next_s = 1 + 8 * FRAME_S
    later = stream.segment(1000, next_s)
    healed_s = pytest.approx(next_s + ON_LINE_S + 1.5 * ROUND_S)
    assert [segment.arrives_s for segment in segments] == [healed_s] * 7
    assert delivered([*segments, later])[-1] == healed_s


def test_a_retransmission_that_is_lost_waits_for_the_doubled_timer():
    """The lab would mend within a burst what the burst has to take again."""
    segment = lossy((1, 1.3)).segment(1000, 1.0)
    assert segment.arrives_s == pytest.approx(1 + ON_LINE_S + TIMER_S + 2 * TIMER_S + DELAY_S)
    segment = lossy((1, 1.3), (1.7, 1.8)).segment(1000, 1.0)
    assert segment.arrives_s == pytest.approx(1 + ON_LINE_S + TIMER_S + 2 * TIMER_S + 4 * TIMER_S + DELAY_S)


def test_a_retransmission_that_is_lost_is_noticed_by_what_follows_it():
    """As above, where the sender goes on: RACK knows the one that was sent again by its time."""
    again_s = 1 + FRAME_S + ON_LINE_S + ROUND_S
    stream = lossy((1, 1.01), (again_s - 0.004, again_s + 0.002))
    segments = [stream.segment(1000, at_s) for at_s in (1.0, 1.001)]
    stream.segment(1000, 1 + FRAME_S)
    assert segments[0].arrives_s == pytest.approx(again_s + TIMER_S + DELAY_S), "nothing else follows yet"
    assert segments[1].arrives_s == pytest.approx(segments[0].arrives_s + ROUND_S)
    stream.segment(1000, again_s - 0.01)
    assert segments[0].arrives_s == pytest.approx(again_s + TIMER_S + DELAY_S), "it was sent before"
    stream.segment(1000, again_s + 0.02)
    healed_s = again_s + 0.02 + ON_LINE_S + 1.5 * ROUND_S
    assert [segment.arrives_s for segment in segments] == [pytest.approx(healed_s)] * 2


def test_an_acknowledgement_that_is_lost_says_nothing():
    """Short bursts close together would look better than they are."""
    came_s = 1 + FRAME_S + ON_LINE_S + DELAY_S
    stream = lossy((1, 1.01), (came_s - 0.005, came_s + 0.005))
    segment = stream.segment(1000, 1.0)
    stream.segment(1000, 1 + FRAME_S)
    assert segment.arrives_s == pytest.approx(1 + ON_LINE_S + TIMER_S + DELAY_S)
    stream.segment(1000, 1 + 2 * FRAME_S)
    assert segment.arrives_s == pytest.approx(1 + 2 * FRAME_S + ON_LINE_S + 1.5 * ROUND_S)


def test_what_is_sent_again_draws_by_itself():
    """One stall more would be another link for all that comes after it, and no two runs could be compared."""
    state = LinkState(1_000_000, delay_s=0.02, jitter_s=0.005, loss=0.3)
    plain, mended = (Pipe(script((0, state)), seed=3) for _ in range(2))
    stream = Stream(mended)
    segments = []
    for number in range(400):
        plain.pass_on(1000, number * 0.02)
        segments.append(stream.segment(1000, number * 0.02))
        assert mended.lost == plain.lost
    assert plain.lost > 0.2 * 400
    waits = [at - number * 0.02 for number, at in enumerate(delivered(segments))]
    assert max(waits) > 0.2, "some of what was sent again was lost again"


def test_a_connection_wakes_from_darkness_at_a_retransmission():
    """Old connections sleep on after the radio is back; a lab without this would not show why to open a new one."""
    light = LinkState(1_000_000)
    stream = Stream(Pipe(script((0, light), (4, LinkState(1_000_000, dark=True)), (12, light)), seed=1))
    assert stream.may_send_s(3.9) == 3.9
    assert stream.may_send_s(4.0) == pytest.approx(4 + 0.2 * (2**6 - 1))


def test_what_darkness_takes_wakes_with_its_connection():
    """Frames that were in the queue when the radio went would come before the connection lives again."""
    light = LinkState(8_000_000, delay_s=DELAY_S)
    dark = LinkState(8_000_000, delay_s=DELAY_S, dark=True)
    stream = Stream(Pipe(script((0, light), (4, dark), (12, light)), seed=1))
    segments = [stream.segment(1000, 3.9985) for _ in range(4)]
    wakes_s = 4 + TIMER_S * (2**5 - 1)
    assert wakes_s > 12
    assert [segment.arrives_s for segment in segments] == [
        pytest.approx(3.9995 + DELAY_S),
        *(pytest.approx(wakes_s + DELAY_S + later_s) for later_s in (0, ROUND_S, ROUND_S)),
    ]


@contextlib.contextmanager
def receiving(listener: socket.socket):
    """What comes to the listener from the first that connects, and when; all of it at the end."""
    got: list[tuple[float, bytes]] = []

    def receive() -> None:
        with listener.accept()[0] as far:
            while data := far.recv(65536):
                got.append((time.monotonic(), data))

    thread = threading.Thread(target=receive)
    thread.start()
    yield got
    thread.join(60)
    assert not thread.is_alive()


def exchange(relay: Relay, listener: socket.socket, *, seconds: float) -> list[tuple[float, bytes]]:
    """Send through the relay as fast as it takes; return what came when."""
    with receiving(listener) as got, socket.socket() as near:
        near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 8192)
        near.connect(("127.0.0.1", relay.port))
        ends_s = time.monotonic() + seconds
        while time.monotonic() < ends_s:
            near.sendall(bytes(1000))
    return got


@pytest.fixture
def listener():
    with socket.create_server(("127.0.0.1", 0)) as one:
        yield one


def test_a_tcp_sender_gets_the_rate_and_never_more(listener):
    """A relay that is kinder than its script would hold bars that the radio does not."""
    rate_bps, delay_s, queue_bytes = 800_000, 0.03, 8_000
    line = script((0, LinkState(rate_bps, delay_s=delay_s)), queue_bytes=queue_bytes)
    with Relay(line, target_port=listener.getsockname()[1]) as relay:
        began_s = time.monotonic()
        relay.begin()
        got = exchange(relay, listener, seconds=2)
        lasted_s = time.monotonic() - began_s
        assert 8 * relay.up.passed_bytes <= rate_bps * lasted_s + 8 * queue_bytes
    full = 1 + SEGMENT_HEADER_BYTES / 1448  # at the least: not all segments are
    line_bits = [8 * full * size for size in accumulate(len(data) for _, data in got)]
    assert line_bits[-1] > 8 * queue_bytes
    for (at_s, _), bits in zip(got, line_bits, strict=True):
        assert bits <= rate_bps * (at_s - began_s - delay_s)


def test_all_comes_whole_and_in_order_through_bursts_of_loss(listener):
    """A lab that mixes up or drops what it sends again would blame HVT for a broken stream."""
    light, lost = (LinkState(4_000_000, delay_s=0.01, jitter_s=0.01, loss=share) for share in (0.0, 1.0))
    bursts = [piece for i in range(1, 50) for piece in ((0.2 * i, lost), (0.2 * i + 0.01, light))]
    sent = random.Random(1).randbytes(1_000_000)
    with Relay(script((0, light), *bursts), target_port=listener.getsockname()[1]) as relay:
        relay.begin()
        with receiving(listener) as got, socket.create_connection(("127.0.0.1", relay.port)) as near:
            near.sendall(sent)
        assert relay.up.lost > 10
    assert b"".join(data for _, data in got) == sent


def test_what_is_mended_early_is_handed_on_early():
    """The relay would wait for a timer that a later packet has made needless; here 25 s, through a gap of one."""
    # Who is stopped during that second misses it.
    assert any(mended_early() for _ in range(3))


def mended_early() -> bool:
    """Whether what was lost at first has come in the second of light, or soon after it."""
    light, lost = (LinkState(1_000_000, delay_s=0.01, loss=share) for share in (0.0, 1.0))
    line = script((0, lost), (1.6, light), (2.6, lost), (60, light))
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        Relay(line, target_port=listener.getsockname()[1]) as relay,
        socket.create_connection(("127.0.0.1", relay.port)) as near,
        listener.accept()[0] as far,
    ):
        began_s = time.monotonic()
        relay.begin()
        far.settimeout(0.05)
        while time.monotonic() < began_s + 10:
            near.sendall(b"frame")
            with contextlib.suppress(TimeoutError):
                far.recv(100)
                assert time.monotonic() >= began_s + 1.6, "and not while all is lost"
                return True
    return False


def test_who_gave_up_in_darkness_was_never_there():
    """The ground would be busy with the corpses of the edge's tries, and late for the living one."""
    for dark_s in (0.7, 3.0, 15.0):
        with socket.create_server(("127.0.0.1", 0)) as listener:
            if given_up_in_darkness(listener, dark_s=dark_s):
                return
    pytest.fail("it takes this machine a quarter of a minute to connect")


def given_up_in_darkness(listener: socket.socket, *, dark_s: float) -> bool:
    """Three that give up in it and one that stays; False where the three were so slow that there was light again."""
    light, dark = (LinkState(2_000_000, dark=dark) for dark in (False, True))
    with Relay(script((0, dark), (dark_s, light)), target_port=listener.getsockname()[1]) as relay:
        began_s = time.monotonic()
        relay.begin()
        eventually(lambda: relay.up.script.phases[0].state.dark, what="it is dark")
        for _ in range(3):
            socket.create_connection(("127.0.0.1", relay.port)).close()
        if time.monotonic() >= began_s + dark_s:
            return False
        with socket.create_connection(("127.0.0.1", relay.port)) as stays:
            stays.sendall(b"here")
            listener.settimeout(60)
            far, _ = listener.accept()
            with far:
                assert far.recv(10) == b"here"
        listener.settimeout(0.2)
        with pytest.raises(TimeoutError):
            listener.accept()
    return True


def test_datagrams_pass_both_ways_and_are_counted():
    """Over UDP nothing would come back."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as target:
        target.bind(("127.0.0.1", 0))
        target.settimeout(60)
        line = script((0, LinkState(1_000_000, delay_s=0.05)))
        with (
            Relay(line, protocol="udp", target_port=target.getsockname()[1]) as relay,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client,
        ):
            client.settimeout(60)
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

    def relayed() -> None:
        with Relay(script((0, LinkState(50_000_000))), target_port=listener.getsockname()[1]) as relay:
            exchange(relay, listener, seconds=0.1)

    relayed()  # the first may open what Python keeps
    gc.collect()  # what others left goes before it is counted
    descriptors, threads = own.num_fds(), set(threading.enumerate())
    for _ in range(3):
        relayed()
    assert own.num_fds() <= descriptors
    assert set(threading.enumerate()) <= threads


def test_a_relay_without_a_target_refuses_and_goes_on(listener):
    """An edge that starts before its ground would meet a lab that has crashed."""
    port = listener.getsockname()[1]
    listener.close()
    with Relay(script((0, LinkState(1_000_000))), target_port=port) as relay:
        for _ in range(3):
            with socket.create_connection(("127.0.0.1", relay.port), timeout=5) as near:
                near.settimeout(60)
                with contextlib.suppress(ConnectionResetError):
                    assert near.recv(10) == b""
