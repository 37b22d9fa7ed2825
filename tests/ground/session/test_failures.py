"""What goes wrong in one session ends that session, with its recording whole; another begins, others go on."""

import logging
import re
import sys
import threading
import time
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from hvt_common.protocol.messages import Info
from hvt_common.runtime import process
from hvt_common.runtime.failures import Failures, RetryPause
from hvt_common.transport.inbox import Received
from hvt_common.units import SECOND_NS
from hvt_ground.events import Event, Overlay
from hvt_ground.report.state import StateMaker
from hvt_ground.report.status import completed, status_text, summary, table
from hvt_ground.session import edge_sessions
from hvt_ground.session.edge_port import ReceiverReports
from hvt_ground.session.edge_sessions import EdgeSessions, join
from hvt_ground.session.session import Session
from hvt_ground.sinks import QueuedSink
from hvt_ground.sinks.rerun.recorder import Recorder, RecorderSettings
from programs.processes import eventually
from programs.rrd import Recording
from rigs.flight import Flight, Port, pipeline_of
from rigs.handled import WatchedInbox


class Consumer:
    """A factory of sessions, their clock and who takes their overlays: each fails where the test says so."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.broken = ""
        self.sessions: list[Session] = []
        self.tried = 0

    def clock(self) -> int:
        """What a session reads in the receiving thread."""
        if self.broken == "clock":
            raise RuntimeError("the clock is gone")
        return time.time_ns()

    def taken_by(self, emit: Callable[[Event], None]) -> Callable[[Event], None]:
        """Who takes events in the worker's thread."""

        def take(event: Event) -> None:
            if self.broken == "consumer" and isinstance(event, Overlay):
                sys.exit("no room for boxes")  # as a codec of others may
            emit(event)

        return take

    def open(self, info: Info, reports: ReceiverReports) -> Session:
        self.tried += 1
        if self.broken == "opening":
            raise OSError(28, "No space left on device", "a.rrd")
        path = self.folder / f"{info.edge}-{len(self.sessions)}.rrd"
        settings = RecorderSettings.of(info, path)
        sink = QueuedSink("recording", lambda: Recorder(settings), failures=Failures(time.time_ns))
        session = Session(
            info,
            sinks=[sink],
            pipeline_of=lambda emit: pipeline_of(self.taken_by(emit)),
            clock=self.clock,
            reports=reports,
        )
        self.sessions.append(session)
        return session


