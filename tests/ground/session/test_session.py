"""Messages of an edge in, sessions out: real access units through the real threads."""

import logging
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from random import Random

import pytest

from hvt_common.protocol.channels import MAX_PAYLOAD_BYTES
from hvt_common.protocol.ledger import Account
from hvt_common.protocol.messages import BaseHeader, Flags, Info, PoseEncoder
from hvt_common.transport.inbox import Inbox, Received
from hvt_common.values import Pose
from hvt_ground.events import Event, Refinement
from hvt_ground.perception.models import DetectorThread
from hvt_ground.report.status import completed, summary, table
from hvt_ground.session.edge_port import ReceiverReports
from hvt_ground.session.edge_sessions import EdgeSessions, join
from hvt_ground.session.session import Session
from hvt_ground.sinks import Sink
from programs.processes import eventually
from rigs.examples import Clock
from rigs.flight import (
    Flight,
    Port,
    RedSquares,
    SameAnswer,
    line_bytes,
    patient_worker,
    pipeline_of,
    square_box,
)
from rigs.handled import ReceiverRig


class Rig(ReceiverRig):
    """Its sessions have no recording."""

    def __init__(
        self, flight: Flight | None = None, *, detector=None, thread=None, reader=None, sinks=(), **rest
    ) -> None:
        self.reader, self.sinks = reader or SameAnswer(), sinks
        pipeline = partial(pipeline_of, detector=detector, detector_thread=thread, reader=self.reader)
        super().__init__(flight, pipeline=pipeline, **rest)

    def sinks_of(self, _info: Info) -> Sequence[Sink]:
        return self.sinks

    def take(self, *items: Received) -> None:
        """All of it is handled and seen."""
        self.put(*items)
        self.settle()

    @property
    def decoded(self) -> tuple[int, int]:
        """Frames that came in the open session, and those of them that were decoded."""
        return self.session.reception.frames, self.session.frames_decoded


@pytest.fixture(scope="module")
def flight() -> Flight:
    """Two seconds, a second keyframe at frame 20."""
    return Flight(30, keyframes=(20,))


def bases(flight: Flight, *indices: int) -> list[Received]:
    return [flight.base(index) for index in indices]


def unthreaded(flight: Flight) -> tuple[Port, Clock, EdgeSessions]:
    """Sessions that are handed each message, at a time that the test sets."""
    port, clock = Port(), Clock(time.time_ns())
    port.flight = flight

    def open_one(info: Info, reports: ReceiverReports) -> Session:
        return Session(info, pipeline_of=pipeline_of, clock=clock, reports=reports, worker_of=patient_worker)

    return port, clock, EdgeSessions(port, open_session=open_one, clock=clock)


def test_a_picture_that_the_link_lost_is_asked_for_at_once_and_shown_in_its_turn(flight):
    """Each lost packet would darken the screen up to the next keyframe."""
    port, clock, sessions = unthreaded(flight)

    def take(item: Received) -> None:
        clock.now_ns += 66_000_000
        sessions.handle(replace(item, received_ns=clock.now_ns))
        sessions.housekeep(pending=False)

    for item in bases(flight, 0, 1, 2, 4, 5):
        take(item)
    assert port.reports[-1].base_sequence <= 2, "it may come by itself, at first"
    take(flight.base(6))
    first = port.reports[-1]
    assert (first.base_sequence, first.base_held_us, first.missing_base, first.lost) == (6, 0, (3,), 0)
    said = len(port.reports)
    take(flight.base(7))
    assert sessions.session.frames_decoded == 3
    (lost,) = bases(flight, 3)
    again = replace(BaseHeader.parse(lost.attachment, lost.payload), flags=Flags.RESENT)
    take(replace(lost, attachment=again.pack(lost.payload)))
    assert sessions.session.frames_decoded == 8
    sessions.session.report()
    last = port.reports[-1]
    assert (last.base_sequence, last.missing_base, last.lost, last.base_messages) == (7, (), 1, 8)
    assert [one.missing_base for one in port.reports[said:-1]] == [(3,)] * (len(port.reports) - said - 1)
    sessions.close()


