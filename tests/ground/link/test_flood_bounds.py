"""A session that is flooded with valid messages: what it keeps, and that it finds its way back to the real ones."""

import threading
from dataclasses import replace

import pytest

from hvt_common.protocol.messages import BaseHeader, RoiHeader, Status, TrackStep
from hvt_ground.events import MessageTiming, Notice
from hvt_ground.link.reassemble import Arrival
from hvt_ground.perception.stills.decode import ReceivedStill
from hvt_ground.session.session import Session
from rigs.flight import Flight, patient_worker, pipeline_of

BOX = {1: (30.0, 60.0, 62.0, 96.0)}
SECOND_NS = 1_000_000_000


@pytest.fixture(scope="module")
def flight() -> Flight:
    """A second of video."""
    return Flight(15, pace="lockstep")


class Events(list):
    """A sink that lists what it gets."""

    log = list.append

    def close(self, hurry=None) -> None:
        """Nothing."""


class Rig:
    """A session whose clock the test turns."""

    def __init__(self, flight: Flight) -> None:
        self.flight, self.events = flight, Events()
        self.now_ns = 1_790_000_000 * SECOND_NS
        self.session = Session(
            flight.info(), sinks=[self.events], pipeline_of=pipeline_of, clock=lambda: self.now_ns
        )
        for index in range(3):
            item = flight.base(index)
            header = BaseHeader.parse(item.attachment, item.payload)
            unit = Arrival("decode", header, item, item.received_ns, starts_run=index == 0)
            assert self.session.base(unit)

    def notices(self) -> list[str]:
        return [one.text for one in self.events if isinstance(one, Notice)]

    def report(self, number: int, **changes) -> None:
        item = self.flight.status(base=3)
        status = Status.parse(item.payload)
        self.session.take(replace(status, sequence=number, **changes), item)

    def broken_stills(self, count: int) -> None:
        for sequence in range(count):
            item = self.flight.still(1, sequence, data=b"no picture")
            self.session.take(RoiHeader.parse(item.attachment, item.payload), item)

    def step(self, item, **lies) -> int:
        """Take a report of tracks; how many there have been."""
        self.session.take(replace(TrackStep.parse(item.payload), **lies), item)
        return self.session.reception.steps


@pytest.fixture
def rig(flight):
    """Three frames into a session."""
    rig = Rig(flight)
    yield rig
    rig.session.close()


def test_a_forged_status_number_does_not_silence_the_edge_for_good(rig):
    """The ground would never hear that the session has ended, nor what the edge has dropped."""
    rig.report(2**32 - 1)
    rig.now_ns += SECOND_NS
    rig.report(1)
    assert rig.session.reception.last_status.sequence == 2**32 - 1, "late ones are left out as ever"
    rig.now_ns += 5 * SECOND_NS
    rig.report(6, state="ended")
    assert rig.session.reception.last_status.state == "ended"


def test_an_edge_that_reports_without_end_does_not_talk_to_all_viewers(rig):
    """Each line of its log goes to every viewer of every edge: nobody would see a picture any more."""
    for number in range(1, 2000):
        rig.now_ns += SECOND_NS // 1000
        rig.report(number, decisions=f"report {number}")
    rig.session.close()
    said = rig.notices()
    assert len([one for one in said if one.startswith("Report")]) == 61
    assert sum(int(one.split()[0]) for one in said if "left out" in one) == 1999 - 61
    assert said[-1].endswith("ended"), "how it ended is said in any case"


def test_numbers_alone_are_no_event(rig):
    """The list of events would be a column of figures that change each second."""
    said = [
        "no tracks: not measured yet; stills: no answer yet",
        "no tracks: the video hides 2 objects, misnames 1; stills: they name 1 of 2 otherwise",
        "tracks: the video hides 9 objects; stills: they name 1 of 2 otherwise",
        "tracks: the video hides 9 objects; stills paused: they name 1 of 40 otherwise",
        "tracks: the video hides 8 objects; stills paused: they name 1 of 40 otherwise",
    ]
    for number, decisions in enumerate(said, 1):
        rig.report(number, decisions=decisions)
    assert rig.session.reception.decisions == said[-1]
    tracks = "The edge sends its tracks: the video hides 9 objects. "
    assert rig.notices() == [
        "The edge sends no tracks: not measured yet. Stills may be sent: the ground has judged none yet.",
        tracks + "Stills are sent: they name 1 of 2 otherwise.",
        tracks + "Stills are paused: they name 1 of 40 otherwise.",
    ]


def test_a_forged_step_number_does_not_end_the_tracks_for_good(rig, flight):
    """The edge's own tracks would be missing for the rest of the flight."""
    items = [flight.step(index, BOX) for index in (3, 4, 5)]  # the first stands by itself
    assert TrackStep.parse(items[1].payload).reference >= 0
    assert rig.step(items[0], sequence=2**32 - 1, frame_index=2**32 - 1) == 1
    rig.now_ns += 6 * SECOND_NS
    assert rig.step(items[1]) == 1, "it builds on one that is not known"
    assert rig.step(items[0], sequence=40, frame_index=50) == 2
    handled = [
        one.handled_ns for one in rig.events if isinstance(one, MessageTiming) and one.kind == "tracks"
    ]
    assert [bool(at_ns) for at_ns in handled] == [True, True], "the tracks of both are known"


def test_results_that_nobody_fetches_do_not_pile_up(rig):
    """Stills by the thousand would each leave an answer behind."""
    rig.broken_stills(5000)
    assert len(rig.session.reception.take_results(100_000)) <= 4096
    assert rig.session.stills_dropped["undecodable"] > 4900


def test_broken_stills_are_not_all_looked_into(rig):
    """Each costs a line in the recording and one on stderr; a few thousand a second would fill both."""
    rig.broken_stills(200)
    rig.session.close()
    assert sum("is damaged" in getattr(one, "text", "") for one in rig.events) == 32


def test_stills_that_wait_to_be_read_have_a_bound_in_bytes():
    """256 of the largest would be a quarter of a gigabyte for each edge."""
    busy, begun = threading.Event(), threading.Event()

    def read(_stills) -> None:
        begun.set()
        busy.wait(60)

    worker = patient_worker(lambda *_: None, lambda *_: None, read)
    flight = Flight(2)
    header = RoiHeader.parse(*((one := flight.still(1, 0)).attachment, one.payload))
    try:
        worker.still(ReceivedStill(header, b"x"))
        assert begun.wait(60)
        for _ in range(64):
            worker.still(ReceivedStill(header, bytes(2**20)))
        assert worker.dropped["overflow"] == 32
    finally:
        busy.set()
        worker.close()
