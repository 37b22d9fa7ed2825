"""What an edge kept while its link was away: put together again, bounded, acknowledged, each once."""

from __future__ import annotations

import random

import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from hvt_common.protocol.messages import (
    MAX_BACKLOG_BYTES,
    AcknowledgedRange,
    BacklogHeader,
    BacklogStill,
    Flags,
    Info,
    WireError,
    pack_backlog_still,
)
from hvt_common.runtime.statistics import SequenceWindow
from hvt_ground.backlog.assembly import BacklogAssembly, backlog_content
from hvt_ground.perception.stills.decode import ReceivedStill
from rigs.backlog_chunks import info_object, still_object, video_object
from rigs.flight import Flight
from rigs.footprint import footprint_bytes


def header(offset: int = 0, total: int = 10, *, kind="still", number=3, session=7) -> BacklogHeader:
    """Of a chunk."""
    return BacklogHeader(
        session_id=session, kind=kind, number=number, offset=offset, total_bytes=total, send_ns=0
    )


def acknowledged_range(number: int, acknowledged_bytes: int, *, kind="still", session=7) -> AcknowledgedRange:
    """What the edge hears."""
    return AcknowledgedRange(
        session_id=session, kind=kind, number=number, acknowledged_bytes=acknowledged_bytes
    )


KEY = (7, "still", 3)
TEN = b"0123456789"


def test_pieces_in_order_become_the_object():
    """Nothing of an outage would ever be seen, or the edge would send it for ever."""
    assembly = BacklogAssembly()
    assert assembly.chunk(header(), TEN[:4]) is None
    assert assembly.take_acknowledged_ranges(16) == (acknowledged_range(3, 4),)
    assert assembly.chunk(header(4), TEN[4:]) == TEN
    assert assembly.take_acknowledged_ranges(16) == (acknowledged_range(3, 9),), (
        "it is not where it belongs yet"
    )
    assembly.settle(KEY, usable=True)
    assert assembly.take_acknowledged_ranges(16) == (acknowledged_range(3, 10),)
    assert (assembly.in_progress, assembly.size_bytes) == (0, 0)


def test_an_object_is_acknowledged_when_it_is_settled_however_long_that_takes():
    """The edge forgets what it hears of: on a slow ground, a still that nobody has read is lost with the session."""
    assembly = BacklogAssembly()
    assert assembly.chunk(header(), TEN) == TEN
    for _ in range(100):  # the edge asks every two seconds, with the last byte
        assert assembly.chunk(header(9), TEN[9:]) is None
        assert assembly.take_acknowledged_ranges(16) == (acknowledged_range(3, 9),), (
            "somebody is there, and has it all but finished"
        )
    assert assembly.chunk(header(total=9), TEN[:9]) is None
    assert assembly.take_acknowledged_ranges(16) == (acknowledged_range(3, 0),), (
        "another one of the same name has to wait"
    )
    assembly.settle(KEY, usable=True)
    assert assembly.take_acknowledged_ranges(16) == (acknowledged_range(3, 10),)


def test_what_is_in_progress_is_not_settled_by_a_word_too_late():
    """An object that begins again after a session has ended would lose what has come of it."""
    assembly = BacklogAssembly()
    assembly.chunk(header(), TEN)
    assert assembly.drop_handed() == 1
    assembly.chunk(header(), TEN[:6])
    assembly.settle(KEY, usable=True)
    assembly.settle(KEY, usable=None)
    assert assembly.chunk(header(6), TEN[6:]) == TEN
    assembly.settle(KEY, usable=None)
    assert (assembly.in_progress, assembly.take_acknowledged_ranges(16)) == (0, ()), (
        "nobody can take it: nothing is said of it"
    )


def test_only_the_run_without_a_hole_is_held():
    """An object with a hole in it would be taken for a whole one."""
    assembly = BacklogAssembly()
    assembly.chunk(header(), TEN[:3])
    assembly.chunk(header(6), TEN[6:8])
    assert assembly.take_acknowledged_ranges(16) == (acknowledged_range(3, 3),)
    assembly.chunk(header(1), TEN[1:5])  # it overlaps and goes on
    assembly.chunk(header(0), TEN[:2])  # old
    assert assembly.take_acknowledged_ranges(16) == (acknowledged_range(3, 5),)
    assert assembly.chunk(header(2), TEN[2:]) == TEN


