"""Jobs of the backlog: what they log is acknowledged when it is written; what a session's end overtakes is let go."""

import itertools
import os
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import Any

import pytest

from hvt_archive.exports.tables import LineFile
from hvt_common.protocol.messages import BacklogUnit, RoiHeader, parse_backlog_units
from hvt_common.runtime.failures import Failures, RetryPause
from hvt_ground.backlog.edge_backlog import BacklogRecording, BacklogRecordings
from hvt_ground.backlog.session_backlog import SessionBacklog, read_still, show_video
from hvt_ground.events import Event, Notice, VideoSample
from hvt_ground.perception.stills.decode import ReceivedStill
from hvt_ground.perception.worker import Job
from hvt_ground.sinks import QueuedSink
from hvt_ground.sinks.queued import SinkWriter
from programs.processes import eventually
from rigs.backlog_chunks import video_object
from rigs.examples import refinement
from rigs.flight import Flight, StoredPerception, patient_worker


def units_of(flight: Flight, count: int) -> tuple[BacklogUnit, ...]:
    return parse_backlog_units(video_object(flight, range(count)))


def test_work_that_was_never_begun_lets_its_recording_go():
    """The recording of a former session would stay open for ever, and with each such session one more."""
    flight = Flight(30, keyframes=(10,))
    info, units = flight.info(), units_of(flight, 20)[10:]
    last_shown, go_on = threading.Event(), threading.Event()
    users: list[SessionBacklog] = []

    def log(event) -> None:
        if event.frame_index == units[-1].frame_index:
            last_shown.set()
            go_on.wait(timeout=60)

    former = SessionBacklog(info, log=log, perception=StoredPerception(info), read=lambda _still: None)

    @contextmanager
    def take():
        users.append(former)
        try:
            yield former
        finally:
            users.remove(former)

    worker = patient_worker(lambda *_: None, lambda *_: None, lambda _stills: None, finish_s=0.1, leave_s=0.1)
    outcomes: list[bool | None] = []
    worker.submit(show_video(units, take, worker=worker, done=outcomes.append))
    assert last_shown.wait(timeout=60)
    never = show_video(units, take, worker=worker, done=outcomes.append)
    worker.submit(never)
    assert users == [former], "one that waits has nothing in hand"
    assert not worker.close(), "it is in the middle of a frame when the session ends"
    go_on.set()
    eventually(lambda: not users, what="the boxes that were to be found hold nothing either")
    assert None not in outcomes


class SlowFile(SinkWriter[Event]):
    """Writes when the disk is ``ready``; ``breaks`` makes the next write fail."""

    def __init__(self) -> None:
        self.ready, self.writing, self.breaks = threading.Event(), threading.Event(), threading.Event()
        self.written: list[Event] = []

    def log(self, item: Event) -> None:
        self.writing.set()
        self.ready.wait(timeout=60)
        if self.breaks.is_set():
            self.breaks.clear()
            raise OSError(28, "No space left on device")
        self.written.append(item)

    @property
    def frames(self) -> list[int]:
        """Of the video that is written."""
        return [one.frame_index for one in self.written if isinstance(one, VideoSample)]


def sink_of(open_sink: Callable[[], SinkWriter[Any]]) -> QueuedSink[Any]:
    return QueuedSink("recording", open_sink, failures=Failures(time.time_ns))


class Outage:
    """Stored things of one session on their way to a slow file."""

    def __init__(self) -> None:
        self.flight = Flight(30, keyframes=(0,))
        self.file = SlowFile()
        self.sink = sink_of(lambda: self.file)
        assert self.sink.is_open(within_s=20)
        self.backlog = SessionBacklog(
            self.flight.info(), log=self.sink.log, perception=None, read=self._read, outputs=[self.sink]
        )
        self.said: list[bool | None] = []
        self._to = lambda: nullcontext(self.backlog if self.backlog.able() else None)

    def video(self) -> Job:
        worker = patient_worker(lambda *_: None, lambda *_: None, lambda _stills: None)
        worker.close()
        return show_video(units_of(self.flight, 30), self._to, worker=worker, done=self.said.append)

    def still(self) -> Job:
        item = self.flight.still(3, 7)
        still = ReceivedStill(RoiHeader.parse(item.attachment, item.payload), item.payload)
        return read_still(still, self._to, done=self.said.append)

    def hold(self) -> None:
        """The disk stops in the middle of an event."""
        self.sink.log(Notice(0, 0, "info", "held"))
        assert self.file.writing.wait(timeout=60)

    def fill(self, count: int) -> None:
        for number in range(count):
            self.sink.log(Notice(number, number, "info", "live"))

    def _read(self, still: ReceivedStill) -> None:
        of = still.header
        at = {"frame_index": of.frame_index, "capture_ns": of.capture_ns, "still_sequence": of.sequence}
        self.sink.log(refinement(**at, still=still.data, stored=True))


def finish(job: Job) -> None:
    for _ in job:
        pass


@pytest.mark.parametrize("kind", ["video", "still"])
def test_what_was_stored_is_acknowledged_when_it_is_written(kind):
    """A ground that fell over before the disk had it would take it along: its edge had deleted it."""
    outage = Outage()
    outage.hold()
    finish(getattr(outage, kind)())
    assert outage.said == [], "it stands in a queue"
    outage.file.ready.set()
    eventually(lambda: outage.said == [True], what="it is written")
    outage.sink.close()