def test_every_frame_is_decoded_tracked_and_accounted_for(flight):
    """The operator would not see all there is; or the two sides' accounts would differ."""
    with Rig(flight) as rig:
        stills = [flight.still(4, 0), flight.still(9, 1)]
        rig.take(*(items := [*bases(flight, *range(30)), *stills, flight.status(base=30, roi=2)]))
        session = rig.session
        assert (rig.decoded, session.reception.stills) == ((30, 30), 2)
        assert session.reception.duration_s == pytest.approx(2.0)
        assert session.reception.ledger.line_bytes == line_bytes(items)
        assert session.perceived.tracks >= 1
        eventually(lambda: rig.port.reports and rig.port.reports[-1].last_frame_index == 29)
        last = rig.port.reports[-1]
        assert (last.base_messages, last.roi_messages, last.lost, last.corrupt) == (30, 2, 0, 0)
        assert last.session_id == flight.session_id
        results = [one for report in rig.port.reports for one in report.stills]
        said = [(one.still_sequence, one.class_name, one.track_id) for one in results]
        assert said == [(0, "bus", 1), (1, "bus", 1)]
        assert rig.port.keyframe_requests == 0


@pytest.mark.parametrize("pace", ["realtime", "lockstep"])
def test_the_edges_tracks_are_counted_and_shown(pace):
    """The two sides' accounts would differ, or the third channel would be paid for and not used."""
    flight = Flight(20, pace=pace)
    far = (220.0, 20.0, 250.0, 50.0)
    with Rig(flight) as rig:
        steps = [flight.step(index, {31: square_box(index), 32: far}) for index in (0, 5, 10)]
        items = [*bases(flight, *range(6)), *steps[:2], *bases(flight, *range(6, 12)), steps[2]]
        items += bases(flight, *range(12, 20))
        for item in items:
            rig.take(item)
        session = rig.session
        assert (session.reception.steps, session.reception.ledger.messages(Account.META)) == (3, 3)
        assert session.reception.ledger.line_bytes == line_bytes(items)
        assert session.perceived.tracks == 2
        assert session.pipeline.counts.steps_used == 3
        assert session.pipeline.list_at(19).origins == ("edge+base", "edge")


def test_tracks_that_make_no_sense_are_counted_and_skipped():
    """One damaged report would end the ground, or show boxes that nobody saw."""
    flight, stranger = Flight(10), Flight(2)
    with Rig(flight) as rig:
        good = [flight.step(index, {31: square_box(index)}) for index in (2, 3)]
        rig.put(*bases(flight, 0, 1, 2, 3), good[0], good[0])
        rig.put(flight.step(4, {31: square_box(4)}, boxes=b"\xff" * 40, reference=-1))
        rig.take(stranger.step(0, {1: square_box(0)}), Received(good[1].key, b"\x93\x02", b"", "", 1))
        session = rig.session
        assert (session.reception.steps, session.pipeline.counts.steps_used) == (2, 1)
        assert rig.receiver.receiver.unusable == 3
        rig.take(*bases(flight, *range(4, 10)), flight.status(base=10))
        assert session.reception.analyzed[0] == 9


def test_damaged_replayed_and_foreign_messages_are_skipped(flight):
    """One bad message would end the ground, spoil the picture, or count twice."""
    broken = flight.base(3)
    broken = Received(broken.key, broken.payload[:-1] + b"?", broken.attachment, broken.encoding, 1)
    nonsense = Received("hvt/uav-1/roi", b"x", b"\x93\x01", "", 1)
    other = Received("hvt/uav-1/tracks", b"x", b"", "", 1)
    later = Received(broken.key, b"x", b"\x91\x06", "", 1)  # of another version: a keyframe would not help
    stranger = Flight(2)
    with Rig(flight) as rig:
        rig.put(*bases(flight, 0, 1, 2, 1, 0), nonsense, other, later)
        rig.put(flight.still(1, 0), flight.still(1, 0), stranger.still(0, 5), *bases(stranger, 1))
        rig.take(status := flight.status(base=3, roi=1), status)
        session = rig.session
        assert (session.reception.frames, session.frames_decoded, session.reception.stills) == (3, 3, 1)
        assert session.reception.ledger.messages(Account.META) == 1
        assert rig.receiver.receiver.unusable == 4
        rig.take(broken)
        eventually(lambda: rig.port.keyframe_requests >= 1)
        rig.put(flight.base(3))  # the very unit, whole this time
        rig.settle()
        assert session.frames_decoded == 4
    counters = rig.ended[0].reception.counters
    assert (counters.corrupt, counters.duplicates + counters.replayed) == (1, 2)


