"""The base stream through loss, repetition, reordering, restarts and forged numbers."""

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.protocol.messages import MAX_MISSING_BASE, Flags
from hvt_ground.link.reassemble import ORDERLY_UNITS, RESEND_UNITS, RESTART_SILENCE_NS, Arrival, Reassembler
from rigs.footprint import footprint_bytes
from rigs.messages import UnitHeader

FRAME_NS = 1_000_000_000 // 15
MS = 1_000_000
MAX_U64 = (1 << 64) - 1


class Ground:
    """A `Reassembler` with a clock that steps by one frame a unit, and all that came out of it."""

    def __init__(self, start: str = "fresh") -> None:
        """``running``: four units into a session; ``orderly``: 34, of an edge 60 ms away that sends again."""
        self.core: Reassembler = Reassembler()
        self.now_ns = 5_000_000_000
        self.out: list[Arrival] = []
        self._sent = 0
        for sequence in range({"fresh": 0, "running": 4, "orderly": 4 + ORDERLY_UNITS}[start]):
            self.send(sequence, key=sequence == 0)
        if start == "orderly":
            self.core.repair.round_trip_ns = 60 * MS

    def send(self, sequence, *, key=False, session=1, frame=None, after_ns=FRAME_NS, flags=0):
        """Let one unit arrive ``after_ns`` later; (verdict, sequence) of all that is settled by it."""
        self.now_ns += after_ns
        self._sent += 1
        header = UnitHeader(session, sequence, sequence * 2 if frame is None else frame, key, flags)
        message = b"%d/%d at %d" % (session, sequence, self.now_ns)
        return self.settled(self.core.accept(header, message, now_ns=self.now_ns))

    def settled(self, units):
        """What came out: what went in then, each with its verdict."""
        for unit in units:
            came = unit.header.session_id, unit.header.sequence, unit.received_ns
            assert unit.message == b"%d/%d at %d" % came
        self.out += units
        return [(unit.verdict, unit.header.sequence) for unit in units]

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
        return self.core.wants_keyframe(self.now_ns)

    def asked(self, *, until_ms):
        """When keyframes are requested meanwhile, milliseconds from now."""
        times = []
        for ms in range(0, until_ms, 10):
            if self.wants():
                self.core.keyframe_requested(self.now_ns)
                times.append(ms)
            self.now_ns += 10 * MS
        return times

    def tell(self, story):
        """Do its steps, and check what comes out of each where that is said; ``{0}`` is the next number."""
        first = self.out[-1].header.sequence + 1 if self.out else 0
        for step in re.sub(r"{(\d+)}", lambda one: str(first + int(one[1])), story).split(";"):
            before, (does, checked, said) = len(self.out), step.partition(":")
            self._do(does)
            if checked:
                assert [told(unit) for unit in self.out[before:]] == listed(said), step

    def _do(self, step):
        word, *options = step.split()
        values = dict(one.split("=") for one in options if "=" in one)
        plain = {
            "ask": lambda: self.core.keyframe_requested(self.now_ns),
            "overdue": lambda: self.settled(self.core.overdue(now_ns=self.now_ns)),
            "fails": self.core.decoder_failed,
            "corrupt": self.core.corrupt,
        }
        match word:
            case _ if word in plain:
                plain[word]()
            case "wait":
                self.now_ns += int(options[0]) * MS
            case "wants" | "content":
                assert self.wants() == (word == "wants"), step
            case "missing":
                assert self.core.missing == tuple(map(int, options))
            case "held":
                newest = self.core.newest_held
                assert ([] if newest is None else [str(newest.header.sequence)]) == options
            case "counts":
                assert {one: str(getattr(self.core.counters, one)) for one in values} == values
            case _:
                after_ns = [int(one) * MS for one in options if one.startswith("+")] or [FRAME_NS]
                for sequence in numbers(word):
                    self.send(
                        sequence,
                        key="key" in options,
                        session=int(values.get("session", 1)),
                        frame=int(values["frame"]) if "frame" in values else None,
                        after_ns=after_ns[0],
                        flags=Flags.RESENT * ("resent" in options),
                    )


def numbers(word):
    """``4..6``, or one."""
    first, _, last = word.partition("..")
    return range(int(first), int(last or first) + 1)


def told(unit):
    """``decode 4``; with ``!`` where a run begins, ``!!`` where a session does; ``twin`` is of a second edge."""
    word = "twin" if unit.duplicate else unit.verdict
    lost = f"(-{unit.lost_before})" if unit.lost_before else ""
    return f"{word}{'!' * (unit.starts_run + unit.starts_session)} {unit.header.sequence}{lost}"


