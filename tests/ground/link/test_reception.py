"""What the receiver measures for the edge's rate."""

import threading
from dataclasses import replace

import pytest

from hvt_common.protocol.clock_offset import CaptureClock, ClockOffset
from hvt_common.protocol.messages import MAX_MISSING_STILLS, BaseHeader, Feedback
from hvt_common.transport.inbox import Received
from hvt_common.units import SECOND_NS
from hvt_ground.link.receiver import Uptime
from hvt_ground.link.reception import REPORT_LINE_BYTES, Reception
from rigs.footprint import footprint_bytes
from rigs.messages import BACKLOG, INFO, ROI, STATUS, STEP

MS = 1_000_000
S = 1_000_000_000


def begun(**changes) -> Reception:
    info = replace(INFO, **changes)
    return Reception(info, clock=lambda: 0, edge_clock=ClockOffset(), emit=lambda _event: None)


def report(reception: Reception, now_ns: int) -> Feedback:
    others = {"receiver_id": 1, "sequence": 0, "clock_offset_ns": 0, "clock_error_ns": -1, "backlog": ()}
    return reception.feedback(send_ns=now_ns, **others)


def header(sequence: int) -> BaseHeader:
    return BaseHeader(
        session_id=7, sequence=sequence, frame_index=sequence, capture_ns=0, send_delay_ns=0, flags=0
    )


def base(reception: Reception, sequence: int, *, arrived_ns: int, size_bytes=500, delay_ms=0.0) -> None:
    """A base message comes, so long after its capture."""
    one = replace(header(sequence), capture_ns=arrived_ns - round(delay_ms * MS))
    reception.base(one, message("base", size_bytes, arrived_ns))


def still(reception: Reception, sequence: int, *, arrived_ns: int) -> None:
    reception.still(replace(ROI, sequence=sequence), message("roi", 900, arrived_ns))


def chunk(reception: Reception, *, arrived_ns: int, still: int | None = None) -> None:
    """A chunk of the backlog comes; with it that still is whole, if it is named."""
    one = replace(BACKLOG, number=still or 0, session_id=INFO.session_id)
    reception.backlog(one, message("backlog", 1000, arrived_ns), delivered=still is not None)


def message(channel: str, size_bytes: int, arrived_ns: int) -> Received:
    return Received(f"hvt/uav-1/{channel}", bytes(size_bytes), b"", "", arrived_ns)


def test_the_newest_message_and_its_time_are_reported():
    """The edge would take the delay of one message for that of another."""
    reception = begun()
    base(reception, 4, size_bytes=5_000, arrived_ns=10 * MS, delay_ms=40.0)
    base(reception, 5, size_bytes=5_000, arrived_ns=70 * MS, delay_ms=60.0)
    base(reception, 3, size_bytes=5_000, arrived_ns=90 * MS, delay_ms=900.0)  # overtaken
    still(reception, 9, arrived_ns=95 * MS)
    still(reception, 8, arrived_ns=96 * MS)
    measured = report(reception, 100 * MS)
    assert (measured.base_sequence, measured.base_held_us, measured.still_sequence) == (5, 30_000, 9)
    assert measured.delay_p50_ms == 60.0
    assert report(reception, 200 * MS).delay_p50_ms == -1.0  # since the last report


def test_what_waits_behind_a_hole_has_come_and_what_is_missing_is_named():
    """The edge would take the link for dead, and hold the very frames that end the wait."""
    reception = begun()
    base(reception, 4, arrived_ns=10 * MS)
    report(reception, 20 * MS)
    assert reception.note_held((5,), header(6), at_ns=80 * MS)
    assert reception.due(520 * MS)
    measured = report(reception, 100 * MS)
    assert (measured.base_sequence, measured.base_held_us, measured.missing_base) == (6, 20_000, (5,))
    assert not reception.note_held((5,), header(7), at_ns=140 * MS), "it has been said"
    assert reception.note_held((5, 8), header(9), at_ns=200 * MS)
    assert not reception.note_held((), None, at_ns=0)
    assert report(reception, 300 * MS).missing_base == ()