def spoilt(item: Received, rng: Random) -> list[Received]:
    """A message, damaged in each way there is."""
    payload, attachment = item.payload, item.attachment

    def flipped(data: bytes) -> bytes:
        at = rng.randrange(len(data))
        return data[:at] + bytes((data[at] ^ 1 << rng.randrange(8),)) + data[at + 1 :]

    damaged = [
        (flipped(payload), attachment),
        (payload, flipped(attachment)),
        (payload[: rng.randrange(len(payload))], attachment),
        (payload, attachment[: rng.randrange(1, len(attachment))]),
        (payload, b""),
        (rng.randbytes(rng.randrange(2000)), rng.randbytes(rng.randrange(1, 80))),
        (payload, attachment + bytes(10_000)),
        (bytes(MAX_PAYLOAD_BYTES + 1), attachment),
    ]
    return [replace(item, payload=one, attachment=other) for one, other in damaged]


def test_whatever_comes_damaged_is_counted_and_costs_no_frame_and_no_byte(flight, caplog):
    """Anybody on the link could blind the operator with one packet, and the account would blame the link."""
    rng, bad, good = Random(3), 0, []
    with Rig(flight) as rig:
        for index in range(20):
            items = [flight.base(index), flight.still(index, index)]
            rig.put(*items)
            wrong = [one for item in items for one in spoilt(item, rng)]
            wrong.append(Received("hvt/uav-1/status", rng.randbytes(300), b"", "", 1))
            rig.take(
                *wrong, *(Received(f"hvt/{key}", b"x", b"", "", 1) for key in ("UAV_1/base", "uav-1/no"))
            )
            good += items
            bad += len(wrong)
        reception = rig.session.reception
        assert (rig.receiver.receiver.unusable, rig.session.frames_decoded) == (bad, 20)
        assert (reception.frames, reception.stills) == (20, 20)
        assert reception.ledger.line_bytes == line_bytes(good)
    assert sum("unusable" in text for text in caplog.messages) < 10, "the one line that matters scrolls away"


def test_a_still_that_came_twice_is_shown_once_and_counted_twice(flight):
    """The gallery would show it twice, or the two sides' accounts of the line would differ."""
    item = flight.still(1, 0)
    with Rig(flight) as rig:
        rig.take(*bases(flight, 0, 1, 2))
        ledger = rig.session.reception.ledger
        before, later = ledger.line_bytes, flight.still(1, 0, send_delay_ns=1_030_000_000)
        for one, copies in (
            (item, 1),
            (item, 1),
            (later, 2),
            (later, 2),
        ):  # repeated: somebody else's, not the edge's
            rig.take(one)
            assert ledger.messages(Account.ROI) == copies
            assert ledger.line_bytes - before == pytest.approx(copies * line_bytes([item]), abs=8)
        assert (rig.session.reception.stills, ledger.outcomes("received")) == (1, {"utility": 1})
        results = [one for report in rig.port.reports for one in report.stills]
        assert [one.still_sequence for one in results] == [0]


def test_a_second_edge_of_one_id_is_told_of_and_not_shown(flight, caplog):
    """Two drones of one name would share a screen, a recording and an account, and nobody would be told why."""
    caplog.set_level(logging.WARNING)
    other, text = Flight(30, keyframes=range(0, 30, 5)), "two edges call themselves uav-1"
    now_ns = time.time_ns()  # of a clock of its own: on a busy machine both would fall silent
    with Rig(flight, clock=lambda: now_ns) as rig:
        for index in range(30):
            items = [flight.base(index)]
            if index > 0:
                items += other.base(index - 1), other.still(index, index), other.status(base=index)
            rig.take(*(replace(item, received_ns=now_ns) for item in items))
            now_ns += 66_000_000
        (session,) = rig.opened
        assert (session, session.info.session_id) == (rig.session, flight.session_id)
        reception = session.reception
        assert (session.frames_decoded, reception.stills, reception.last_status) == (30, 0, None)
        assert rig.port.keyframe_requests == 0
    (said,) = (text_of for text_of in caplog.messages if text in text_of)
    shown, hidden = f"{flight.session_id:08x} is shown", f"{other.session_id:08x} is not"
    assert all(one in said for one in (shown, hidden, "--edge-id"))
    assert len(caplog.records) <= 7, "a drone's whole flight would be in the log, message by message"


