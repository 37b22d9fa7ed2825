"""The base stream through loss, repetition, reordering, restarts and forged numbers."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.protocol.messages import MAX_MISSING_BASE, Flags
from hvt_ground.link.reassemble import (
    ADOPTION_INTERVAL_NS,
    DUPLICATE_AFTER_NS,
    DUPLICATE_SILENCE_NS,
    ORDERLY_UNITS,
    REORDER_WAIT_NS,
    RESEND_UNITS,
    RESTART_SILENCE_NS,
    SEQUENCE_SLACK,
    SILENCE_NS,
    Arrival,
    Reassembler,
)
from rigs.footprint import footprint_bytes
from rigs.messages import UnitHeader

FRAME_NS = 1_000_000_000 // 15
MS = 1_000_000
MAX_U64 = (1 << 64) - 1


class Ground:
    """A `Reassembler` with a clock that steps by one frame a unit, and all that came out of it."""

    def __init__(self) -> None:
        self.core: Reassembler = Reassembler()
        self.now_ns = 5_000_000_000
        self.out: list[Arrival] = []
        self._sent = 0

    def send(self, sequence, *, key=False, session=1, frame=None, after_ns=FRAME_NS, flags=0):
        """Let one unit arrive ``after_ns`` later; (verdict, sequence) of all that is settled by it."""
        self.now_ns += after_ns
        self._sent += 1
        header = UnitHeader(session, sequence, sequence * 2 if frame is None else frame, key, flags)
        resolved = self.core.accept(header, b"%d/%d" % (session, sequence), now_ns=self.now_ns)
        self.out += resolved
        return [(unit.verdict, unit.header.sequence) for unit in resolved]

    def decoded(self):
        """The sequence numbers that went to the decoder."""
        return [unit.header.sequence for unit in self.out if unit.verdict == "decode"]

    def held(self):
        """How many units have no verdict yet."""
        return self._sent - len(self.out)

    def sessions(self):
        """How many were adopted; one that starts afresh counts again."""
        return sum(unit.starts_session for unit in self.out)

    def wants(self):
        """Whether a keyframe is wanted now."""
        return self.core.wants_keyframe(self.now_ns)


@pytest.fixture
def ground():
    """A ground that has seen nothing yet."""
    return Ground()


@pytest.fixture
def running(ground):
    """Four units into a session: 0 (keyframe), 1, 2, 3."""
    for sequence in range(4):
        ground.send(sequence, key=sequence == 0)
    return ground


def assert_decodable(out):
    """What a decoder was given: keyframe-started runs without a hole, in order, nothing twice."""
    previous: Arrival | None = None
    for unit in (unit for unit in out if unit.verdict == "decode"):
        if unit.starts_run or previous is None:
            assert unit.header.keyframe
            assert unit.starts_run
        else:
            assert unit.header.session_id == previous.header.session_id
            assert unit.header.sequence == previous.header.sequence + 1
        if previous is not None and not unit.starts_session:
            assert unit.header.sequence > previous.header.sequence
            assert unit.header.frame_index > previous.header.frame_index
        previous = unit


def test_a_whole_stream_is_decoded_whole(running):
    """A clean link would lose frames, or the payload would not reach the decoder as it was."""
    assert running.decoded() == [0, 1, 2, 3]
    assert [unit.message for unit in running.out] == [b"1/0", b"1/1", b"1/2", b"1/3"]
    assert [unit.starts_run for unit in running.out] == [True, False, False, False]
    assert running.out[0].starts_session
    assert not running.wants()


@pytest.fixture
def repaired(running):
    """The same, orderly for long, with an edge that sends again what is missing, 60 ms away."""
    for sequence in range(4, 4 + ORDERLY_UNITS):
        running.send(sequence)
    running.core.repair.round_trip_ns = 60 * MS
    return running


def test_a_hole_waits_for_what_the_edge_sends_again(repaired):
    """Each lost frame would darken the screen up to the next keyframe, though the frame is on its way."""
    first = 4 + ORDERLY_UNITS
    assert repaired.send(first + 1) == []
    assert (repaired.core.missing, repaired.core.newest_held.header.sequence) == ((first,), first + 1)
    assert repaired.send(first + 3) == []
    assert repaired.core.missing == (first, first + 2)
    assert not repaired.wants()
    assert repaired.send(first, after_ns=10 * MS, flags=Flags.RESENT) == [
        ("decode", first),
        ("decode", first + 1),
    ]
    assert repaired.core.missing == (first + 2,)
    assert repaired.send(first + 2, after_ns=MS, flags=Flags.RESENT)[-1] == ("decode", first + 3)
    assert (repaired.core.missing, repaired.core.newest_held) == ((), None)
    counters = repaired.core.counters
    assert (counters.lost, counters.gaps, counters.resent, counters.replayed) == (0, 0, 2, 0)
    assert_decodable(repaired.out)


def test_where_nothing_comes_again_a_keyframe_is_asked_for_and_whichever_is_first_is_shown(repaired):
    """A frame that was lost twice would stop the picture for good, and one that comes late be of no use."""
    at = 4 + ORDERLY_UNITS
    repaired.send(at + 1)
    assert repaired.send(at + 2, after_ns=179 * MS) == []
    assert not repaired.wants()
    assert repaired.send(at + 3, after_ns=MS) == []
    assert repaired.wants()
    assert repaired.send(at, after_ns=30 * MS, flags=Flags.RESENT)[-1] == ("decode", at + 3)
    assert not repaired.wants()
    assert [repaired.send(at + 5 + n) for n in range(11)] == [[]] * 11
    assert repaired.send(at + 16) == [("skip", at + n) for n in range(5, 17)]
    assert (repaired.core.counters.lost, repaired.core.missing) == (1, ())


def test_the_wait_is_as_long_as_what_is_sent_again_usually_takes(repaired):
    """On a thin link each hole would bring a keyframe beside the frame; on a quick one the screen stay dark."""
    for took_ms, wait_ms in ((90, 115), (400, 480)):
        for _ in range(60):
            at = repaired.out[-1].header.sequence + 1
            repaired.send(at + 1)
            repaired.send(at, after_ns=took_ms * MS, flags=Flags.RESENT)
            for n in range(2, 12):
                repaired.send(at + n)
        at = repaired.out[-1].header.sequence + 1
        repaired.send(at + 1)
        repaired.now_ns += took_ms * MS
        assert not repaired.wants()
        repaired.now_ns += (wait_ms - took_ms) * MS
        assert repaired.wants()
        repaired.send(at, flags=Flags.RESENT)


def test_where_nothing_comes_again_no_hole_waits_for_a_while(repaired):
    """Of two grounds one alone is listened to: each loss would cost the other a picture that comes later."""
    at = 4 + ORDERLY_UNITS

    def fly(seconds: int) -> None:
        nonlocal at
        for _ in range(15 * seconds):
            repaired.send(at)
            at += 1

    def lose(*, waits: bool) -> None:
        nonlocal at
        assert (repaired.send(at + 1) == []) == waits
        for n in (2, 3, 4):
            repaired.send(at + n)
        assert repaired.wants()
        repaired.send(at + 5, key=True)
        at += 6

    for _ in range(3):
        lose(waits=True)
    fly(18)
    lose(waits=False)
    fly(3)
    lose(waits=True)
    fly(38)
    lose(waits=False)
    fly(4)
    repaired.send(at + 1)
    repaired.send(at, after_ns=90 * MS, flags=Flags.RESENT)  # it comes after all
    at += 2
    lose(waits=True)
    lose(waits=True)


@pytest.mark.parametrize(
    ("step_ms", "lost", "round_trip_ms", "waits"),
    [
        (66, 1, 60, True),
        (66, 3, 60, True),
        (66, 4, 60, False),
        (33, 6, 60, True),
        (16, 9, 60, False),
        (133, 1, 60, True),
        (133, 2, 60, False),
        (200, 1, 60, False),
        (66, 1, 570, True),
        (16, 1, 240, True),
        (16, 1, 420, False),
        (66, 1, 600, False),
    ],
)
def test_no_hole_waits_that_the_edge_has_no_room_or_no_time_to_fill(
    ground, step_ms, lost, round_trip_ms, waits
):
    """At two pictures a second, and behind a satellite, each loss would cost a keyframe that comes later."""
    ground.core.repair.round_trip_ns = round_trip_ms * MS
    for sequence in range(2 * ORDERLY_UNITS):
        ground.send(sequence, key=sequence == 0, after_ns=step_ms * MS)
    ground.send(2 * ORDERLY_UNITS + lost, after_ns=(1 + lost) * step_ms * MS)
    assert (ground.held() > 0) == waits
    assert len(ground.core.missing) == lost * waits
    assert ground.wants() != waits


def test_without_a_keyframe_nothing_is_asked_for_again(repaired):
    """Frames that nobody can show would take the room of the keyframe that is awaited."""
    at = 4 + ORDERLY_UNITS
    repaired.send(at + 5)
    assert repaired.wants()
    assert repaired.send(at + 7) == [("skip", at + 7)]
    assert repaired.core.missing == ()


def test_on_links_that_reorder_nothing_is_asked_for_that_comes_by_itself(repaired):
    """Of several links one may be slower: each frame of it would go twice, and every second be left out for that."""
    at = 4 + ORDERLY_UNITS
    for _ in range(10):
        assert repaired.send(at + 1) == []
        first = repaired.core.named(repaired.now_ns)
        assert repaired.send(at, after_ns=45 * MS)[-1] == ("decode", at + 1)
        at += 2
    assert first == ()
    repaired.send(at + 1)
    assert repaired.core.named(repaired.now_ns + 89 * MS) == ()
    assert repaired.core.named(repaired.now_ns + 90 * MS) == (at,)


def test_what_comes_again_too_late_is_no_reason_to_wait(repaired):
    """A full link: each hole would be dark for seven tenths of a second before a keyframe is asked for."""
    at = 4 + ORDERLY_UNITS
    for _ in range(4):
        repaired.send(at + 1)
        for n in range(2, 13):
            repaired.send(at + n)
        repaired.send(at, after_ns=MS, flags=Flags.RESENT)  # given up before
        repaired.send(at + 13, key=True)
        at += 14
    assert repaired.send(at + 1) == [("skip", at + 1)]


def test_where_a_keyframe_is_there_sooner_it_is_asked_for_at_once(repaired):
    """The screen would be dark for as long as the slower of the two takes."""
    at = 4 + ORDERLY_UNITS
    for _ in range(30):
        repaired.send(at + 1)
        repaired.send(at, after_ns=400 * MS, flags=Flags.RESENT)
        for n in range(2, 12):
            repaired.send(at + n)
        at += 12
    repaired.send(at + 9)  # too much is missing
    assert repaired.wants()
    repaired.core.keyframe_requested(repaired.now_ns)
    repaired.send(at + 10, key=True, after_ns=150 * MS)
    repaired.send(at + 11)
    repaired.send(at + 12)
    assert repaired.send(at + 14) == []
    assert repaired.wants(), "both are on their way"


def test_a_resent_keyframe_begins_no_session(repaired):
    """After a stall the recording would be cut in two."""
    at = 4 + ORDERLY_UNITS
    repaired.send(at + 9)
    repaired.now_ns += RESTART_SILENCE_NS
    assert repaired.send(at + 2, key=True, flags=Flags.RESENT) == [("stale", at + 2)]
    assert repaired.sessions() == 1


def test_a_keyframe_ends_the_wait_and_nothing_long_is_waited_for(repaired):
    """The picture would stand still although it could go on, and a gap of a second never be repaired at all."""
    at = 4 + ORDERLY_UNITS
    for _ in range(5):
        assert repaired.send(at + 1) == []
        assert repaired.send(at + 2, key=True) == [("skip", at + 1), ("decode", at + 2)]
        at += 3
    assert repaired.send(at + 1) == []
    assert repaired.send(at, flags=Flags.RESENT)[-1] == ("decode", at + 1)
    at += 2
    assert repaired.send(at + MAX_MISSING_BASE + 1) == [("skip", at + MAX_MISSING_BASE + 1)]


def test_who_waits_for_a_lost_picture_is_not_silent(repaired):
    """A late packet of another session would take the screen, and the recording end."""
    at = 5 + ORDERLY_UNITS
    for n in range(9):
        repaired.send(at + n)
    assert repaired.send(0, key=True, session=2, after_ns=10 * MS) == [("foreign", 0)]
    for n in range(9, 12):
        repaired.send(at + n)
    assert repaired.core.newest_held is None
    assert repaired.send(0, key=True, session=2, after_ns=510 * MS) == [("decode", 0)]


def test_so_many_wait_at_the_most_behind_a_hole(repaired):
    """Whoever can send would fill the memory with pictures that wait."""
    at = 4 + ORDERLY_UNITS
    for n in range(40):
        repaired.send(at + n, after_ns=16 * MS)
    at += 41
    for n in range(RESEND_UNITS):
        assert repaired.send(at + n, after_ns=16 * MS) == []
    assert len(repaired.send(at + RESEND_UNITS, after_ns=16 * MS)) == RESEND_UNITS + 1


def test_late_join_asks_at_once_and_shows_from_the_keyframe(ground):
    """Someone who joins a running flight would see garbage, or nothing until the next periodic keyframe."""
    assert not ground.wants()
    assert ground.send(40) == [("skip", 40)]
    assert ground.wants()
    ground.core.keyframe_requested(ground.now_ns)
    assert not ground.wants()
    assert ground.send(41) == [("skip", 41)]
    assert ground.send(42, key=True) == [("decode", 42)]
    assert ground.send(43) == [("decode", 43)]
    assert not ground.wants()
    assert ground.core.counters.gaps == 0


def test_a_gap_skips_to_the_next_keyframe(running):
    """Pictures broken by a lost packet would be shown as if they were true."""
    for sequence in (5, 6):
        assert running.send(sequence, after_ns=MS) == []
        assert not running.wants()
    assert running.send(7, after_ns=MS) == [("skip", 5), ("skip", 6), ("skip", 7)]
    assert running.wants()
    assert running.send(8) == [("skip", 8)]
    assert running.send(9, key=True) == [("decode", 9)]
    assert running.send(10) == [("decode", 10)]
    assert running.out[4].lost_before == 1
    assert running.out[-2].starts_run
    assert not running.out[-2].starts_session
    assert running.decoded() == [0, 1, 2, 3, 9, 10]
    counters = running.core.counters
    assert (counters.gaps, counters.lost) == (1, 1)


def test_a_unit_that_comes_late_but_in_time_loses_nothing(running):
    """On a link of several paths every swap of two packets would cost a keyframe and a second of picture."""
    assert running.send(6, after_ns=MS) == []
    assert running.send(5, after_ns=MS) == []
    assert running.send(4, after_ns=MS) == [("decode", 4), ("decode", 5), ("decode", 6)]
    assert running.core.counters.gaps == 0
    assert running.out[-1].received_ns < running.out[-3].received_ns


def test_a_hole_is_given_up_after_its_wait_even_if_nothing_more_comes(running):
    """The picture would stand still behind one missing packet, with nobody asking for a keyframe."""
    running.send(5)
    assert not running.wants()
    running.now_ns += REORDER_WAIT_NS
    assert running.wants()
    assert running.send(6, after_ns=0) == [("skip", 5), ("skip", 6)]
    assert running.core.counters.lost == 1


def test_what_waits_behind_a_hole_is_settled_though_nothing_more_comes(running):
    """The edge would hear of nothing that came, hold its frames, and with them the keyframe: dark for 1.7 s."""
    assert running.send(5) == []
    assert running.core.overdue(now_ns=running.now_ns + 99_000_000) == []
    settled = running.core.overdue(now_ns=running.now_ns + 100_000_000)
    assert [(one.verdict, one.header.sequence) for one in settled] == [("skip", 5)]
    assert running.wants()


def test_a_hole_is_lost_at_once_where_nothing_ever_came_late(running):
    """After each loss the screen was dark for a tenth of a second more, on links that keep the order."""
    for sequence in range(4, ORDERLY_UNITS):
        running.send(sequence)
    assert running.send(31) == [("skip", 31)]
    assert running.wants()
    running.core.keyframe_requested(running.now_ns)
    assert running.send(30, after_ns=20 * MS) == [("stale", 30)]
    running.send(32, key=True, after_ns=100 * MS)
    assert running.send(34, after_ns=400 * MS) == []
    running.now_ns += 39 * MS
    assert not running.wants(), "it may come late, as that one"
    running.now_ns += MS
    assert running.wants()
    assert running.send(33, after_ns=0) == [("decode", 33), ("decode", 34)]
    running.send(36)
    running.now_ns += 79 * MS
    assert not running.wants(), "that one was 40 ms late"
    running.now_ns += MS
    assert running.wants()


def test_a_request_is_not_made_again_before_it_can_be_answered(running):
    """On a link of 0.2 s each way an edge would be asked twice for each loss, and some made two keyframes."""

    def asked(*, until_ms):
        times = []
        for ms in range(0, until_ms, 10):
            if running.core.wants_keyframe(running.now_ns + ms * MS):
                running.core.keyframe_requested(running.now_ns + ms * MS)
                times.append(ms)
        running.now_ns += until_ms * MS
        return times

    running.core.decoder_failed()
    assert asked(until_ms=480) == [0, 300], "how long an answer takes is not known"
    running.send(4, key=True, after_ns=0)
    running.now_ns += 400 * MS
    running.core.decoder_failed()
    assert asked(until_ms=590) == [0]
    assert asked(until_ms=60) == [10]


def test_a_keyframe_does_not_wait_behind_a_hole(running):
    """After a loss the picture would come back later than the link allows."""
    running.send(5, after_ns=MS)
    assert running.send(7, key=True, after_ns=MS) == [("skip", 5), ("decode", 7)]
    assert running.core.counters.gaps == 2
    assert running.send(6, after_ns=MS) == [("stale", 6)]
    assert running.send(8, after_ns=MS) == [("decode", 8)]


def test_requests_for_one_gap_back_off(running):
    """A ground on a thin link would drown the edge in keyframe requests, each worth 20 kB."""
    running.send(10, after_ns=REORDER_WAIT_NS)
    asked_ms = []
    for step_ms in range(0, 4000, 10):
        now_ns = running.now_ns + REORDER_WAIT_NS + step_ms * MS
        if running.core.wants_keyframe(now_ns):
            running.core.keyframe_requested(now_ns)
            asked_ms.append(step_ms)
    assert asked_ms == [0, 300, 600, 1200, 2200, 3200]
    running.core.keyframe_requested(running.now_ns)
    running.send(11, key=True, after_ns=50 * MS)
    running.core.decoder_failed()
    running.now_ns += 99 * MS
    assert not running.wants(), "the edge would take it for answered by that keyframe"
    running.now_ns += MS
    assert running.wants()


def test_duplicates_and_replays_are_told_apart_and_never_decoded(running):
    """Replayed traffic would make the picture jump back, or break the decoder's references."""
    assert running.send(3) == [("duplicate", 3)]
    assert running.send(0, key=True) == [("duplicate", 0)]
    running.send(5, after_ns=MS)
    assert running.send(5, after_ns=MS) == [("duplicate", 5)]
    assert running.send(4, after_ns=MS) == [("decode", 4), ("decode", 5)]
    for sequence in range(6, 80):
        running.send(sequence)
    assert running.send(2) == [("stale", 2)]
    assert running.decoded() == list(range(80))
    assert running.core.counters.replayed == 1
    assert running.core.counters.duplicates == 3
    assert not running.wants()