def listed(text):
    """``skip 5(-1) 6..7`` as `told` says each."""
    word, found = "", []
    for one in text.split():
        if one[0].isalpha():
            word = one
        else:
            found += [f"{word} {number}" for number in numbers(one)] if ".." in one else [f"{word} {one}"]
    return found


STORIES = {
    "a clean link would lose frames": "fresh | 0 key: decode!! 0; 1..3: decode 1..3; content",
    "each lost frame would darken the screen up to the next keyframe, though it is on its way": """
        orderly | 35:; missing 34; held 35; 37:; missing 34 36; content; 34 resent +10: decode 34 35;
        missing 36; 36 resent +1: decode 36 37; missing; held; counts lost=0 gaps=0 resent=2 replayed=0""",
    "a frame that was lost twice would stop the picture, and one that comes late be of no use": """
        orderly | 35; 36 +179:; content; 37 +1:; wants; 34 resent +30: decode 34..37; content; 39..49:;
        50: skip 39(-1) 40..50; missing; counts lost=1""",
    "frames that nobody can show would take the room of the keyframe that is awaited": """
        orderly | 39; wants; 41: skip 41(-1); missing""",
    "after a stall a resent keyframe would cut the recording in two": """
        orderly | 43; wait 2000; 36 key resent: stale 36""",
    "a late packet of another session would take the screen of one that waits for a picture": """
        orderly | 35..43; 0 key session=2 +10: foreign 0; 44..46; held; 0 key session=2 +510: decode!! 0""",
    "whoever can send would fill the memory with pictures that wait behind a hole": """
        orderly | 34..73 +16; 75..98 +16:; 99 +16: skip 75(-1) 76..99""",
    "who joins a running flight would see garbage, or nothing until the next periodic keyframe": """
        fresh | content; 40: skip 40; wants; ask; content; 41: skip 41; 42 key: decode!! 42;
        43: decode 43; content; counts gaps=0""",
    "pictures broken by a lost packet would be shown as if they were true": """
        running | 5 +1:; content; 6 +1:; content; 7 +1: skip 5(-1) 6..7; wants; 8: skip 8;
        9 key: decode! 9; 10: decode 10; counts gaps=1 lost=1""",
    "on a link of several paths every swap of two packets would cost a second of picture": """
        running | 6 +1:; 5 +1:; 4 +1: decode 4..6; counts gaps=0""",
    "the picture would stand still behind one missing packet, with nobody asking": """
        running | 5:; content; wait 100; wants; 6 +0: skip 5(-1) 6; counts lost=1""",
    "the edge would hear of nothing that came, hold its frames, and with them the keyframe": """
        running | 5:; wait 99; overdue:; wait 1; overdue: skip 5(-1); wants""",
    "on links that keep the order the screen was dark for a tenth of a second more": """
        running | 4..29; 31: skip 31(-1); wants; ask; 30 +20: stale 30; 32 key +100: decode! 32; 34 +400:;
        wait 39; content; wait 1; wants; 33 +0: decode 33 34; 36; wait 79; content; wait 1; wants""",
    "after a loss the picture would come back later than the link allows": """
        running | 5 +1:; 7 key +1: skip 5(-1) decode! 7(-1); counts gaps=2; 6 +1: stale 6; 8 +1: decode 8""",
    "replayed traffic would make the picture jump back, or break the decoder's references": """
        running | 3: duplicate 3; 0 key: duplicate 0; 5 +1:; 5 +1: duplicate 5; 4 +1: decode 4 5;
        6..79: decode 6..79; 2: stale 2; counts replayed=1 duplicates=3; content""",
    "after a restart of the edge the ground would show nothing, or mix two flights": """
        running | wait 1500; 0 key session=2: decode!! 0; 4: foreign 4; 2: stale 2; 1 session=2: decode 1""",
    "an edge that restarts within the silence would stay dark until its next periodic keyframe": """
        running | 0 key session=2: foreign 0; 1 session=2 +400: foreign 1; content;
        1 session=2 +40: foreign 1; wants; wait 1000; 9 key session=2: decode!! 9""",
    "a restart would be taken for a second edge, and stay dark for seconds": """
        running | 0 key session=2: foreign 0; 4: decode 4; 1 session=2 +1500: foreign 1; wants;
        2 key session=2: decode!! 2""",
    "an edge that crashes and starts over and over would reset the screen with every try": """
        running | wait 2000; 0 key session=2: decode!! 0; 0 key session=3 +500: foreign 0;
        0 key session=3 +500: decode!! 0""",
    "one forged keyframe in a short silence would lock the true edge out for good": """
        running | wait 2000; 0 key session=666: decode!! 0; wait 2000; 0 key: stale 0;
        50 key: decode!! 50; 51: decode 51""",
    "one flipped bit in a number would make all that follows look old: dark for good": """
        running | 9223372036854775808 key: implausible 9223372036854775808;
        18446744073709551615 key: implausible 18446744073709551615; 168 key: implausible 168;
        4 frame=4611686018427387904: implausible 4; 4: decode 4; counts lost=0""",
    "twenty seconds behind a hill would count as another flight, or never end": """
        running | 304 +20000:; 305 key: skip 304(-300) decode! 305; counts lost=300""",
    "an edge that drops frames on a full link would be taken for a forger when it opens": """
        running | 4 frame=1200 +1: decode 4""",
    "histories and recordings rise by frame; one that goes back would crash or falsify them": """
        running | 4 frame=6: implausible 4; 6 frame=40 +1; 5 frame=50 +1;
        4 frame=30 +1: decode 4 5 implausible 6; wants""",
    "a stream that arrives only damaged would leave the screen frozen without anyone asking": """
        running | corrupt; content; wait 500; wants; 4; content; fails; wants; 5: skip 5;
        6 key: decode! 6; counts corrupt=1""",
    "a late join whose first packets are damaged would wait for a periodic keyframe": """
        fresh | corrupt; wants""",
    "whoever repeats the last keyframe while the link is down would show an old scene as the new": """
        running | 0 key +6000: duplicate 0""",
}