def test_a_session_that_the_edge_does_not_know_ends_nothing():
    """In any pause of the edge a forged keyframe would close the recording, and hide the drone."""
    flight, forged = Flight(30, keyframes=(20,)), Flight(8, keyframes=range(8))
    with Rig(flight) as rig:
        rig.take(*bases(flight, *range(5)))
        time.sleep(1.1)  # a pause in which a restart would be believed
        for index in range(8):
            rig.take(forged.base(index))
        eventually(lambda: rig.port.keyframe_requests >= 1)
        rig.take(*bases(flight, *range(5, 30)))
        assert rig.opened == [session := rig.receiver.session]
        # Shown again from the keyframe that was asked for.
        assert (session.reception.frames, session.frames_decoded) == (30, 15)


def test_an_edge_that_restarts_gets_a_session_of_its_own(flight):
    """The second flight's picture and numbers would end up in the first one's recording, or nowhere."""
    second = Flight(8)
    with Rig(flight) as rig:
        rig.put(*bases(flight, 0, 1, 2), *bases(flight, 5, 6, 7, 8))  # with a loss
        rig.settle()
        rig.port.flight = second
        time.sleep(1.1)  # the first one is silent: it is over
        rig.take(*bases(second, *range(8)), second.still(2, 0))
        assert [one.info.session_id for one in rig.opened] == [flight.session_id, second.session_id]
        assert rig.receiver.session is rig.opened[1]
        assert rig.opened[1].frames_decoded == 8
    first, last = (summary(one) for one in rig.ended)
    assert (first["frames"], first["gaps"], first["lost"]) == (7, 1, 2)
    assert (last["frames"], last["gaps"], last["lost"], last["stills"]["received"]) == (8, 0, 0, 1)


def test_sessions_that_begin_again_and_again_are_bounded(flight):
    """An edge with valid keys would make a file and a log a second, for all to pay."""
    edge, now_ns = Flight(1), time.time_ns()
    with Rig(edge, clock=lambda: now_ns) as rig:
        for number in range(42):
            edge.session_id = 7000 + number
            rig.take(replace(edge.base(0), received_ns=now_ns))
            now_ns += 1_100_000_000
        assert len(rig.opened) == 39  # thirty at once, then one in five seconds
        assert rig.receiver.receiver.unusable == 3
        rig.port.flight = flight
        now_ns += 5_000_000_000
        rig.take(*(replace(one, received_ns=now_ns) for one in bases(flight, *range(10))))
        assert rig.session.info.session_id == flight.session_id
        assert rig.session.frames_decoded == 10


def test_a_session_ends_when_all_of_it_has_arrived(flight):
    """``--once`` would cut the last pictures off, or never end."""
    with Rig(flight, ended_patience_s=3600) as rig:
        rig.put(*bases(flight, *range(5)))
        rig.take(flight.status(base=6, roi=1, state="ended"))
        assert not rig.receiver.idle, "a picture and a still are on their way"
        rig.take(flight.base(5))
        assert not rig.receiver.idle
        rig.put(flight.still(3, 0))
        eventually(lambda: rig.ended)
        (session,) = rig.ended
        assert (session.reception.frames, session.reception.stills) == (6, 1)
        requested = rig.port.requested
        rig.put(flight.base(20), flight.still(3, 1))  # a keyframe after the end does not begin it again
        rig.settle()
        assert rig.receiver.idle
        assert rig.port.requested == requested


def test_a_session_whose_rest_is_lost_ends_after_two_seconds(flight):
    """``--once`` would wait for ever for a message that is gone."""
    with Rig(flight) as rig:
        began = time.monotonic()
        rig.put(*bases(flight, 0, 1), flight.status(base=9, state="ended"))
        eventually(lambda: rig.ended)
        assert time.monotonic() - began >= 2.0


def test_a_still_that_comes_before_its_session_is_open_is_taken(flight):
    """The first stills of every flight would be skipped as a stranger's, and the two accounts differ by them."""
    other = Flight(8)
    with Rig(flight) as rig:
        rig.take(flight.still(0, 0), other.still(0, 0))
        assert rig.receiver.receiver.unusable == 0
        rig.take(*bases(flight, *range(6)))
        session = rig.session
        assert (session.reception.stills, session.reception.frames) == (1, 6)
        assert session.reception.ledger.messages(Account.ROI) == 1
        assert rig.receiver.receiver.unusable == 1, "the other one's"