def test_what_was_delivered_is_acknowledged_again_and_not_delivered_again():
    """Where a report is lost the still would be in the gallery twice, or sent until the store is full."""
    assembly = BacklogAssembly(remember=3)
    for number in range(5):
        assert assembly.chunk(header(number=number), TEN) == TEN
        assert assembly.chunk(header(number=number), TEN) is None, "it is being worked on"
        assembly.settle((7, "still", number), usable=True)
    assert len(assembly.take_acknowledged_ranges(3)) == 3
    assembly.take_acknowledged_ranges(16)
    assert assembly.chunk(header(number=4), TEN) is None
    assert assembly.chunk(header(3, number=3), TEN[3:5]) is None
    assert assembly.take_acknowledged_ranges(16) == (acknowledged_range(4, 10), acknowledged_range(3, 10))
    assert assembly.chunk(header(total=9, number=4), TEN[:9]) == TEN[:9], "another one of the same name"
    assert assembly.chunk(header(number=0), TEN) == TEN, "what is known again is bounded"


def test_another_size_begins_anew():
    """Two halves of two objects would be one."""
    assembly = BacklogAssembly()
    assembly.chunk(header(), TEN[:6])
    assembly.chunk(header(6, 12), b"xy")
    assert assembly.take_acknowledged_ranges(16) == (acknowledged_range(3, 0),)
    assert assembly.chunk(header(0, 12), TEN + b"xy") == TEN + b"xy"


@pytest.mark.parametrize(
    ("offset", "total", "payload", "kind", "number"),
    [
        (0, 10, b"", "still", 1),
        (8, 10, b"abc", "still", 1),
        (0, 10, b"abc", "info", 1),
        (0, Info.MAX_BYTES + 1, b"abc", "info", 0),
    ],
)
def test_a_piece_that_cannot_be_one_is_refused(offset, total, payload, kind, number):
    """Memory would follow whatever a stranger sends."""
    assembly = BacklogAssembly()
    with pytest.raises(WireError):
        assembly.chunk(header(offset, total, kind=kind, number=number), payload)
    assert (assembly.in_progress, assembly.take_acknowledged_ranges(16)) == (0, ())


def test_an_unusable_object_is_asked_for_again_but_not_for_ever():
    """One bad object would take the link for the rest of the flight."""
    assembly = BacklogAssembly()
    for _ in range(2):
        assert assembly.chunk(header(), TEN) == TEN
        assembly.settle(KEY, usable=False)
        assert assembly.take_acknowledged_ranges(16) == (acknowledged_range(3, 0),)
    assert assembly.chunk(header(), TEN) == TEN
    assembly.settle(KEY, usable=False)
    assert assembly.take_acknowledged_ranges(16) == (acknowledged_range(3, 10),)


def test_what_cannot_be_taken_now_comes_again():
    """While much waits, or a session is not known, an object would be acknowledged and lost."""
    assembly = BacklogAssembly()
    assembly.chunk(header(), TEN[:4], may_finish=False)
    assert assembly.chunk(header(4), TEN[4:], may_finish=False) is None
    assembly.want_info(7)
    assert assembly.take_acknowledged_ranges(16) == (
        acknowledged_range(3, 4),
        acknowledged_range(0, 0, kind="info"),
    )
    assert assembly.chunk(header(4), TEN[4:]) == TEN
    assembly.drop_handed()  # the session that had it is gone
    assembly.settle(KEY, usable=True)
    assert assembly.take_acknowledged_ranges(16) == (acknowledged_range(3, 0),)
    assembly.chunk(header(4), TEN[4:])
    assert assembly.take_acknowledged_ranges(16) == (acknowledged_range(3, 0),)


def test_facts_of_a_session_are_delivered_as_often_as_they_come():
    """A ground that has forgotten them would ask for ever, and hear that it has them."""
    assembly = BacklogAssembly()
    for _ in range(2):
        assert assembly.chunk(header(kind="info", number=0), TEN) == TEN
        assembly.settle((7, "info", 0), usable=True)
        assert assembly.take_acknowledged_ranges(16) == (acknowledged_range(0, 10, kind="info"),)