@pytest.mark.parametrize("story", STORIES.values(), ids=STORIES)
def test_what_comes_is_shown_whole_and_in_order_or_asked_for_anew(story):
    """Each is named after what would be lost. ``5 key +1: skip 4 5``: 1 ms later, and all that comes out then."""
    start, _, steps = story.partition("|")
    Ground(start.strip()).tell(steps)


def test_the_wait_is_as_long_as_what_is_sent_again_usually_takes():
    """On a thin link each hole would bring a keyframe beside the frame; on a quick one the screen stay dark."""
    ground = Ground("orderly")
    for took_ms, wait_ms in ((90, 115), (400, 480)):
        for _ in range(60):
            ground.tell(f"{{1}}; {{0}} resent +{took_ms}; {{2}}..{{11}}")
        ground.tell(f"{{1}}; wait {took_ms}; content; wait {wait_ms - took_ms}; wants; {{0}} resent")


def test_where_nothing_comes_again_no_hole_waits_for_a_while():
    """Of two grounds one alone is listened to: each loss would cost the other a picture that comes later."""
    ground = Ground("orderly")
    for frames, out in ((1, ""), (1, ""), (1, ""), (270, "skip {1}(-1)"), (45, ""), (570, "skip {1}(-1)")):
        ground.tell(f"{{0}}..{{{frames}}}")
        ground.tell(f"{{1}}: {out}; {{2}}..{{4}}; wants; {{5}} key")
    ground.tell("{0}..{59}")
    ground.tell("{1}; {0} resent +90")  # it comes after all
    for _ in range(2):
        ground.tell("{1}:; {2}..{4}; wants; {5} key")


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
def test_no_hole_waits_that_the_edge_has_no_room_or_no_time_to_fill(step_ms, lost, round_trip_ms, waits):
    """At two pictures a second, and behind a satellite, each loss would cost a keyframe that comes later."""
    ground = Ground()
    ground.core.repair.round_trip_ns = round_trip_ms * MS
    for sequence in range(2 * ORDERLY_UNITS):
        ground.send(sequence, key=sequence == 0, after_ns=step_ms * MS)
    ground.send(2 * ORDERLY_UNITS + lost, after_ns=(1 + lost) * step_ms * MS)
    assert (ground.held() > 0) == waits
    assert len(ground.core.missing) == lost * waits
    assert ground.wants() != waits


def test_on_links_that_reorder_nothing_is_asked_for_that_comes_by_itself():
    """Of several links one may be slower: each frame of it would go twice, and every second be left out for that."""
    ground = Ground("orderly")
    for _ in range(10):
        ground.tell("{1}:")
        first = ground.core.named(ground.now_ns)
        ground.tell("{0} +45: decode {0} {1}")
    assert first == ()
    ground.tell("{1}:")
    named = [ground.core.named(ground.now_ns + ms * MS) for ms in (89, 90)]
    assert named == [(), (ground.decoded()[-1] + 1,)]


def test_what_comes_again_too_late_is_no_reason_to_wait():
    """A full link: each hole would be dark for seven tenths of a second before a keyframe is asked for."""
    ground = Ground("orderly")
    for _ in range(4):
        ground.tell("{1}..{12}; {0} resent +1; {13} key")
    ground.tell("{1}: skip {1}(-1)")