def test_a_restarted_edge_is_shown_from_its_keyframe_and_its_past_is_not(running):
    """After a restart of the edge the ground would show nothing, or mix two flights."""
    running.now_ns += SILENCE_NS + ADOPTION_INTERVAL_NS
    assert running.send(0, key=True, session=2) == [("decode", 0)]
    assert running.out[-1].starts_session
    assert running.send(4, session=1) == [("foreign", 4)]
    assert running.send(2, session=1) == [("stale", 2)]
    assert running.send(1, session=2) == [("decode", 1)]
    assert running.sessions() == 2


def test_a_quick_restart_is_asked_for_a_second_keyframe(running):
    """An edge that restarts within the silence would stay dark until its next periodic keyframe."""
    assert running.send(0, key=True, session=2) == [("foreign", 0)]
    while not running.wants():
        assert running.send(1, session=2, after_ns=10 * MS) == [("foreign", 1)]
    running.now_ns += ADOPTION_INTERVAL_NS
    assert running.send(9, key=True, session=2) == [("decode", 9)]


def test_two_edges_of_one_name_do_not_thrash(running):
    """A second edge with the same id would make the picture jump to and fro, and reset every track."""
    for sequence in range(4, 100):
        running.send(sequence, after_ns=FRAME_NS // 2)
        running.send(sequence - 4, session=2, key=sequence % 5 == 4, after_ns=FRAME_NS // 2)
    assert running.decoded() == list(range(100))
    assert [unit.verdict for unit in running.out].count("foreign") == 96
    assert not running.wants()


def beside(ground, count, *, interval_ns=FRAME_NS, first=4):
    """The first edge goes on, and a second one of the same id beside it; the sequence that comes next."""
    for sequence in range(first, first + count):
        ground.send(sequence, key=sequence == first, after_ns=interval_ns // 2)
        ground.send(sequence - first, session=2, key=sequence % 3 == 0, after_ns=interval_ns // 2)
    return first + count


def test_a_second_edge_of_one_id_is_noticed_and_waits_until_the_first_is_silent(running):
    """In each pause of the first the operator would look through another drone's perception, and never be told."""
    end = beside(running, 40)
    assert [unit.duplicate for unit in running.out if unit.header.session_id == 2][-20:] == [True] * 20
    assert not any(unit.duplicate for unit in running.out if unit.header.session_id == 1)
    assert running.send(end, session=2, key=True, after_ns=DUPLICATE_SILENCE_NS - 100 * MS) == [
        ("foreign", end)
    ]
    assert not running.wants(), "nothing is missed while the first may go on"
    assert running.send(end) == [("decode", end)]
    assert running.send(end + 1, session=2, after_ns=DUPLICATE_SILENCE_NS + MS) == [("foreign", end + 1)]
    assert running.wants()
    assert running.send(end + 2, session=2, key=True) == [("decode", end + 2)]
    assert running.out[-1].starts_session
    # The first comes back: now it is the second.
    for sequence in range(end + 3, end + 43):
        assert running.send(sequence, session=2) == [("decode", sequence)]
        assert running.send(sequence, key=True) == [("foreign", sequence)]
    assert running.out[-1].duplicate


def test_a_second_edge_does_not_get_in_at_a_low_frame_rate(ground):
    """With two frames a second every pause between them would look like a restart."""
    ground.send(0, key=True)
    for sequence in range(1, 4):
        ground.send(sequence, after_ns=500 * MS)
    beside(ground, 30, interval_ns=500 * MS)
    assert ground.decoded() == list(range(34))
    assert {unit.header.session_id for unit in ground.out if unit.verdict == "decode"} == {1}


def test_a_restart_is_not_taken_for_a_second_edge(running):
    """A restarted edge would stay dark for seconds."""
    running.send(0, key=True, session=2)
    running.send(4)  # still in flight when the new one began
    running.send(1, session=2, after_ns=SILENCE_NS + ADOPTION_INTERVAL_NS)
    assert running.wants()
    assert running.send(2, key=True, session=2) == [("decode", 2)]
    assert not any(unit.duplicate for unit in running.out)
    assert DUPLICATE_AFTER_NS > FRAME_NS


def test_sessions_change_at_most_once_a_second(running):
    """An edge that crashes and starts over and over would reset the screen with every try."""
    running.now_ns += 2 * ADOPTION_INTERVAL_NS
    running.send(0, key=True, session=2)
    assert running.send(0, key=True, session=3, after_ns=SILENCE_NS) == [("foreign", 0)]
    assert running.send(0, key=True, session=3, after_ns=SILENCE_NS) == [("decode", 0)]


def test_a_session_that_was_left_may_come_back_only_beyond_where_it_was(running):
    """One forged keyframe in a short silence would lock the true edge out for good."""
    running.now_ns += 2 * ADOPTION_INTERVAL_NS
    running.send(0, key=True, session=666)
    running.now_ns += 2 * ADOPTION_INTERVAL_NS
    assert running.send(0, key=True) == [("stale", 0)]
    assert running.send(50, key=True) == [("decode", 50)]
    assert running.send(51) == [("decode", 51)]


def test_an_absurd_number_is_not_believed(running):
    """One flipped bit in a sequence number would make all that follows look old: a dark screen for good."""
    for sequence in (1 << 63, MAX_U64, 4 + SEQUENCE_SLACK + 100):
        assert running.send(sequence, key=True) == [("implausible", sequence)]
    assert running.send(4, frame=1 << 62) == [("implausible", 4)]
    assert running.send(4) == [("decode", 4)]
    assert running.core.counters.lost == 0


def test_a_long_outage_is_one_gap_of_one_session(running):
    """Twenty seconds behind a hill would count as another flight and lose all tracks, or never end."""
    assert running.send(304, after_ns=20_000 * MS) == []
    assert running.send(305, key=True) == [("skip", 304), ("decode", 305)]
    assert running.core.counters.lost == 300
    assert running.sessions() == 1


def test_a_backlog_with_many_dropped_frames_is_decoded(running):
    """An edge that drops frames on a full link would be taken for a forger when the link opens."""
    assert running.send(4, frame=1200, after_ns=MS) == [("decode", 4)]


@pytest.mark.parametrize(("sequence", "frame"), [(1 << 60, 2), (3, 1 << 60)])
def test_a_forged_first_keyframe_does_not_darken_the_screen_for_good(ground, sequence, frame):
    """A ground that joins on one damaged header would refuse the whole flight after it."""
    ground.send(sequence, key=True, frame=frame)
    for number in range(4, 64):
        ground.send(number, key=number % 15 == 0, after_ns=FRAME_NS)
    assert ground.decoded()[-4:] == [60, 61, 62, 63]
    assert ground.now_ns - 5_000_000_000 < 2 * RESTART_SILENCE_NS + 100 * MS


def test_a_frame_index_that_goes_back_is_not_shown(running):
    """Histories and recordings rise by frame; one that goes back would crash or falsify them."""
    assert running.send(4, frame=6) == [("implausible", 4)]
    running.send(6, frame=40, after_ns=MS)
    running.send(5, frame=50, after_ns=MS)
    assert running.send(4, frame=30, after_ns=MS) == [("decode", 4), ("decode", 5), ("implausible", 6)]
    assert running.wants()


def test_corruption_and_a_failed_decoder_lead_to_a_request(running):
    """A stream that arrives only damaged would leave the screen frozen without anyone asking."""
    running.core.corrupt()
    assert not running.wants(), "the hole will show by itself while others come"
    running.now_ns += SILENCE_NS
    assert running.wants()
    running.send(4)
    assert not running.wants()
    running.core.decoder_failed()
    assert running.wants()
    assert running.send(5) == [("skip", 5)]
    assert running.send(6, key=True) == [("decode", 6)]
    assert running.core.counters.corrupt == 1


def test_damage_before_the_first_picture_leads_to_a_request(ground):
    """A late join whose first packets are damaged would wait for a periodic keyframe."""
    ground.core.corrupt()
    assert ground.wants()


units = st.tuples(st.booleans(), st.booleans(), st.integers(0, 2), st.sampled_from([0, 0, 0, 1, 2, 3, 5, 90]))
"""keyframe, lost, extra copies, positions late."""


@settings(deadline=None, max_examples=200)
@given(
    pattern=st.lists(units, max_size=60),
    copies_late=st.integers(0, 80),
    step_ms=st.sampled_from([1, 30, 67]),
    round_trip_ns=st.sampled_from([None, 0, 300 * MS]),
)
def test_no_pattern_of_loss_and_reordering_reaches_the_decoder(pattern, copies_late, step_ms, round_trip_ns):
    """Some unlucky order of packets would break the picture without anyone noticing."""
    ground = Ground()
    ground.core.repair.round_trip_ns = round_trip_ns
    arrivals = []
    for sequence, (key, lost, copies, late) in enumerate(pattern):
        if not lost:
            arrivals.append((sequence + late, sequence, key))
            arrivals += [(sequence + late + copies_late * n, sequence, key) for n in range(1, copies + 1)]
    for _, sequence, key in sorted(arrivals, key=lambda arrival: arrival[0]):
        ground.send(sequence, key=key, after_ns=step_ms * MS)
        assert 0 <= ground.held() <= RESEND_UNITS, "each unit has one verdict, or waits"
    assert_decodable(ground.out)

    end = len(pattern)
    ground.now_ns += RESTART_SILENCE_NS  # whatever was delayed has come
    tail = [ground.send(end + n, key=n == 0) for n in range(3)]
    assert [resolved[-1] for resolved in tail] == [("decode", end + n) for n in range(3)]
    assert_decodable(ground.out)
    assert ground.held() == 0
    distinct = {sequence for _, sequence, _ in arrivals}
    if distinct and ground.sessions() == 1:
        first = next(unit for unit in ground.out if unit.starts_session).header.sequence
        lost = ground.core.counters.lost
        assert lost >= sum(sequence >= first and p[1] for sequence, p in enumerate(pattern))


hostile = st.tuples(
    st.one_of(st.integers(1, 3), st.integers(0, MAX_U64)),
    st.one_of(st.integers(0, 40), st.integers(0, MAX_U64)),
    st.one_of(st.integers(0, 90), st.integers(0, MAX_U64)),
    st.booleans(),
    st.sampled_from([0, 1, 20, 70, 600, 1100, 2500]),
)


@settings(deadline=None, max_examples=200)
@given(messages=st.lists(hostile, max_size=60))
def test_forged_headers_neither_grow_memory_nor_end_the_picture(messages):
    """Anyone who can send a packet could crash the ground, fill its memory or darken it for good."""
    ground = Ground()
    for session, sequence, frame, key, after_ms in messages:
        ground.send(sequence, key=key, session=session, frame=frame, after_ns=after_ms * MS)
        if ground.wants():
            ground.core.keyframe_requested(ground.now_ns)
        assert 0 <= ground.held() <= RESEND_UNITS, "each unit has one verdict, or waits"
        assert footprint_bytes(ground.core) < 40_000
    assert_decodable(ground.out)

    sequence = 0  # the true edge, of a session nobody has forged, answers requests with keyframes
    while sequence < 60:
        key = sequence == 0 or ground.wants()
        if key:
            ground.core.keyframe_requested(ground.now_ns)
        ground.send(sequence, key=key, session=-1)
        sequence += 1
    last = ground.out[-1]
    assert (last.verdict, last.header.session_id, last.header.sequence) == ("decode", -1, 59)


@settings(deadline=None, max_examples=50)
@given(sessions=st.lists(st.integers(2, MAX_U64), min_size=50, max_size=200), keys=st.booleans())
def test_a_flood_of_invented_sessions_does_not_disturb_a_live_one(sessions, keys):
    """A stranger on the same key could reset the operator's screen with every packet."""
    ground = Ground()
    ground.send(0, key=True)
    for sequence, session in enumerate(sessions, start=1):
        ground.send(0, key=keys, session=session, after_ns=0)
        ground.send(sequence)
    assert ground.decoded() == list(range(len(sessions) + 1))
    assert ground.sessions() == 1
    assert not ground.wants()


def test_the_picture_comes_back_after_somebody_has_counted_on_in_the_edges_name():
    """One burst of forged numbers would darken the screen until the edge had counted up to them: minutes."""
    ground = Ground()
    for sequence in range(10):
        ground.send(sequence, key=sequence == 0)
    for ahead in range(2000):  # four seconds of a flood, within what is plausible
        ground.send(10 + ahead, session=1, after_ns=2 * MS)
    assert ground.decoded()[-1] == 2009
    assert ground.send(70) == [("stale", 70)]
    for sequence in range(71, 71 + 80):
        key = ground.wants()
        if key:
            ground.core.keyframe_requested(ground.now_ns)
        ground.send(sequence, key=key)
    assert ground.decoded()[-1] == 150
    assert_decodable(ground.out)
    assert ground.sessions() == 2


def test_a_replayed_keyframe_of_a_moment_ago_does_not_start_the_picture_afresh(running):
    """Whoever repeats the last keyframe while the link is down would show the operator an old scene as the new."""
    assert running.send(0, key=True, after_ns=3 * RESTART_SILENCE_NS) == [("duplicate", 0)]
    assert running.sessions() == 1