def test_a_full_assembly_gives_up_what_has_waited_longest():
    """Objects that never end would fill the ground's memory, or keep out all others."""
    assembly = BacklogAssembly(max_objects=3, max_bytes=MAX_BACKLOG_BYTES)
    for number in range(5):
        assembly.chunk(header(number=number), TEN[:2])
    assert assembly.in_progress == 3
    assert len(assembly.take_acknowledged_ranges(16)) == 5
    assembly.chunk(header(2, number=0), TEN[2:4])
    assert assembly.take_acknowledged_ranges(16) == (acknowledged_range(0, 0),)
    assert assembly.chunk(header(2, number=4), TEN[2:]) == TEN
    big = bytes(MAX_BACKLOG_BYTES)
    assert assembly.chunk(header(total=MAX_BACKLOG_BYTES, number=9), big) is None, "one is being worked on"
    assembly.settle((7, "still", 4), usable=True)
    assert assembly.chunk(header(total=MAX_BACKLOG_BYTES, number=9), big) == big
    assert assembly.size_bytes <= MAX_BACKLOG_BYTES


QUARTER = MAX_BACKLOG_BYTES // 4
ZEROS = bytes(MAX_BACKLOG_BYTES)
chunk_of = st.tuples(
    st.integers(0, 5),  # number
    st.sampled_from([None, None, None, 0, 1, 2, 3]),  # where it begins, quarters; None goes on
    st.integers(0, 4),  # how long it is
    st.integers(1, 4),  # of how many
    st.booleans(),
    st.sampled_from(["settle", "refuse", "drop", "keep", "keep"]),
)


@given(reported=st.lists(chunk_of, max_size=40))
@settings(max_examples=60, deadline=None)
def test_whatever_comes_it_stays_within_bounds(reported):
    """A hostile sender would crash the ground or make it grow."""
    assembly = BacklogAssembly(max_objects=3, max_bytes=MAX_BACKLOG_BYTES + QUARTER, remember=2)
    fullest, heard = 0, {}
    for number, begins, length, total, may_finish, then in reported:
        offset = heard.get(number, 0) if begins is None else begins * QUARTER
        try:
            whole = assembly.chunk(
                header(offset, total * QUARTER, number=number),
                ZEROS[: min(length * QUARTER, total * QUARTER - offset)],
                may_finish=may_finish,
            )
        except WireError:
            continue
        heard |= {said.number: said.acknowledged_bytes for said in assembly.take_acknowledged_ranges(16)}
        fullest = max(fullest, assembly.size_bytes)
        assert assembly.in_progress <= 3
        assert assembly.size_bytes <= MAX_BACKLOG_BYTES + QUARTER
        if whole is None:
            continue
        assert len(whole) == total * QUARTER
        if then == "drop":
            assembly.settle((7, "still", number), usable=None)
        elif then != "keep":
            assembly.settle((7, "still", number), usable=then == "settle")
    event("full" if fullest > MAX_BACKLOG_BYTES else "not full")


def test_acknowledgements_that_nobody_fetches_are_bounded():
    """While the way back is away, memory would follow what comes."""
    assembly = BacklogAssembly()
    for number in range(2000):
        assembly.chunk(header(number=number), TEN[:3])
    said = 0
    while taken := assembly.take_acknowledged_ranges(16):
        assert len(taken) <= 16
        said += len(taken)
    assert said == 512


def test_no_more_than_the_bound_is_held_to_the_byte():
    """The bound would be there, and one object more would go beyond it."""
    assembly = BacklogAssembly(max_bytes=MAX_BACKLOG_BYTES + 10)
    half = MAX_BACKLOG_BYTES // 2
    assert len(assembly.chunk(header(total=half), ZEROS[:half])) == half, (
        "handed out: it takes its bytes still"
    )
    assert assembly.chunk(header(total=half + 20, number=4), ZEROS[: half + 10]) is None
    assert assembly.size_bytes == MAX_BACKLOG_BYTES + 10
    assert assembly.chunk(header(half + 10, half + 20, number=4), ZEROS[:1]) is None
    assert assembly.take_acknowledged_ranges(16) == (
        acknowledged_range(3, half - 1),
        acknowledged_range(4, half + 10),
    ), "no byte more"
    assembly.chunk(header(number=5), TEN)  # what waits gives way, what is worked on does not
    assert assembly.size_bytes == half + 10


