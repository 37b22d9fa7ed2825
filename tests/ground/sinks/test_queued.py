"""Sinks that are slow, gone or dead: whoever logs is not held up, and what is missing is known."""

import os
import re
import signal
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest

from hvt_archive.exports.tables import LineFile
from hvt_archive.viewer import LiveView
from hvt_common.errors import UserError
from hvt_common.runtime import failures as failures_module
from hvt_common.runtime import process
from hvt_common.runtime.failures import Failures
from hvt_ground.events import Event, Notice, VideoSample
from hvt_ground.sinks import Outputs, QueuedSink, queued
from hvt_ground.sinks.queued import SinkWriter
from hvt_ground.sinks.rerun.live_view import listening
from hvt_ground.sinks.rerun.recorder import Recorder
from media.recorded_feed import START_NS, STEP_NS, coded, drawn_frames
from programs.processes import eventually, free_ports
from programs.rrd import Recording, recorded, settings


@pytest.fixture
def pipe(tmp_path) -> Path:
    """A file of a slow disk: opening it waits for a reader, writing for room."""
    path = tmp_path / "table.csv"
    os.mkfifo(path)
    return path


@pytest.fixture
def failures() -> Failures:
    return Failures(time.time_ns)


@pytest.fixture
def viewer() -> Iterator[tuple[LiveView, Callable[[], None]]]:
    """One that shows, and how to kill it."""
    port, web_port = free_ports(2)
    with LiveView("serve", port=port, web_port=web_port) as view:

        def kill() -> None:
            os.kill(view.pid, signal.SIGKILL)
            eventually(lambda: not listening(port), what="the viewer is dead")

        yield view, kill


@pytest.fixture(scope="module")
def samples() -> list[VideoSample]:
    """Three seconds of real x265 access units, a keyframe every 20."""
    units = coded(drawn_frames(45), kbps=300, keyint=20)
    return [VideoSample(i, START_NS + i * STEP_NS, *unit) for i, unit in enumerate(units)]


def test_a_disk_that_does_not_answer_holds_nobody_up(pipe, failures, caplog, monkeypatch):
    """The picture would stand still until a slow card has written, or the memory fill with what it is to write.

    A recording was half a minute behind without a word, and whoever took the power away lost it.
    """
    monkeypatch.setattr(queued, "BEHIND_S", 0.0)
    sink = QueuedSink("tracks table", lambda: LineFile(pipe, ("a",)), failures=failures)
    for _ in range(10_000):  # one that waited would wait for ever
        sink.log("x" * 100 + "\n")
    assert sink.missing == 10_000 - 4096
    assert "tracks table is too slow: 4096 events were dropped so far" in caplog.messages
    assert not sink.idle
    assert sink.behind_s > 0
    with pipe.open() as reader:
        sink.close()
        lines = reader.read().splitlines()
    assert sink.join(60)
    assert sink.behind_s == 0
    assert lines == ["a", *["x" * 100] * 4096], "what was taken is written, in whole lines"
    assert re.search(r"tracks table is too slow: it is \d+ s behind, which a kill would lose\n", caplog.text)
    assert failures.parts == (), "slow is not broken"


def test_one_that_had_caught_up_is_told_of_again_however_late_it_was_before(failures, caplog, monkeypatch):
    """After a minute that a card once took, half a minute of a recording that a kill would lose went untold."""
    now_s, goes_on = [0.0], threading.Semaphore(0)
    monkeypatch.setattr(queued, "time", SimpleNamespace(**{**vars(time), "monotonic": lambda: now_s[0]}))

    class Slow(SinkWriter[float]):
        def log(self, item: float) -> None:
            goes_on.acquire()
            now_s[0] += item

    sink = QueuedSink("tracks table", Slow, failures=failures)
    for late_s in (60.0, 30.0):
        for takes_s in (late_s, 0.0, 0.0):
            sink.log(takes_s)
        goes_on.release(3)
        eventually(lambda: sink.idle, what="it has caught up")
    sink.close()
    said = [one for one in caplog.messages if "tracks table is too slow" in one]
    assert [one.split()[7] for one in said] == ["60", "30"]