@pytest.mark.parametrize("kind", ["video", "still"])
def test_stored_things_do_not_press_into_a_queue_that_is_half_full(kind):
    """They found no room there, were counted as come, and deleted at the edge: nobody has them any more."""
    outage = Outage()
    outage.hold()
    outage.fill(4200)
    finish(getattr(outage, kind)())
    assert outage.said == [None], "it is to come again"
    outage.file.ready.set()
    eventually(lambda: outage.sink.idle, what="the disk has kept up")
    finish(getattr(outage, kind)())
    eventually(lambda: outage.said == [None, True], what="the second time it is written")
    assert outage.file.frames == (list(range(30)) if kind == "video" else [])
    outage.sink.close()


def test_a_stretch_that_meets_a_full_queue_halfway_goes_on_where_it_was():
    """Its second coming would put frames twice into the recording, or leave out the rest of them."""
    outage = Outage()
    outage.hold()
    job = outage.video()
    for _ in range(10):
        next(job)
    outage.fill(4200)
    finish(job)
    assert outage.said == []
    outage.file.ready.set()
    eventually(lambda: outage.said == [None], what="it is to come again")
    eventually(lambda: outage.sink.idle, what="the disk has kept up")
    finish(outage.video())
    eventually(lambda: outage.said == [None, True], what="the rest is written")
    assert outage.file.frames == list(range(30))
    assert outage.backlog.totals.frames == 30
    outage.sink.close()


@pytest.mark.parametrize("kind", ["video", "still"])
def test_what_a_failing_disk_took_along_is_new_when_it_comes_again(kind, monkeypatch):
    """It would be acknowledged at its second coming, for having been here before."""
    monkeypatch.setattr(RetryPause, "due", lambda _self, _now_ns: True)
    outage = Outage()
    outage.hold()
    finish(getattr(outage, kind)())
    outage.file.breaks.set()
    outage.file.ready.set()
    eventually(lambda: outage.said == [None], what="it is lost")
    assert (outage.backlog.totals.frames, outage.backlog.totals.stills) == (0, 0)
    eventually(outage.sink.is_open, what="there is a file again")
    finish(getattr(outage, kind)())
    eventually(lambda: outage.said == [None, True], what="it is written")
    assert len(outage.file.written) == (30 if kind == "video" else 1)
    outage.sink.close()


def test_a_stretch_that_broke_off_comes_again_although_there_is_room_a_moment_later():
    """It would be acknowledged, and its edge delete what nobody has."""
    outage, asked = Outage(), itertools.count()
    outage.file.ready.set()
    outage.backlog.able = lambda: next(asked) != 10
    finish(outage.video())
    eventually(lambda: outage.said == [None], what="it is to come again")
    finish(outage.video())
    eventually(lambda: outage.said == [None, True], what="the rest is written")
    assert outage.file.frames == list(range(30))
    outage.sink.close()


def test_a_ground_that_runs_for_months_takes_former_sessions_every_day(tmp_path):
    """After the thirty-second flight with an outage all that drones have stored would be refused for ever."""
    now_s, made = 0.0, []

    def open_one(info) -> BacklogRecording:
        made.append(sink_of(lambda: LineFile(tmp_path / f"{info.session_id}.csv", ("a",))))
        return BacklogRecording(info, sink=made[-1], perception=StoredPerception(info))

    recordings = BacklogRecordings(open_one, most_files=2, open_s=20.0, clock=lambda: now_s)
    first, second, third = (replace(Flight(1).info(), session_id=number) for number in (1, 2, 3))
    with recordings.using(first) as backlog, recordings.using(second) as other:
        assert None not in (backlog, other)
    assert not recordings.takes(3), "whoever invents sessions does not fill the disk"
    with recordings.using(third) as backlog:
        assert backlog is None
    now_s = 86_400.0
    assert recordings.takes(3)
    with recordings.using(third) as backlog:
        assert backlog is not None
    recordings.close()
    for one in made:
        one.join(60)


def test_a_recording_that_is_slow_to_open_holds_up_only_who_opens_it(tmp_path):
    """The live picture would stand still until the disk has made a file for what was stored long ago."""
    info = Flight(1).info()
    pipe = tmp_path / "recording"
    os.mkfifo(pipe)  # opening it waits for a reader
    opened = threading.Event()
    sinks: list[QueuedSink] = []

    def open_one(info) -> BacklogRecording:
        sinks.append(sink_of(lambda: LineFile(pipe, ("a",))))
        opened.set()
        return BacklogRecording(info, sink=sinks[-1], perception=StoredPerception(info))

    recordings = BacklogRecordings(open_one, open_s=60.0)
    acquired: list[SessionBacklog | None] = []

    def acquire() -> None:
        with recordings.using(info) as backlog:
            acquired.append(backlog)

    worker = threading.Thread(target=acquire)
    worker.start()
    assert opened.wait(timeout=60)
    assert recordings.takes(info.session_id), "what the receiving thread asks of each chunk"
    with recordings.using(info) as other:
        assert other is None, "nobody else waits for it: it is to come again"
    assert recordings.open_sessions == [info.session_id]
    assert not acquired, "it is still being opened"
    with pipe.open():
        worker.join(timeout=60)
        (backlog,) = acquired
        assert backlog is not None
        with recordings.using(info) as other:
            assert other is backlog
        recordings.close()
        eventually(lambda: sinks[0].ended, what="its thread ends")
