"""Time on both sides: a clock without steps, and the offset between two of them."""

import sys
import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.protocol.clock_offset import CaptureClock, ClockOffset
from hvt_common.runtime.clock import SteadyClock

MS, SECOND_NS = 1_000_000, 1_000_000_000
delays = st.integers(0, 5_000 * MS)


def exchange(clock, *, at_ns, offset_ns, out_ns, held_ns, back_ns):
    heard = at_ns + out_ns
    return clock.add(
        t0_ns=at_ns,
        t1_ns=heard + offset_ns,
        t2_ns=heard + held_ns + offset_ns,
        t3_ns=heard + held_ns + back_ns,
    )


def test_an_even_path_gives_the_exact_offset():
    """Every delay that is shown would be off; times that contradict each other are left out."""
    clock = ClockOffset()
    assert not clock.add(t0_ns=10, t1_ns=0, t2_ns=100, t3_ns=20)
    assert not clock.add(t0_ns=0, t1_ns=50, t2_ns=40, t3_ns=90)
    assert (clock.estimate, clock.to_local_ns(5)) == (None, 5)
    assert exchange(clock, at_ns=0, offset_ns=-70 * MS, out_ns=4 * MS, held_ns=9 * MS, back_ns=4 * MS)
    assert (clock.estimate, clock.to_local_ns(1_000 * MS)) == ((-70 * MS, 4 * MS), 1_070 * MS)


@given(
    offset=st.integers(-(10**18), 10**18),
    paths=st.lists(st.tuples(delays, delays, delays), min_size=1, max_size=20),
)
def test_the_truth_is_within_the_stated_error(offset, paths):
    """The stated error would be a lie, and with it every latency."""
    clock = ClockOffset(window_ns=10**15)
    for number, (out, held, back) in enumerate(paths):
        assert exchange(
            clock, at_ns=number * 10**11, offset_ns=offset, out_ns=out, held_ns=held, back_ns=back
        )
    estimate, error = clock.estimate
    assert abs(estimate - offset) <= error
    assert error == (min(out + back for out, _, back in paths) + 1) // 2


def test_the_shortest_round_trip_speaks_until_it_is_old():
    """One exchange behind a keyframe would bend all latencies; an old one would hide a drift for ever."""
    clock = ClockOffset(window_ns=60_000 * MS)
    exchange(clock, at_ns=0, offset_ns=0, out_ns=MS, held_ns=0, back_ns=MS)
    exchange(clock, at_ns=1_000 * MS, offset_ns=0, out_ns=300 * MS, held_ns=0, back_ns=MS)
    assert clock.offset_ns == 0
    exchange(clock, at_ns=61_000 * MS, offset_ns=8 * MS, out_ns=2 * MS, held_ns=0, back_ns=2 * MS)
    assert clock.offset_ns == 8 * MS


def test_no_picture_comes_before_it_was_captured():
    """Where the first answer waited in a queue, a delay of 0 ms would be shown for a minute."""
    clock = ClockOffset()
    camera = CaptureClock(clock)
    exchange(clock, at_ns=0, offset_ns=0, out_ns=10 * MS, held_ns=0, back_ns=2_010 * MS)
    for captured_ms, took_ms, shown_ms in ((3_000, 60, 0), (3_100, 20, 0), (3_200, 60, 40)):
        camera.note(captured_ms * MS, received_ns=(captured_ms + took_ms) * MS)
        delay_ns = (captured_ms + took_ms) * MS - camera.to_local_ns(captured_ms * MS)
        assert abs(delay_ns - shown_ms * MS) < MS
    camera.note(9_000 * MS, received_ns=5_000 * MS)  # a camera that is ahead
    assert camera.is_sound
    assert camera.offset_ns == 10 * MS  # at most what the exchange leaves open
    exchange(clock, at_ns=9_000 * MS, offset_ns=0, out_ns=MS, held_ns=0, back_ns=MS)
    camera.note(9_100 * MS, received_ns=9_120 * MS)
    assert camera.offset_ns == 0, "of one that was ahead nothing is left"


