"""What an edge kept while its link was away: put together again, bounded, acknowledged, each once."""

import random

import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from hvt_common.protocol.messages import (
    MAX_BACKLOG_BYTES,
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
    return BacklogHeader(
        session_id=session, kind=kind, number=number, offset=offset, total_bytes=total, send_ns=0
    )


MOST, HALF = MAX_BACKLOG_BYTES, MAX_BACKLOG_BYTES // 2
ZEROS = bytes(MOST)
LARGEST = {"max_objects": 3, "max_bytes": MOST}
STORIES = {
    "nothing of an outage would ever be seen, or the edge would send it for ever": """
        3 0-4; heard 3=4; 3 4-10: whole; heard 3=9; settle 3 used; heard 3=10; objects 0; bytes 0""",
    "of a still that a slow ground has not read yet an edge would hear that it may forget it": f"""
        3 0-10: whole; {100 * "3 9-10; heard 3=9;"} 3 0-9/9; heard 3=0; settle 3 used; heard 3=10""",
    "an object that begins again after a session has ended would lose what has come of it": """
        3 0-10: whole; drop 1; 3 0-6; settle 3 used; settle 3 untaken; 3 6-10: whole; settle 3 untaken;
        objects 0; heard""",
    "an object with a hole in it would be taken for a whole one": """
        3 0-3; 3 6-8; heard 3=3; 3 1-5; 3 0-2; heard 3=5; 3 2-10: whole""",
    "two halves of two objects would be one": """
        3 0-6; 3 6-8/12; heard 3=0; 3 0-12/12: whole""",
    "one bad object would take the link for the rest of the flight": f"""
        {2 * "3 0-10: whole; settle 3 unusable; heard 3=0;"} 3 0-10: whole; settle 3 unusable; heard 3=10""",
    "while much waits, or a session is not known, an object would be acknowledged and lost": """
        3 0-4 busy; 3 4-10 busy; want; heard 3=4 info0=0; 3 4-10: whole; drop 1; settle 3 used; heard 3=0;
        3 4-10; heard 3=0""",
    "a ground that has forgotten the facts of a session would ask for ever": f"""
        {2 * "info0 0-10: whole; settle info0 used; heard info0=10;"} objects 0""",
    "objects that never end would fill the ground's memory, or keep out all others": (
        LARGEST,
        f"""0 0-2; 1 0-2; 2 0-2; 3 0-2; 4 0-2; objects 3; heard 0=2 1=2 2=2 3=2 4=2; 0 2-4; heard 0=0;
        4 2-10: whole; 9 0-{MOST}/{MOST}; settle 4 used; 9 0-{MOST}/{MOST}: whole; bytes {MOST}""",
    ),
    "where a report is lost the still would be in the gallery twice, or sent until the store is full": (
        {"remember": 3},
        "".join(f"{n} 0-10: whole; {n} 0-10; settle {n} used;" for n in range(5))
        + """heard 0=10 1=10 2=10 3=10 4=10; 4 0-10; 3 3-5; heard 4=10 3=10; 4 0-9/9: whole; 0 0-10: whole""",
    ),
    "the bound would be there, and one object more would go beyond it": (
        {"max_bytes": MOST + 10},
        f"""3 0-{HALF}/{HALF}: whole; 4 0-{HALF + 10}/{HALF + 20}; bytes {MOST + 10};
        4 {HALF + 10}-{HALF + 11}/{HALF + 20}; heard 3={HALF - 1} 4={HALF + 10}; 5 0-10: whole;
        bytes {HALF + 10}""",
    ),
}


def key_of(name: str) -> tuple[int, str, int]:
    """Of the still ``3``, or of ``info0``."""
    return (7, "info", 0) if name == "info0" else (7, "still", int(name))


def do(assembly: BacklogAssembly, step: str, expected: str) -> None:
    word, *options = step.split()
    match word:
        case "heard":
            taken = assembly.take_acknowledged_ranges(16)
            said = ["info0" if one.kind == "info" else str(one.number) for one in taken]
            heard = [f"{name}={one.acknowledged_bytes}" for name, one in zip(said, taken, strict=True)]
            assert heard == options
        case "settle":
            usable = {"used": True, "unusable": False, "untaken": None}[options[1]]
            assembly.settle(key_of(options[0]), usable=usable)
        case "drop":
            assert assembly.drop_handed() == int(options[0])
        case "want":
            assembly.want_info(7)
        case "objects" | "bytes":
            assert (assembly.in_progress if word == "objects" else assembly.size_bytes) == int(options[0])
        case _:
            span, _, total = options[0].partition("/")
            begin, end = map(int, span.split("-"))
            _, kind, number = key_of(word)
            size = int(total or 10)
            content = b"0123456789xy"[:size] if size < 20 else ZEROS[:size]
            of = header(begin, size, kind=kind, number=number)
            whole = assembly.chunk(of, content[begin:end], may_finish="busy" not in options)
            assert whole == (content if expected else None)


@pytest.mark.parametrize("story", STORIES.values(), ids=STORIES)
def test_what_was_stored_comes_across_once_and_within_bounds(story):
    """Each is named after what would be lost. ``3 0-4``: these bytes of the still 3 come, of 10."""
    bounds, steps = ({}, story) if isinstance(story, str) else story
    assembly = BacklogAssembly(**bounds)
    for step in filter(str.strip, steps.split(";")):
        does, _, expected = step.partition(":")
        do(assembly, does, expected)


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


QUARTER = MAX_BACKLOG_BYTES // 4
chunk_of = st.tuples(
    st.integers(0, 5),  # number
    st.sampled_from([None, None, None, 0, 1, 2, 3]),  # where it begins, quarters; None goes on
    st.integers(0, 4),  # how long it is
    st.integers(1, 4),  # of how many
    st.booleans(),
    st.sampled_from(["settle", "refuse", "drop", "keep", "keep"]),
)


@given(reported=st.lists(chunk_of, max_size=40))
@settings(max_examples=60)
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
        assembly.chunk(header(number=number), b"012")
    said = 0
    while taken := assembly.take_acknowledged_ranges(16):
        assert len(taken) <= 16
        said += len(taken)
    assert said == 512


@given(
    data=st.binary(min_size=1, max_size=300),
    cuts=st.lists(st.integers(1, 299), max_size=6),
    seed=st.integers(0, 2**32),
)
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


@given(numbers=st.lists(st.integers(0, 20_000), max_size=80))
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