def test_the_class_of_a_still_may_be_a_place_in_the_list_of_its_session(flight):
    """Its name would be a number on the screen; and one beyond the list end the session."""
    events: list[Event] = []

    class Shown:
        closed, log = False, staticmethod(events.append)

        def close(self) -> None:
            """Nothing to close."""

    with Rig(flight, sinks=[Shown()]) as rig:
        rig.take(
            *bases(flight, *range(6)), flight.still(1, 0, class_name=1), flight.still(2, 1, class_name=99)
        )
        assert (rig.session.reception.stills, rig.receiver.receiver.unusable) == (1, 1)
    (seen,) = (one for one in events if isinstance(one, Refinement))
    assert seen.header.class_name == flight.info().class_names[1]


def test_poses_that_come_before_their_session_is_open_are_taken(flight):
    """The first report stands by itself and the next build on it: for ten seconds nothing would be on the map."""
    encoder = PoseEncoder(session_id=flight.session_id)
    of_another = PoseEncoder(session_id=flight.session_id + 1)

    def pose(second: int, coder: PoseEncoder) -> Received:
        report = coder.encode(Pose(second * 1_000_000_000, 48.1 + second * 1e-5, 11.5, height_m=60))
        return Received(f"hvt/{flight.info().edge}/pose", report(flight.info().started_ns).pack(), b"", "", 1)

    with Rig(flight) as rig:
        rig.take(pose(0, encoder), pose(1, encoder), pose(0, of_another))
        rig.take(*bases(flight, *range(6)), pose(2, encoder))
        session = rig.session
        assert session.reception.ledger.messages(Account.META) == 3
        assert session.poses.has_pose
        assert rig.receiver.receiver.unusable == 0


def test_a_lost_answer_does_not_lose_the_flight(flight):
    """Where the link loses the one answer to ``info``, nothing of the whole flight would be shown."""
    with Rig() as rig:
        rig.put(*bases(flight, 0, 1, 2))  # nobody answers yet
        eventually(lambda: rig.port.requested >= 3)
        rig.settle()
        assert rig.receiver.idle
        rig.port.flight = flight
        rig.put(*bases(flight, 3, 4))
        eventually(lambda: rig.port.keyframe_requests >= 1)
        rig.take(*bases(flight, *range(5, 30)))
        assert rig.session.info.session_id == flight.session_id
        assert rig.session.frames_decoded == 10


def test_video_that_this_ground_does_not_read_is_told_of_in_a_sentence(flight, caplog, monkeypatch):
    """A newer edge would be asked for a keyframe each second, for a picture that nobody here sees."""
    caplog.set_level(logging.WARNING)
    with Rig(flight) as rig:
        read = flight.info
        monkeypatch.setattr(flight, "info", lambda: replace(read(), codec="av1"))
        for index in range(0, 30, 5):
            rig.take(flight.base(index))
        assert rig.receiver.idle
        assert (rig.port.requested, rig.port.keyframe_requests) == (1, 0)
    (said,) = caplog.messages
    assert "the edge sends video of 'av1', and this ground reads h265: none is shown" in said


def test_a_flight_goes_on_after_an_outage(flight):
    """After ten seconds without a link the picture would never come back although the edge flies on."""
    with Rig(flight, patience_s=0.2) as rig:
        rig.take(*bases(flight, *range(6)))
        rig.port.present.clear()
        eventually(lambda: rig.ended)
        assert rig.receiver.idle
        rig.port.present.set()
        requests = rig.port.keyframe_requests
        rig.put(*bases(flight, *range(6, 10)))  # not one is missing, but the decoder has been closed
        eventually(lambda: rig.port.keyframe_requests > requests)
        rig.take(*bases(flight, *range(10, 30)))
        assert rig.receiver.session is not None
        assert rig.session.frames_decoded == 10


def test_what_the_detector_finds_after_the_last_picture_names_its_tracks(flight):
    """With ``--once`` the ground ended before, and the last stills had no track."""
    release = threading.Event()

    class Hangs(RedSquares):
        def detect(self, image_bgr):
            assert release.wait(timeout=60)
            return super().detect(image_bgr)

    with Rig(flight, detector=Hangs(), thread=DetectorThread(), worker_of=None) as rig:
        rig.put(flight.base(0), flight.still(0, 0))
        eventually(lambda: rig.reader.had_base)
        assert not rig.receiver.idle
        release.set()
        rig.settle()
        assert rig.session.perceived.refined == 1


def test_stills_that_come_with_their_frame_are_read_with_its_picture(flight):
    """A still would be read without the picture around it, or held against the wrong one."""
    with Rig(flight) as rig:
        for index in range(20):
            rig.put(flight.base(index), flight.still(index, index))
            if index % 10 == 9:  # on a busy machine more in a burst would be passed over
                rig.settle()
        eventually(lambda: len(rig.reader.had_base) == 20)
        assert all(rig.reader.had_base)
        assert rig.session.perceived.refined >= 1  # a busy machine may lose the track between


