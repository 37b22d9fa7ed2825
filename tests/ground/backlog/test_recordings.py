"""Recordings of former sessions on a disk that does not answer."""

from __future__ import annotations

import os
import threading
import time
from dataclasses import replace

from hvt_common.runtime.failures import Failures
from hvt_ground.backlog.edge_backlog import BacklogRecording, BacklogRecordings
from hvt_ground.backlog.session_backlog import SessionBacklog
from hvt_ground.sinks import QueuedSink
from hvt_ground.sinks.line_file import LineFile
from programs.processes import eventually
from rigs.flight import Flight, StoredPerception


def test_a_ground_that_runs_for_months_takes_former_sessions_every_day(tmp_path):
    """After the thirty-second flight with an outage all that drones have stored would be refused for ever."""
    now_s, made = 0.0, []

    def open_one(info) -> BacklogRecording:
        path = tmp_path / f"{info.session_id}.csv"
        made.append(QueuedSink("recording", lambda: LineFile(path, ("a",)), failures=Failures(time.time_ns)))
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
        one.join(time.monotonic() + 60)


def test_a_recording_that_is_slow_to_open_holds_up_only_who_opens_it(tmp_path):
    """The live picture would stand still until the disk has made a file for what was stored long ago."""
    info = Flight(1).info()
    pipe = tmp_path / "recording"
    os.mkfifo(pipe)  # opening it waits for a reader
    opened = threading.Event()
    sinks: list[QueuedSink] = []

    def open_one(info) -> BacklogRecording:
        sinks.append(QueuedSink("recording", lambda: LineFile(pipe, ("a",)), failures=Failures(time.time_ns)))
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
