"""Capture times by the ground's clock."""

from __future__ import annotations

import pytest

from hvt_common.protocol.clock_offset import ClockOffset
from hvt_common.units import SECOND_NS
from hvt_ground.link.reception import CaptureClock

YEAR_NS = 365 * 86_400 * SECOND_NS


@pytest.mark.parametrize("off_ns", [-YEAR_NS, -61 * SECOND_NS, 6 * SECOND_NS, YEAR_NS])
def test_a_clock_that_cannot_be_right_counts_from_the_quickest_arrival(off_ns: int) -> None:
    """An operator would read that there is no picture for 66 days, beside one of this moment."""
    clock = CaptureClock(ClockOffset())
    for index, late_ns in enumerate((300, 100, 250)):  # each on its way so much longer than the shortest
        clock.note(index * SECOND_NS + off_ns, received_ns=index * SECOND_NS + late_ns)
    assert not clock.is_sound
    assert clock.to_local_ns(2 * SECOND_NS + off_ns) == 2 * SECOND_NS + 100


def test_a_clock_that_becomes_right_counts_again() -> None:
    """A camera that got the time a minute after its start would have no delay for the rest of the flight."""
    edge_clock = ClockOffset()
    clock = CaptureClock(edge_clock)
    clock.note(YEAR_NS, received_ns=0)
    assert not clock.is_sound
    edge_clock.add(t0_ns=0, t1_ns=YEAR_NS, t2_ns=YEAR_NS, t3_ns=0)
    clock.note(YEAR_NS + SECOND_NS, received_ns=2 * SECOND_NS)
    assert clock.is_sound
    assert clock.to_local_ns(YEAR_NS + SECOND_NS) == SECOND_NS