def test_the_quickest_picture_of_an_hour_ago_says_nothing_of_a_clock_that_drifts():
    """The delay would grow for hours, by up to half a round trip."""
    clock = ClockOffset()
    camera = CaptureClock(clock)
    for second in range(3600):
        at_ns = second * SECOND_NS
        offset_ns = -at_ns // 10_000
        if second % 10 == 0:
            exchange(clock, at_ns=at_ns, offset_ns=offset_ns, out_ns=300 * MS, held_ns=0, back_ns=300 * MS)
        camera.note(at_ns + offset_ns, received_ns=at_ns + 310 * MS)
    shown_ns = at_ns + 310 * MS - camera.to_local_ns(at_ns + offset_ns)
    assert abs(shown_ns - 310 * MS) < 10 * MS  # what drifts in the minute that an exchange is kept


def test_two_threads_may_use_it():
    """While one learns that the clock was set, another would take its times for our own: off by the whole offset."""
    clock, done, seen = ClockOffset(), threading.Event(), set()
    exchange(clock, at_ns=0, offset_ns=3_600_000 * MS, out_ns=MS, held_ns=0, back_ns=MS)

    def read():
        while not done.is_set():
            seen.update((clock.offset_ns, clock.estimate, clock.to_local_ns(0)))

    reader = threading.Thread(target=read)
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        reader.start()
        for number in range(1, 20_000):
            step = 3_600_000 * MS * (1 + number % 2)
            way = MS * (1 + number % 2)
            exchange(clock, at_ns=number * MS, offset_ns=step, out_ns=way, held_ns=0, back_ns=way)
    finally:
        done.set()
        reader.join()
        sys.setswitchinterval(interval_s)
    hours = {3_600_000 * MS * number for number in (1, 2)}
    assert seen <= hours | {-one for one in hours} | {(3_600_000 * MS * n, MS * n) for n in (1, 2)}


def test_a_clock_that_was_set_is_believed_at_once():
    """For a minute every latency would be wrong by the step."""
    clock = ClockOffset()
    exchange(clock, at_ns=0, offset_ns=0, out_ns=MS, held_ns=0, back_ns=MS)
    exchange(clock, at_ns=20_000 * MS, offset_ns=3_600_000 * MS, out_ns=40 * MS, held_ns=0, back_ns=40 * MS)
    assert clock.offset_ns == 3_600_000 * MS
    exchange(clock, at_ns=40_000 * MS, offset_ns=3_600_000 * MS, out_ns=90 * MS, held_ns=0, back_ns=10 * MS)
    assert clock.offset_ns == 3_600_000 * MS  # the better of those after the step
    assert clock.estimate == (3_600_000 * MS, 40 * MS)


@pytest.fixture
def wall():
    """The wall clock and the time since boot, which a test sets; a steady clock that began at 5 s."""
    now = {"wall_ns": 1_000_000 * MS, "monotonic_ns": 5_000 * MS}
    return now, SteadyClock(wall_ns=lambda: now["wall_ns"], monotonic_ns=lambda: now["monotonic_ns"])


def test_a_clock_that_was_wrong_at_the_start_is_said_once(caplog, wall):
    """An operator would wonder for the whole flight why all times are wrong."""
    now, clock = wall
    for drift_ms, said in ((9_000, 0), (3_600_000, 1), (7_200_000, 1), (0, 1)):
        now["monotonic_ns"] += 2_000 * MS
        now["wall_ns"] = 995_000 * MS + now["monotonic_ns"] + drift_ms * MS
        assert clock() == 995_000 * MS + now["monotonic_ns"]
        assert len(caplog.records) == said
    assert caplog.records[0].getMessage().startswith("the clock of this machine was set by +3600 s")


def test_a_wall_clock_that_is_set_leaves_no_step(wall):
    """A frame would be an hour long, and all that waits be stale."""
    now, clock = wall
    shown = [clock()]
    for step_ms in (3_600_000, -7_200_000, 0):
        now["wall_ns"] += (step_ms + 40) * MS
        now["monotonic_ns"] += 40 * MS
        shown.append(clock())
    assert shown == [(1_000_000 + 40 * step) * MS for step in range(4)]


def test_a_machine_that_slept_has_the_time_of_day(monkeypatch):
    """A ground whose lid was shut between two flights would date the second hours before it took place."""
    passed_ms = 5_000
    monkeypatch.setattr(time, "clock_gettime_ns", lambda _clock: passed_ms * MS)
    clock = SteadyClock(wall_ns=lambda: (995_000 + passed_ms) * MS)
    passed_ms += 3_600_000
    assert clock() == (995_000 + passed_ms) * MS