class Rig:
    """An edge's port, thread and sessions."""

    def __init__(
        self, flight: Flight, consumer: Consumer, *, pause: RetryPause | None = None, patience_s: float = 5.0
    ) -> None:
        self.port, self.consumer, self.flight = Port(), consumer, flight
        self.port.inbox = self.inbox = WatchedInbox()
        self.port.flight = flight
        self.summaries: list[dict] = []
        self.sessions = EdgeSessions(
            self.port,
            open_session=consumer.open,
            on_ended=lambda session: self.summaries.append(summary(session)),
            pause=pause or RetryPause(first_ns=SECOND_NS // 50, longest_ns=SECOND_NS // 10),
            patience_s=patience_s,
        )
        self.sessions.start()

    def put(self, *indices: int) -> None:
        """Access units; returns when they are handled and analyzed."""
        for index in indices:
            self.inbox.put(self.flight.base(index))
        eventually(lambda: self.inbox.handled, what="all is handled")
        session = self.sessions.session
        if session is not None:
            eventually(lambda: session.idle or session.failure, what="all is analyzed")

    @property
    def decoded(self) -> list[int]:
        """Frames of each session so far."""
        return [one.frames_decoded for one in self.consumer.sessions]


@pytest.fixture(scope="module")
def flight() -> Flight:
    """Keyframes at 10, 20, 30 and 36."""
    return Flight(40, keyframes=(10, 20, 30, 36))


class Unseen(Rig):
    """Of its edge come reports alone, one a second."""

    def __init__(self, flight: Flight, consumer: Consumer, **rest: float) -> None:
        super().__init__(flight, consumer, **rest)
        self.second, self.began_ns = 0, time.time_ns()

    def report(self, *, sends: bool = True, state: str = "running") -> None:
        status = self.flight.status(base=15 * self.second * sends, roi=0, state=state)
        self.inbox.put(replace(status, received_ns=self.began_ns + self.second * SECOND_NS))
        self.second += 1
        eventually(lambda: self.inbox.handled, what="it is handled")

    @property
    def said(self) -> str:
        return status_text(StateMaker(time.time_ns).make([("uav-1", self.sessions)]))


@pytest.mark.parametrize("sends", [True, False])
def test_an_edge_of_which_all_but_the_pictures_comes_is_named(flight, tmp_path, sends):
    """In a tunnel that drops large packets the pilot would look at "waiting for a keyframe" for ever."""
    rig = Unseen(flight, Consumer(tmp_path))
    forged = rig.flight.status(base=2**31, roi=0)
    rig.inbox.put(replace(forged, received_ns=rig.began_ns - SECOND_NS))
    for _ in range(17):
        assert "FAILED" not in rig.said, "the first keyframe may be under way on a slow link"
        rig.report(sends=sends)
        if "FAILED" in rig.said:
            break
    assert rig.second == (16 if sends else 17), "a camera that gives nothing is no black hole"
    assert ("video of uav-1 FAILED at" in rig.said) == sends
    told = [(one.session_id, one.base_sequence, one.misses_video) for one in rig.port.reports]
    assert set(told) == ({(flight.session_id, -1, True)} if sends else set()), "the edge stores from then on"
    assert all("only small messages come" in one.reason for one in rig.sessions.failures.now)
    rig.put(0, 1)
    assert "FAILED" not in rig.said
    assert join([rig.sessions])


def test_an_edge_of_another_version_is_said_where_its_picture_would_be(flight, tmp_path):
    """A pilot would wait for a keyframe for ever, and find the reason in the log of the ground alone."""
    rig = Unseen(flight, Consumer(tmp_path))
    unit = flight.base(0)
    body = b"%c\x06%s" % (unit.attachment[0], unit.attachment[2:-5])
    later = replace(unit, attachment=body + b"\xce" + zlib.crc32(body + unit.payload).to_bytes(4, "big"))
    rig.inbox.put(later)
    eventually(lambda: rig.inbox.handled, what="it is handled")
    said = "edge uav-1 speaks wire version 6, this ground reads 5: update this ground"
    assert rig.said.startswith(f"uav-1: {said}  video of uav-1 FAILED at")
    rig.put(0)
    assert "FAILED" not in rig.said
    rig.inbox.put(later)
    eventually(lambda: rig.inbox.handled, what="a second edge of that name is counted")
    assert "FAILED" not in rig.said
    assert rig.sessions.receiver.unusable == 2
    assert join([rig.sessions])


@pytest.mark.parametrize("how", ["ended", "damaged", "silent"])
def test_the_pictures_of_an_edge_fail_no_longer_than_it_sends_them(flight, tmp_path, how):
    """Hours after a flight the page would say that its video has failed."""
    rig = Unseen(flight, Consumer(tmp_path), patience_s=1.0 if how == "silent" else 60.0)
    for _ in range(16):
        rig.report()
    assert "video of uav-1 FAILED at" in rig.said
    if how == "damaged":
        unit = flight.base(0)
        rig.inbox.put(replace(unit, payload=unit.payload[:-1] + b"?"))
    if how != "silent":
        rig.report(state="ended" if how == "ended" else "running")
    eventually(lambda: "FAILED" not in rig.said, what="it is over")
    assert join([rig.sessions])


CAUSES = {
    "clock": "RuntimeError: the clock is gone",
    "consumer": "SystemExit: no room for boxes",
    "callback": "ValueError: not a message",
}


@pytest.mark.parametrize("cause", CAUSES)
def test_a_session_that_fails_ends_alone_and_begins_anew(flight, tmp_path, caplog, cause):
    """One bad frame of one drone would end the picture of all, or leave a recording that opens nowhere."""
    consumer, other = Consumer(tmp_path), Consumer(tmp_path / "other")
    other.folder.mkdir()
    rig, neighbour = Rig(flight, consumer), Rig(flight, other)
    rig.put(*range(5))
    neighbour.put(*range(5))
    if cause == "callback":
        rig.port.broken = ValueError("not a message")
    consumer.broken = cause
    rig.inbox.put(flight.base(5))
    eventually(lambda: rig.summaries, what="the session has ended")
    consumer.broken = ""
    (failed,) = rig.sessions.failures.parts
    assert (failed.part, failed.reason, failed.working) == ("session of uav-1", CAUSES[cause], False)
    assert "uav-1: ended  session of uav-1 FAILED at " in status_text(
        StateMaker(time.time_ns).make([("uav-1", rig.sessions)])
    )
    neighbour.put(*range(5, 40))
    time.sleep(0.1)  # the pause is over
    rig.put(*range(6, 40))
    assert rig.port.keyframe_requests >= 1, "it asks for a picture to begin with"
    assert rig.decoded[1] == 30, "from the next keyframe on"
    assert rig.sessions.failures.parts[0].working
    for one in (rig, neighbour):
        assert join([one.sessions], timeout_s=60)
        assert one.sessions.error is None
    lines = [one.getMessage() for one in caplog.records if one.levelno >= logging.WARNING]
    assert [one for one in lines if "all else goes on" in one] == [
        f"session of uav-1: {CAUSES[cause]}; all else goes on, and it is tried again"
    ]
    sinks = [one.sinks for one in consumer.sessions if one.info.session_id == flight.session_id]
    assert all(one.join(60) for both in sinks for one in both if isinstance(one, QueuedSink))
    first, second = (
        completed(one, rig.sessions, sinks=written) for one, written in zip(rig.summaries, sinks, strict=True)
    )
    assert (first["failure"], second["failure"]) == (CAUSES[cause], "")
    assert [(one["part"], one["count"]) for one in first["failed"]] == [("session of uav-1", 1)]
    assert dict(table(first))["session failed"] == CAUSES[cause]
    before = Recording(Path(first["recording"]))
    assert [frame for frame, _, _ in before.video()][:5] == list(range(5))
    texts = [(level, text) for _, level, text in before.events()]
    assert [level for level, _ in texts[-2:]] == ["ERROR", "INFO"], texts
    assert texts[-2][1] == f"the session failed: {CAUSES[cause]}"
    assert texts[-1][1].endswith("ended")
    assert [frame for frame, _, _ in Recording(Path(second["recording"])).video()] == list(range(10, 40))
    assert len(neighbour.summaries) == 1
    assert neighbour.decoded == [40]


class Held(RetryPause):
    """Lasts from a failure until it is over."""

    over = False

    def due(self, now_ns: int) -> bool:
        return self.over or not self.pause_ns


def test_a_session_that_cannot_begin_is_tried_ever_more_seldom(flight, tmp_path, caplog):
    """A full disk would end the ground, or fill the log with a line a keyframe."""
    consumer = Consumer(tmp_path)
    consumer.broken = "opening"
    rig = Rig(flight, consumer, pause=(pause := Held()))
    rig.put(0, 1, 10, 20, 30)  # four keyframes within the first pause
    assert consumer.tried == 1
    assert rig.sessions.idle
    (failed,) = rig.sessions.failures.parts
    assert failed.reason == "a.rrd: No space left on device", "an operator reads no numbers of errors"
    assert f"uav-1: {failed.reason}  session of uav-1 FAILED at" in status_text(
        StateMaker(time.time_ns).make([("uav-1", rig.sessions)])
    )
    requests = rig.port.keyframe_requests
    assert requests <= 1, "an edge is not asked for keyframes that nobody takes"
    consumer.broken, pause.over = "", True
    rig.put(*range(36, 40))
    assert consumer.tried == 2
    assert rig.decoded == [4]
    assert rig.sessions.failures.parts[0].working
    assert join([rig.sessions], timeout_s=60)
    assert sum("all else goes on" in one.getMessage() for one in caplog.records) == 1


@pytest.mark.parametrize("waiting", [3, 20])
def test_on_a_busy_machine_messages_that_had_come_are_taken_in_or_their_loss_said(
    flight, tmp_path, monkeypatch, waiting
):
    """A second after Ctrl-C the rest of a flight was thrown away without a word.

    Who waits for it gave up before that time was over, and said that it hangs.
    """
    rig, now_ns, goes_on = Rig(flight, Consumer(tmp_path)), [time.monotonic_ns()], threading.Semaphore(0)
    rig.put(*range(10))
    get = rig.inbox.get

    def slow(*, timeout_s: float) -> Received | None:
        goes_on.acquire()
        now_ns[0] += 3 * SECOND_NS // 2
        return get(timeout_s=timeout_s)

    def monotonic() -> float:
        goes_on.release()
        return now_ns[0] / SECOND_NS

    monkeypatch.setattr(process, "time", SimpleNamespace(monotonic=monotonic))
    monkeypatch.setattr(edge_sessions, "time", SimpleNamespace(monotonic_ns=lambda: now_ns[0]))
    monkeypatch.setattr(rig.inbox, "get", slow)
    for index in range(10, 10 + waiting):
        rig.inbox.put(flight.base(index))
    assert join([rig.sessions])
    said = [one.reason for one in rig.sessions.failures.parts]
    assert rig.decoded == [13] if waiting == 3 else re.fullmatch(r"1[3-5] of the messages .*", *said)
    assert bool(said) == (waiting == 20)


def test_what_waits_behind_a_hole_is_received_though_nothing_more_comes(flight, tmp_path):
    """The edge would hear of nothing that came, and hold the keyframe that would end the wait."""
    rig = Rig(flight, Consumer(tmp_path))
    rig.put(0, 1, 3)
    session = rig.sessions.session
    eventually(lambda: session.reception.frames == 3, what="the one behind the hole is received")
    assert join([rig.sessions], timeout_s=60)


def test_a_flight_that_has_ended_holds_no_place(tmp_path):
    """A ground that runs for years would refuse every drone after the sixty-fourth."""
    rig = Rig(Flight(1), Consumer(tmp_path))
    rig.put(0)
    assert rig.port.used.is_set()
    join([rig.sessions])
    assert rig.decoded == [1]
    assert not rig.port.used.is_set()