def test_before_anything_has_come():
    """A first report would acknowledge what never arrived."""
    measured = report(begun(), 5 * S)
    assert (measured.base_sequence, measured.base_held_us, measured.still_sequence) == (-1, 0, -1)


@pytest.mark.parametrize(
    ("rate_bps", "least_s", "most_s"), [(8e5, 0.1, 0.1), (2e5, 0.2, 0.3), (3e4, 0.5, 0.5)]
)
def test_reports_take_a_small_share_of_the_way_back(rate_bps, least_s, most_s):
    """On a thin radio, half duplex, the reports would take what the picture needs."""
    reception, now_ns, reports = begun(), 0, []
    for sequence in range(150):
        now_ns += S // 15
        base(reception, sequence, size_bytes=round(rate_bps / 8 / 15), arrived_ns=now_ns)
        if reception.due(now_ns):
            report(reception, now_ns)
            reports.append(now_ns)
    assert least_s <= (reports[-1] - reports[-2]) / S < most_s + 1 / 15
    later = [at for at in reports if at > 3 * S]
    share = len(later) * REPORT_LINE_BYTES * 8 / 7 / rate_bps
    assert share < 0.1 if rate_bps < 1e5 else share < 0.035
    assert len(later) >= 12


@pytest.mark.parametrize("pace", ["realtime", "lockstep"])
def test_without_news_and_in_lockstep_reports_are_rare(pace):
    """An edge would hear ten reports a second that say nothing, or that it has no use for."""
    reception = begun(pace=pace)
    base(reception, 0, size_bytes=100_000, arrived_ns=0)
    report(reception, 0)
    assert [reception.due(ms * MS) for ms in (400, 500)] == [False, True]
    base(reception, 1, size_bytes=100_000, arrived_ns=100 * MS)
    assert [reception.due(ms * MS) for ms in (101, 400, 500)] == [pace == "realtime"] * 2 + [True]


def test_memory_is_bounded():
    """A flood would let the ground grow."""
    reception = begun()
    sizes = []
    for sequence in range(20_000):
        base(reception, sequence, size_bytes=10, arrived_ns=sequence * MS, delay_ms=1.0)
        if sequence % 5000 == 4999:
            sizes.append(footprint_bytes(reception))
    assert sizes[-1] < 1.1 * sizes[0]


def test_a_still_that_comes_with_what_was_kept_is_missed_no_more():
    """The edge would send it a second time, on the way that is for now."""
    reception = begun()
    base(reception, 0, arrived_ns=0)
    still(reception, 2, arrived_ns=0)
    chunk(reception, still=1, arrived_ns=0)
    chunk(reception, still=7, arrived_ns=0)
    measured = report(reception, S)
    assert (measured.missing_stills, measured.still_sequence) == ((0,), 2)


def test_pieces_of_the_past_are_reported_on_as_often_as_anything():
    """An edge that hears nothing of its chunks sends them again."""
    reception = begun()
    for number in range(100):
        chunk(reception, arrived_ns=number * 10 * MS)
    report(reception, S)
    chunk(reception, arrived_ns=S + 10 * MS)
    assert reception.due(S + 150 * MS)


LAST = 2**32 - 1