def test_a_disk_that_hangs_is_said_until_it_answers(pipe, failures, monkeypatch):
    """A recording's disk hung for a minute: the queue filled, and status, page and report called all well."""
    monkeypatch.setattr(failures_module, "SILENT_NS", 0)
    sink = QueuedSink("tracks table", lambda: LineFile(pipe, ("a",)), failures=failures)
    eventually(lambda: [one.part for one in failures.now] == ["tracks table"], what="it is said")
    with pipe.open() as reader:
        sink.close()
        assert reader.read() == "a\n"
    assert sink.join(60)
    assert not failures.now


def test_one_that_has_ended_does_not_fail_any_more(failures):
    """The status line would tell of a recording for ever whose session is over; the summary does."""

    def refused() -> SinkWriter[str]:
        raise UserError("no room")

    sink = QueuedSink("recording of uav-1", refused, failures=failures)
    eventually(lambda: failures.now, what="it has failed")
    sink.close()
    assert sink.join(60)
    assert failures.now == ()
    assert [one.working for one in failures.parts] == [False]
    failures.failed("recording of uav-1", "of the next session")
    failures.over("recording of uav-1", 1)
    assert [one.reason for one in failures.now] == ["of the next session"], "the first ends after it began"


def test_one_that_waits_for_a_keyframe_has_it_asked_for_once(failures):
    """An edge that makes none by itself would never show it a picture."""

    class Waiting(SinkWriter[str]):
        def log(self, item: str) -> None:
            self.awaits_keyframe = item == "waits"

    sink = QueuedSink("page", Waiting, failures=failures)
    for item, asks in (("shown", False), ("waits", True), ("shown", False)):
        sink.log(item)
        eventually(lambda: sink.idle, what="it is taken")
        assert (sink.take_resumed(), sink.take_resumed()) == (asks, False)
    sink.close()


def test_one_that_never_answers_does_not_keep_the_ground_from_ending(pipe, failures, caplog):
    """Ctrl-C would be answered with kill -9."""
    outputs = Outputs(failures)
    sink = outputs.open("tracks table", lambda: LineFile(pipe, ("a",)))
    outputs.close(within_s=0.1)
    assert not sink.ended
    assert [(one.part, one.working) for one in failures.parts] == [("tracks table", False)]
    said = "tracks table: it did not end in time, and what it had yet to write is lost; all else goes on"
    assert said in caplog.messages, "it is not tried again"
    with pipe.open():  # so that the test's own process has no thread left
        eventually(lambda: sink.ended, what="the thread ends")


def test_one_that_a_busy_machine_holds_up_is_let_to_its_end(failures, monkeypatch):
    """Beside two other programs the last rows of a flight were lost: all of them took longer than eight seconds."""
    now_s, goes_on, written = [0], threading.Semaphore(0), []

    def monotonic() -> int:
        goes_on.release()
        return now_s[0]

    class Slow(SinkWriter[int]):
        def log(self, item: int) -> None:
            goes_on.acquire()
            now_s[0] += 3
            written.append(item)

    monkeypatch.setattr(process, "time", SimpleNamespace(monotonic=monotonic))
    outputs = Outputs(failures)
    sink = outputs.open("tracks table", Slow)
    for item in range(6):
        sink.log(item)
    outputs.close()
    assert (written, failures.parts) == ([*range(6)], ())


def test_a_sink_that_has_ended_keeps_nothing_of_what_made_it(tmp_path):
    """A ground knows hundreds of ended sessions: each would keep its page with all pictures of its stills."""

    def open_sink() -> LineFile:
        return LineFile(tmp_path / "a.csv", ("a",))

    maker = weakref.ref(open_sink)
    sink = Outputs(Failures(time.time_ns)).open("page", open_sink)
    del open_sink
    assert sink.join(60)
    assert maker() is None