def test_where_a_keyframe_is_there_sooner_it_is_asked_for_at_once():
    """The screen would be dark for as long as the slower of the two takes."""
    ground = Ground("orderly")
    for _ in range(30):
        ground.tell("{1}; {0} resent +400; {2}..{11}")
    ground.tell("{9}; wants; ask; {10} key +150; {11}..{12}; {14}:; wants")  # both are on their way


def test_a_keyframe_ends_the_wait_and_nothing_long_is_waited_for():
    """The picture would stand still although it could go on, and a gap of a second never be repaired at all."""
    ground, lost = Ground("orderly"), MAX_MISSING_BASE + 1
    for _ in range(5):
        ground.tell("{1}:; {2} key: skip {1}(-1) decode! {2}")
    ground.tell("{1}:; {0} resent: decode {0} {1}")
    ground.tell(f"{{{lost}}}: skip {{{lost}}}(-{lost})")


def test_a_request_is_not_made_again_before_it_can_be_answered():
    """On a link of 0.2 s each way an edge would be asked twice for each loss, and some made two keyframes."""
    ground = Ground("running")
    ground.tell("fails")
    assert ground.asked(until_ms=480) == [0, 300], "how long an answer takes is not known"
    ground.tell("4 key +0; wait 400; fails")
    assert ground.asked(until_ms=590) == [0]
    assert ground.asked(until_ms=60) == [10]


def test_requests_for_one_gap_back_off():
    """A ground on a thin link would drown the edge in keyframe requests, each worth 20 kB."""
    ground = Ground("running")
    ground.tell("10 +100; wait 100")
    assert ground.asked(until_ms=4000) == [0, 300, 600, 1200, 2200, 3200]
    ground.tell(
        "ask; 11 key +50; fails; wait 99; content; wait 1; wants"
    )  # it answers what comes within 0.1 s


def beside(ground, count, *, interval_ns=FRAME_NS):
    """The first edge goes on, and a second one of the same id beside it; the sequence that comes next."""
    for sequence in range(4, 4 + count):
        ground.send(sequence, key=sequence == 4, after_ns=interval_ns // 2)
        ground.send(sequence - 4, session=2, key=sequence % 3 == 0, after_ns=interval_ns // 2)
    return 4 + count


def test_a_second_edge_of_one_id_is_noticed_and_waits_until_the_first_is_silent():
    """In each pause of the first the operator would look through another drone's perception, and never be told."""
    ground = Ground("running")
    end = beside(ground, 96)
    assert ground.decoded() == list(range(end))
    assert [one.duplicate for one in ground.out if one.header.session_id == 2][-20:] == [True] * 20
    assert not any(one.duplicate for one in ground.out if one.header.session_id == 1)
    # Nothing is missed while the first may go on.
    ground.tell(
        "content; {0} key session=2 +4900: twin {0}; content; {0}: decode {0}".replace("{0}", str(end))
    )
    ground.tell("{0} session=2 +5001: foreign {0}; wants; {1} key session=2: decode!! {1}")
    for _ in range(40):  # the first comes back: now it is the second
        sequence = ground.decoded()[-1] + 1
        ground.tell(f"{sequence} session=2: decode {sequence}; {sequence} key")
    assert told(ground.out[-1]).startswith("twin")


def test_a_second_edge_does_not_get_in_at_a_low_frame_rate():
    """With two frames a second every pause between them would look like a restart."""
    ground = Ground()
    ground.tell("0 key; 1..3 +500")
    beside(ground, 30, interval_ns=500 * MS)
    assert ground.decoded() == list(range(34))
    assert {unit.header.session_id for unit in ground.out if unit.verdict == "decode"} == {1}


@pytest.mark.parametrize(("sequence", "frame"), [(1 << 60, 2), (3, 1 << 60)])
def test_a_forged_first_keyframe_does_not_darken_the_screen_for_good(sequence, frame):
    """A ground that joins on one damaged header would refuse the whole flight after it."""
    ground = Ground()
    ground.send(sequence, key=True, frame=frame)
    for number in range(4, 64):
        ground.send(number, key=number % 15 == 0)
    assert ground.decoded()[-4:] == [60, 61, 62, 63]


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


units = st.tuples(st.booleans(), st.booleans(), st.integers(0, 2), st.sampled_from([0, 0, 0, 1, 2, 3, 5, 90]))
"""keyframe, lost, extra copies, positions late."""


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


@settings(max_examples=50)
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
    ground.tell("0 key; 1..9; 10..2009 +2; 70: stale 70")  # four seconds of a flood, within what is plausible
    assert ground.decoded()[-1] == 2009
    for sequence in range(71, 71 + 80):
        key = ground.wants()
        if key:
            ground.core.keyframe_requested(ground.now_ns)
        ground.send(sequence, key=key)
    assert ground.decoded()[-1] == 150
    assert_decodable(ground.out)
    assert ground.sessions() == 2