@pytest.mark.parametrize(
    ("first", "comes"),
    [
        pytest.param(
            0,
            [
                (0.5, (1,), 0.5, 1, (0,)),
                (1, (4,), 1, 4, (0, 2, 3)),
                (1, (2, 2), 1, 4, (0, 3)),
                (1, (), 6.9, 4, (3,)),
                (1, (), 7.1, 4, ()),
            ],
            id="the edge would take them for received, and never send them again",
        ),
        pytest.param(
            700,
            [(0, (90,), 1, 90, ()), (0, (92,), 1, 92, (91,))],
            id="a ground that joins late would ask for stills of a past that nobody there has seen",
        ),
        pytest.param(
            0,
            [
                (0, (LAST - 1,), 1, LAST - 1, tuple(range(LAST - 1 - MAX_MISSING_STILLS, LAST - 1))),
                (0, (LAST,), 1, LAST, tuple(range(LAST - 1 - MAX_MISSING_STILLS, LAST - 1))),
            ],
            id="a forged number would make reports too long to be sent, or the ground grow",
        ),
        pytest.param(
            0,
            [
                (0, (0, 1, 4, LAST - 8, 5, 2), 1, 5, (3,)),
                (1, (LAST - 7, LAST - 6), 1, LAST - 6, ()),  # two that follow each other are believed
                (2, (6, 8), 2, 8, ()),
            ],
            id="reports would name for ever what the edge never sent",
        ),
    ],
)
def test_stills_that_never_came_are_named_until_they_come(first, comes):
    """Named after what would be lost. At a time come stills; a report at another says the newest and the missing."""
    reception = begun()
    base(reception, first, arrived_ns=0)
    for at_s, stills, reported_s, newest, missing in comes:
        for sequence in stills:
            still(reception, sequence, arrived_ns=round(at_s * S))
        measured = report(reception, round(reported_s * S))
        assert (measured.still_sequence, measured.missing_stills) == (newest, missing)


class Progress(int):
    """A time that somebody reckons with just when a still comes in another thread."""

    reception: Reception
    threads: list[threading.Thread]

    def __sub__(self, other):
        sequence = 100 + 2 * len(self.threads)
        came = threading.Thread(target=still, args=(self.reception, sequence), kwargs={"arrived_ns": S})
        came.start()
        came.join(0.1)  # it has to wait its turn
        self.threads.append(came)
        return int(self) - other


@pytest.mark.parametrize("last", ["base", "roi", "tracks", "backlog"])
def test_all_has_come_when_each_of_the_edges_counts_is_reached(last):
    """The last picture, still, list of tracks or stored still of a flight would be cut off."""
    reception = begun()
    counts = replace(STATUS, base_messages=1, roi_messages=1, meta_messages=1, backlog_messages=1)
    reception.status(counts, message("status", 100, 0))
    comes = {
        "base": lambda: base(reception, 0, arrived_ns=0),
        "roi": lambda: still(reception, 0, arrived_ns=0),
        "tracks": lambda: reception.tracks(STEP, message("tracks", 100, 0)),
        "backlog": lambda: chunk(reception, arrived_ns=0),
    }
    for one in (*(comes.keys() - {last}), last):
        assert not reception.is_whole
        comes[one]()
    assert reception.is_whole


def test_a_still_may_come_while_a_report_is_made():
    """Stills are read in a thread of their own, which reports them at once: the ground would end with an error."""
    reception = begun()
    base(reception, 0, arrived_ns=0)
    still(reception, 4, arrived_ns=0)
    now = Progress(S)
    now.reception, now.threads = reception, []
    assert report(reception, now).missing_stills == (0, 1, 2, 3)
    assert now.threads
    for came in now.threads:
        came.join()
    assert report(reception, S).still_sequence == 100 + 2 * (len(now.threads) - 1)


def test_a_time_of_the_future_does_not_stop_the_measurement():
    """One forged frame would leave the numbers of the link as they were for the rest of the flight."""
    given, due = [], []
    reception = Reception(INFO, clock=lambda: 0, edge_clock=ClockOffset(), emit=given.append)
    for at_ns in (0, 100 * MS, 500 * MS, 10**6 * S, 600 * MS, 900 * MS, 1100 * MS):
        one = replace(header(0), capture_ns=at_ns)
        before = len(given)
        reception.measure(one, tracks=0, tracks_refined=0)
        due.append(len(given) > before)
    assert due == [True, False, True, True, True, False, True]


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
    came = ((50, 50), (40, 60), (90, 80), (85, 95))
    shown = [time.handle(arrived_ns=arrived, now_ns=now) for arrived, now in came]
    assert shown == sorted(shown)
    assert shown[-1] <= 95