def test_lockstep_sees_every_frame_and_answers_every_still():
    """The same clip would give other tracks in each run, or the edge would wait for an answer that never comes."""
    outcomes = []
    for _ in range(2):
        flight = Flight(20, pace="lockstep")
        with Rig(flight, detector=RedSquares(takes_s=0.01)) as rig:
            for index in range(20):
                data = b"no jpeg" if index == 7 else None
                rig.put(flight.base(index), flight.still(index, index, data=data))
            rig.settle()
            session = rig.session
            assert session.perceived.detections_run == 20
            answered = [one.still_sequence for report in rig.port.reports for one in report.stills]
            assert answered == list(range(20))
            frames = [report.last_frame_index for report in rig.port.reports]
            assert frames == sorted(frames)
            assert set(range(20)) <= set(frames)
            assert {one.objects_detected for one in rig.port.reports if one.last_frame_index >= 0} == {1}
        content = summary(rig.ended[0])
        outcomes.append((content["tracks"], content["tracks_refined"], content["stills"]))
    assert outcomes[0] == outcomes[1]
    assert outcomes[0][2]["dropped"] == 1


def test_another_picture_size_under_the_same_session_is_not_shown(flight):
    """A forged or broken unit would end the ground in the middle of tracking."""
    with Rig(flight) as rig:
        rig.take(*bases(flight, 0, 1, 2))
        forged = Flight(5, keyframes=(3,), size=(384, 256))
        forged.session_id = flight.session_id
        rig.take(forged.base(3))
        assert rig.session.frames_decoded == 3
        eventually(lambda: rig.port.keyframe_requests >= 1)
        rig.take(*bases(flight, *range(4, 30)))
        assert rig.session.reception.analyzed[0] == 29


def test_closing_keeps_what_has_arrived_and_ends(flight):
    """Ctrl-C would throw away the last second, or hang."""
    rig = Rig(flight, detector=RedSquares(takes_s=0.05))
    rig.put(flight.base(0))
    eventually(lambda: bool(rig.opened))
    rig.put(*bases(flight, *range(1, 30)))
    assert join([rig.receiver], timeout_s=60)
    (session,) = rig.ended
    assert session.frames_decoded == 30
    assert session.reception.analyzed[0] == 29


def test_the_summary_can_be_written_and_read():
    """Programs that compare runs would miss a field."""
    flight = Flight(10, pace="lockstep")  # whose clock is no matter
    with Rig(flight, reader=SameAnswer(knows=False)) as rig:
        rig.take(*bases(flight, *range(10)), flight.still(2, 0), flight.still(3, 1, data=b"junk"))
    content = summary(rig.ended[0])
    stills = {name: content["stills"][name] for name in ("received", "unread", "dropped")}
    assert stills == {"received": 2, "unread": 1, "dropped": 1}
    assert content["stills"]["reasons"]["outcomes"] == {"unread": 1}
    assert content["latency_ms"]["p50"] is not None
    assert content["receive_latency_ms"]["p50"] is None, "in lockstep it said 0"
    assert (content["edge"], content["method"], content["recording"]) == ("uav-1", "M5", None)
    content = completed(content, rig.receiver)
    assert (content["unusable_messages"], content["failure"], content["failed"]) == (0, "", [])
    assert dict(table(content))["frames"].startswith("10 decoded in 0.7 s, no gaps")


def test_an_inbox_is_bounded_in_bytes():
    """A flood of large messages would fill the ground's memory: a thousand of them have four gigabytes."""

    def item(size: int, number: int = 0) -> Received:
        return Received("k", bytes(size), b"ab", "", number)

    inbox = Inbox(capacity=1000, capacity_bytes=1_000)
    for number in range(5):
        inbox.put(item(298, number))
    assert (len(inbox), inbox.dropped) == (3, 2)
    assert inbox.get(timeout_s=0).received_ns == 0
    inbox.put(item(298, 9))
    assert [inbox.get(timeout_s=0).received_ns for _ in range(3)] == [1, 2, 9]
    inbox.put(item(2_000))
    assert (len(inbox), inbox.dropped) == (0, 3)
    for _ in range(100):
        inbox.put(item(300))
        inbox.get(timeout_s=0)
    inbox.put(item(900))
    assert len(inbox) == 1, "what was taken out counts no more"