@given(
    data=st.binary(min_size=1, max_size=300),
    cuts=st.lists(st.integers(1, 299), max_size=6),
    seed=st.integers(0, 2**32),
)
@settings(max_examples=150, deadline=None)
def test_an_edge_that_follows_the_acknowledgements_gets_everything_across(data, cuts, seed):
    """Lost, doubled or reordered chunks would leave an object unfinished for ever."""
    assembly, chance = BacklogAssembly(), random.Random(seed)
    size = max(1, len(data) // (len(cuts) + 1))
    at, whole = 0, None
    for _ in range(2000):
        burst = list(range(at, len(data), size)[:3])
        chance.shuffle(burst)
        for offset in burst:
            if chance.random() < 0.3:
                continue
            whole = whole or assembly.chunk(header(offset, len(data)), data[offset : offset + size])
        if whole is not None:
            break
        for said in assembly.take_acknowledged_ranges(16):
            at = said.acknowledged_bytes
    assert whole == data


# What is in an object


@pytest.fixture(scope="module")
def flight() -> Flight:
    """Two seconds."""
    return Flight(30, keyframes=(20,))


def test_objects_are_read(flight):
    """Nothing of an outage could be shown."""
    sid = flight.session_id
    still = backlog_content((sid, "still", 4), still_object(flight, 6, 4), edge="uav-1")
    assert isinstance(still, ReceivedStill)
    assert (still.header.sequence, still.header.frame_index) == (4, 6)
    assert still.header.flags & Flags.STORED
    assert still.data.startswith(b"\xff\xd8")
    units = backlog_content((sid, "base", 20), video_object(flight, range(20, 25)), edge="uav-1")
    assert [unit.frame_index for unit in units] == list(range(20, 25))
    info = backlog_content((sid, "info", 0), info_object(flight), edge="uav-1")
    assert info.session_id == sid


def test_objects_that_are_another_inside_are_refused(flight):
    """A still would be shown in the wrong session, or under the wrong number."""
    sid = flight.session_id
    still, video, info = still_object(flight, 6, 4), video_object(flight, [20]), info_object(flight)
    broken = flight.still(6, 4)
    damaged = pack_backlog_still(BacklogStill(broken.attachment, broken.encoding, broken.payload + b"x"))
    for key, data, edge in (
        ((sid, "still", 5), still, "uav-1"),
        ((sid + 1, "still", 4), still, "uav-1"),
        ((sid, "still", 4), damaged, "uav-1"),
        ((sid, "still", 4), still_object(flight, 6, 4, flags=0), "uav-1"),
        ((sid, "still", 4), still_object(flight, 6, 4, capture_ns=-1), "uav-1"),
        ((sid, "still", 4), video, "uav-1"),
        ((sid, "base", 21), video, "uav-1"),
        ((sid, "base", 20), still, "uav-1"),
        ((sid + 1, "info", 0), info, "uav-1"),
        ((sid, "info", 0), info, "uav-2"),
    ):
        with pytest.raises(WireError):
            backlog_content(key, data, edge=edge)


@given(data=st.binary(max_size=400), kind=st.sampled_from(["info", "still", "base"]))
@settings(max_examples=300, deadline=None)
def test_any_bytes_are_refused_or_read(data, kind):
    """One hostile object would end the ground."""
    with pytest.raises(WireError):
        backlog_content((7, kind, 0), data, edge="uav-1")


# What has been


@given(numbers=st.lists(st.integers(0, 20_000), max_size=80))
@settings(max_examples=100, deadline=None)
def test_numbers_are_known_again_in_any_order(numbers):
    """A still that was missed long ago would be taken for one that has been shown."""
    seen, plain = SequenceWindow(), set()
    for number in numbers:
        assert (number in seen) == (number in plain)
        assert seen.add([number]) == (number not in plain)
        plain.add(number)
    assert seen.count == len(plain)


def test_forged_numbers_neither_fill_the_memory_nor_silence_those_that_come():
    """Somebody who makes up numbers would have every still that is sent afterwards taken for an old one."""
    seen = SequenceWindow(pages=4)
    for number in range(40):
        assert seen.add([number]) == 1, "it has not been, whatever else has"
        assert seen.add([(number + 1) << 20]) == 1
        assert footprint_bytes(seen) < 8_000
    assert all(number in seen for number in range(40)), "what goes on is remembered"
    assert seen.add([39]) == 0
    assert seen.add([2**32 - 1]) == 1
