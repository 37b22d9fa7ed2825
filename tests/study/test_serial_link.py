"""A serial link, message by message, against sums done by hand."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_study.flights.flight import picture_age_p95_ms
from hvt_study.flights.flight_link import START_NS, LinkReport, SerialLink, frame_ns

MS = 1_000_000


def link_of(rate_bps=80_000):
    """At 80 kbps a byte takes 0.1 ms."""
    return SerialLink(rate_bps=rate_bps)


def test_a_message_takes_its_bits_over_the_rate():
    """Every delay in the tables would be wrong by a factor."""
    link = link_of()
    link.put("a", size_bytes=1000, enter_ns=5 * MS, urgent=True)
    assert link.arrived(104 * MS) == []
    (there,) = link.arrived(105 * MS)
    assert (there.message, there.enter_ns, there.arrival_ns) == ("a", 5 * MS, 105 * MS)
    assert link.arrived(None) == []


@pytest.mark.parametrize(
    ("messages", "arrivals"),
    [
        (
            [("still 1", 500, 0, False), ("still 2", 500, 1, False), ("frame", 100, 20, True)],
            [("still 1", 50), ("frame", 60), ("still 2", 110)],
        ),
        ([("late", 100, 500, False), ("early", 100, 100, False)], [("early", 110), ("late", 510)]),
    ],
)
def test_the_base_goes_first_but_interrupts_nothing_and_nothing_goes_ahead_of_time(messages, arrivals):
    """A still that has begun to go holds up the next frame, one that waits does not; before it is there none goes."""
    link = link_of()
    for name, size_bytes, enter_ms, urgent in messages:
        link.put(name, size_bytes=size_bytes, enter_ns=enter_ms * MS, urgent=urgent)
    assert [(one.message, one.arrival_ns // MS) for one in link.arrived(None)] == arrivals


def test_what_is_put_later_may_still_overtake_what_has_not_begun():
    """The flight asks for arrivals as it goes on: nothing may be decided before its time."""
    link = link_of()
    link.put("first", size_bytes=1000, enter_ns=0, urgent=False)
    link.put("still", size_bytes=1000, enter_ns=10 * MS, urgent=False)
    assert link.arrived(90 * MS) == []
    link.put("frame", size_bytes=100, enter_ns=95 * MS, urgent=True)
    assert [one.message for one in link.arrived(None)] == ["first", "frame", "still"]


@given(
    st.lists(st.tuples(st.integers(0, 10**9), st.integers(1, 5000), st.booleans()), min_size=1, max_size=30)
)
def test_asking_often_changes_nothing(messages):
    """The same messages must arrive at the same times, in however many steps they are asked for."""
    at_once, in_steps, stepped = link_of(), link_of(), []
    for number, (enter_ns, size_bytes, urgent) in enumerate(sorted(messages)):
        at_once.put(number, size_bytes=size_bytes, enter_ns=enter_ns, urgent=urgent)
        stepped += in_steps.arrived(enter_ns)
        in_steps.put(number, size_bytes=size_bytes, enter_ns=enter_ns, urgent=urgent)
    whole = at_once.arrived(None)
    assert stepped + in_steps.arrived(None) == whole
    for before, after in pairwise(whole):
        assert after.arrival_ns - before.arrival_ns >= after.size_bytes * 100_000 - 1  # one at a time
    assert all(one.arrival_ns - one.enter_ns >= one.size_bytes * 100_000 - 1 for one in whole)


def test_report():
    """Delay and queue are what an operator feels."""
    link = link_of()
    for number in range(3):
        link.put(number, size_bytes=1000, enter_ns=number * 50 * MS, urgent=True)
    there = link.arrived(None)
    report = LinkReport.of([one.arrival_ns - one.enter_ns for one in there], there)
    assert (report.delay_p50_ms, report.delay_p95_ms) == (150, pytest.approx(195))  # 100, 150, 200
    assert report.worst_queue_bytes == 2000  # the first is there just as the third comes
    none = LinkReport.of([], [])
    assert none.worst_queue_bytes == 0
    unknown = (none.delay_p50_ms, none.delay_p95_ms, picture_age_p95_ms([(frame_ns(9), START_NS)], 9))
    assert all(map(math.isnan, unknown))  # 0 ms would be the best of all


def test_a_rate_of_nothing_is_refused():
    """It would divide by zero."""
    with pytest.raises(ValueError, match="above 0"):
        link_of(0)
