"""Silence, as a thread sees it that is kept from its messages now and then."""

from __future__ import annotations

from hvt_ground.link.receiver import Uptime

MS = 1_000_000


def test_gaps_count_as_far_as_both_arrival_and_handling_show_them():
    """While a recording is opened the edge would seem silent, and another be shown in its place."""
    time, start = Uptime(), 10**18

    def handle(arrived_ms: int, now_ms: int) -> int:
        return (time.handle(arrived_ns=start + arrived_ms * MS, now_ns=start + now_ms * MS) - start) // MS

    assert time.at(start, pending=False) == start
    assert handle(0, 0) == 0
    assert handle(60, 61) == 60
    # Away for eight seconds, in which messages came as ever: they are taken up in one go.
    assert [handle(arrived, 8_061) for arrived in range(120, 8_061, 60)][-1] <= 120
    # Away again, and the edge waits for an answer: one message a second.
    before = handle(8_100, 8_101)
    assert [handle(arrived, 12_000) for arrived in range(9_000, 12_001, 1000)][-1] <= before + 900
    # A true silence of three seconds.
    before = handle(12_060, 12_060)
    assert handle(15_060, 15_060) == before + 3_000
    assert (time.at(start + 16_060 * MS, pending=False) - start) // MS == before + 4_000
    assert (time.at(start + 16_060 * MS, pending=True) - start) // MS == before + 3_000


def test_it_never_goes_back():
    """Callbacks of two threads may come the wrong way round, and a keyframe would never be asked for again."""
    time = Uptime()
    shown = [
        time.handle(arrived_ns=arrived, now_ns=now)
        for arrived, now in ((50, 50), (40, 60), (90, 80), (85, 95))
    ]
    assert shown == sorted(shown)
    assert shown[-1] <= 95