def test_what_sends_to_others_is_made_again_after_the_longest_pause(failures, caplog):
    """A server that cuts each connection at once would see everything go stale between two tries."""
    tries: list[float] = []

    def cut() -> LineFile:
        tries.append(time.monotonic())
        raise OSError("it has closed the connection")

    sink: QueuedSink[str] = Outputs(failures).open("CoT", cut, longest_pause_s=0.01)
    eventually(lambda: len(tries) > 4, what="it is tried again")
    assert sink.join(60)
    assert sum("tried again" in one.message for one in caplog.records) == 1


def test_in_lockstep_a_full_queue_is_waited_for(pipe, failures):
    """Two runs of one input would leave two different tables, by the speed of the disk."""
    sink = QueuedSink("table", lambda: LineFile(pipe, ("a",)), failures=failures, wait_s=30.0)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    read = b""
    for number in range(6000):
        sink.log(f"{number}\n" * 20)
        if number % 50 == 49:
            read += _all_of(reader)
    sink.close()
    while not sink.ended:
        read += _all_of(reader)
    read += _all_of(reader)
    os.close(reader)
    assert sink.missing == 0
    assert read.split()[1:] == [b"%d" % number for number in range(6000) for _ in range(20)]


def _all_of(reader: int) -> bytes:
    try:
        return os.read(reader, 1 << 20)
    except BlockingIOError:
        return b""


def test_video_goes_on_at_a_keyframe_after_a_gap(samples, tmp_path):
    """A viewer would show garbage for what refers to frames that were dropped."""
    path = tmp_path / "a.rrd"
    with Recorder(settings(path)) as recorder:
        for sample in samples:
            if sample.frame_index == 10:
                recorder.skipped(3)
            if not 10 <= sample.frame_index < 13:
                recorder.log(sample)
    recording = Recording(path)
    assert [frame for frame, _, _ in recording.video()] == [*range(10), *range(20, 45)]
    assert (13, "WARN", "3 events are missing here: writing was too slow") in recording.events()


def test_a_viewer_that_is_killed_is_told_of_and_started_again(samples, viewer, failures, tmp_path, caplog):
    """Closing the window must not cost the flight, and a web viewer that has crashed come back for the next look."""
    outputs, (view, kill) = Outputs(failures), viewer

    def shown() -> Recorder:
        view.start_again()
        return Recorder(settings(None, live_url=view.url))

    def told() -> bool:
        live.log(Notice(0, START_NS, "info", "still there?"))
        time.sleep(0.05)
        return bool(failures.parts)

    recording = outputs.open("recording", lambda: Recorder(settings(tmp_path / "a.rrd")))
    live = outputs.open("live view", shown)
    feed(samples[:20], recording, live)
    eventually(lambda: live.is_open() and live.idle, what="it is shown")
    kill()
    eventually(told, what="that is noticed")
    (failed,) = failures.parts
    assert (failed.part, failed.reason) == ("live view", f"the viewer at {view.url} is gone")
    feed(samples[20:], recording, live)
    eventually(live.is_open, what="it is started again")
    assert live.take_resumed(), "which asks for a keyframe"
    assert failures.parts[0].working
    outputs.close(within_s=60)
    assert live.missing > 0
    assert recording.missing == 0
    assert len(Recording(tmp_path / "a.rrd").video()) == len(samples)
    assert [one.split(":")[0] for one in caplog.messages] == ["live view", "live view"], "once each way"


def test_a_recording_does_not_mind_that_a_viewer_is_gone(samples, viewer, tmp_path):
    """The SDK tells whoever ends a recording that another one's viewer is gone: that recording broke off."""
    view, kill = viewer
    live = Recorder(settings(None, live_url=view.url))
    live.log(samples[0])
    kill()
    for number in range(30):  # while the SDK finds out that nobody takes what it sends
        with suppress(UserError):
            live.log(samples[number + 1])
        assert len(Recording(recorded(tmp_path / f"{number}.rrd", samples[:1])).video()) == 1
    with suppress(UserError):
        live.close(None)


def feed(events: list[Event], *sinks: QueuedSink[Event]) -> None:
    for event in events:
        for sink in sinks:
            sink.log(event)
