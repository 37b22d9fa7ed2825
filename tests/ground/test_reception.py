"""What the receiver measures for the edge's rate."""

from __future__ import annotations

import pytest

from hvt_common.link.wire import BaseHeader
from hvt_ground.reception import REPORT_LINE_BYTES, Reception, StepFree

MS = 1_000_000
S = 1_000_000_000


def header(sequence: int) -> BaseHeader:
    """Of a base message."""
    return BaseHeader(
        session_id=7, sequence=sequence, frame_index=sequence, capture_ns=0, send_delay_ns=0, flags=0
    )


def test_the_newest_message_and_its_time_are_reported():
    """The edge would take the delay of one message for that of another."""
    reception = Reception()
    reception.base(header(4), size_bytes=5_000, arrived_ns=10 * MS, delay_ms=40.0)
    reception.base(header(5), size_bytes=5_000, arrived_ns=70 * MS, delay_ms=60.0)
    reception.base(header(3), size_bytes=5_000, arrived_ns=90 * MS, delay_ms=900.0)  # overtaken
    reception.still(9, size_bytes=900, arrived_ns=95 * MS)
    reception.still(8, size_bytes=900, arrived_ns=96 * MS)
    measured = reception.take(100 * MS)
    assert (measured.base_sequence, measured.base_held_us, measured.still_sequence) == (5, 30_000, 9)
    assert measured.delay_p50_ms == 60.0
    assert reception.take(200 * MS).delay_p50_ms is None  # since the last report


def test_before_anything_has_come():
    """A first report would acknowledge what never arrived."""
    measured = Reception().take(5 * S)
    assert (measured.base_sequence, measured.base_held_us, measured.still_sequence) == (-1, 0, -1)


@pytest.mark.parametrize(
    ("rate_bps", "least_s", "most_s"), [(8e5, 0.1, 0.1), (2e5, 0.2, 0.3), (3e4, 0.5, 0.5)]
)
def test_reports_take_a_small_share_of_the_way_back(rate_bps, least_s, most_s):
    """On a thin radio, half duplex, the reports would take what the picture needs."""
    reception, now_ns, reports = Reception(), 0, []
    for sequence in range(150):
        now_ns += S // 15
        reception.base(header(sequence), size_bytes=round(rate_bps / 8 / 15), arrived_ns=now_ns)
        if reception.due(now_ns):
            reception.take(now_ns)
            reports.append(now_ns)
    assert least_s <= reception.interval_ns(now_ns) / S <= most_s
    later = [at for at in reports if at > 3 * S]
    share = len(later) * REPORT_LINE_BYTES * 8 / 7 / rate_bps
    assert share < 0.1 if rate_bps < 1e5 else share < 0.035
    assert len(later) >= 12


def test_without_news_reports_are_rare():
    """A paused edge would hear ten reports a second that say nothing."""
    reception = Reception()
    reception.base(header(0), size_bytes=100_000, arrived_ns=0)
    reception.take(0)
    assert not reception.due(400 * MS)
    assert reception.due(500 * MS)
    reception.base(header(1), size_bytes=100_000, arrived_ns=100 * MS)
    assert reception.due(101 * MS)


def test_lockstep_reports_do_not_hang_on_the_clock_of_arrival():
    """More reports would be sent than an edge in lockstep has use for."""
    reception = Reception(lockstep=True)
    reception.take(0)
    for sequence in range(6):
        reception.base(header(sequence), size_bytes=50_000, arrived_ns=sequence * 10 * MS)
    assert not reception.due(400 * MS)
    assert reception.due(500 * MS)


def test_memory_is_bounded():
    """A flood would let the ground grow."""
    reception = Reception()
    for sequence in range(20_000):
        reception.base(header(sequence), size_bytes=10, arrived_ns=sequence, delay_ms=1.0)
    assert len(reception._sizes) <= 4096
    assert len(reception._delays_ms) <= 256


def test_a_wall_clock_that_is_set_leaves_no_step():
    """NTP coming up on the ground would look like an hour in a queue."""
    clock = StepFree(wall_ns=1_000 * S, monotonic_ns=5 * S)
    assert clock.time_ns(1_001 * S, wall_ns=1_001 * S, monotonic_ns=6 * S) == 1_001 * S
    # The clock was put an hour ahead: what is noted with it is taken back.
    assert clock.time_ns(4_602 * S, wall_ns=4_602 * S, monotonic_ns=7 * S) == 1_002 * S
    assert clock.time_ns(4_602 * S, wall_ns=4_602 * S + 5, monotonic_ns=7 * S + 5) == 1_002 * S
