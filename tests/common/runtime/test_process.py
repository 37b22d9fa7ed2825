"""A process frees the frames of its threads, and ends with its own exit code."""

import os
import platform
import signal
import subprocess
import sys
import threading
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from hvt_common.runtime import process
from hvt_common.runtime.process import (
    STOP_SIGNALS,
    give_back_holes,
    joined,
    limit_malloc_arenas,
    lower_priority,
    stop_on_signals,
)
from hvt_edge.video.x265 import NewThreads
from programs.processes import python

only_with_glibc = pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="it is about glibc's heaps")


@pytest.mark.parametrize("one", STOP_SIGNALS)
def test_each_way_to_stop_a_program_ends_it_in_order(one):
    """A closed terminal, systemd or Ctrl-C would leave half a recording; ``nohup`` is heeded."""
    for before, stops in ((signal.SIG_DFL, True), (signal.SIG_IGN, one is not signal.SIGHUP)):
        signal.signal(one, before)
        stop = stop_on_signals()
        assert not stop.is_set()
        signal.raise_signal(one)
        assert stop.is_set() is stops


STOPPED = """
import sys, time
from hvt_common.errors import FlightError
from hvt_common.runtime import process

process._SECOND_SIGNAL_S, process._END_WITHIN_S = 0.0, float(sys.argv[1])
hanging = sys.argv[2] != "slow"
stop = process.stop_on_signals()

def hang():
    print("began", flush=True)
    stop.wait()
    print("heard", flush=True)
    time.sleep(3600 if hanging else 1)

try:
    in_hand = frozenset({("encoder", 1)} if hanging else ())
    process.ended_in_time(hang, stop, in_hand=lambda: in_hand, otherwise=lambda: FlightError("it hangs"))
except FlightError:
    process.leave(1)
"""


@pytest.mark.parametrize(
    ("one", "within", "what", "code"),
    [
        *((one, "60", "again", -1) for one in STOP_SIGNALS),
        (signal.SIGINT, "0.1", "hangs", 1),
        (signal.SIGTERM, "0.1", "slow", 0),
    ],
)
def test_a_program_that_hangs_needs_no_kill(one, within, what, code):
    """An encoder, a driver or an extra that did not answer: two Ctrl-C were not heard, nor what systemd sends.

    Nor may a slow disk cost the end of a recording.
    """
    words = [sys.executable, "-c", STOPPED, within, what]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout.readline() == "began\n"
        run.send_signal(one)
        assert run.stdout.readline() == "heard\n"
        if what == "again":
            one = (
                signal.SIGTERM if one is signal.SIGHUP else one
            )  # a terminal that is closed meanwhile ends nothing
            run.send_signal(one)
        assert run.wait(60) == (128 + one if what == "again" else code)


def test_parts_that_hang_and_poll_are_given_up_in_the_time_of_one(monkeypatch):
    """Each look at a driver that never answers counted as work: Ctrl-C took 20 s a part."""
    over, now_s = threading.Event(), 0.0

    def poll():
        while not over.wait(0.001):
            pass

    def monotonic():
        nonlocal now_s
        now_s += 1
        return now_s

    monkeypatch.setattr(process, "time", SimpleNamespace(monotonic=monotonic))
    threads = [threading.Thread(target=poll) for _ in range(2)]
    for one in threads:
        one.start()
    assert not joined(*threads, left=lambda: 3, within_s=4.0)
    over.set()
    assert now_s == 5, "from 1"
    assert joined(*threads, left=lambda: 0, within_s=1e6)


FRAMES = """
import threading
import numpy as np, psutil
from hvt_common.runtime.process import limit_malloc_arenas
if {asked}:
    limit_malloc_arenas()
np.ones(1 << 22, np.uint8)  # the first that is freed teaches glibc that frames are common
go_on, kept = threading.Event(), []

def stage(done):
    frames = []
    for _ in range(20):
        frames.append(np.ones(3 << 19, np.uint8))
        kept.append(np.ones(1 << 12, np.uint8))  # what a still, a track or a message leaves
    frames.clear()
    done.set()
    go_on.wait()

threads = []
for _ in range(10):  # one after the other: 30 MB are held at a time
    done = threading.Event()
    threads.append(threading.Thread(target=stage, args=(done,)))
    threads[-1].start()
    done.wait()
print(psutil.Process().memory_info().rss >> 20)
go_on.set()
"""


def resident_mb(*, asked, **more):
    """Of a process in which ten threads have held 30 MB each, in turn."""
    around = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")} | more
    return int(python(FRAMES.format(asked=asked), env=around).stdout)


@only_with_glibc
def test_threads_share_the_room_of_frames():
    """An edge would grow for hours by what ten threads held in turn; who asks for another allocation keeps it."""
    few, many, asked = (
        resident_mb(asked=asked, **more)
        for asked, more in (
            (True, {}),
            (False, {"MALLOC_ARENA_MAX": "16"}),
            (True, {"MALLOC_ARENA_MAX": "16"}),
        )
    )
    assert few < min(many, asked) - 100


HOLES = """
import numpy as np, psutil
from hvt_common.runtime.process import give_back_holes, limit_malloc_arenas
limit_malloc_arenas()
frames, kept = [], []
for _ in range(40):
    frames.append(np.ones(3 << 19, np.uint8))
    kept.append(np.ones(1 << 12, np.uint8))  # what a still, a track or a message leaves
frames.clear()
held = psutil.Process().memory_info().rss
give_back_holes()
print(held - psutil.Process().memory_info().rss >> 20)
"""


@only_with_glibc
def test_what_lies_between_pictures_is_given_back():
    """The peaks of different threads would add up, 20 MB of an edge's."""
    assert int(python(HOLES).stdout) >= 40, "of 60"


@pytest.mark.parametrize(
    ("set_up", "trims"), [((), 0), ((limit_malloc_arenas,), 1)], ids=["another program", "ours"]
)
def test_the_memory_of_another_program_is_left_alone(set_up, trims, monkeypatch):
    """An edge within a program that holds gigabytes would go through all of them each second, with its locks held."""
    libc = Mock()
    monkeypatch.setattr(process.ctypes, "CDLL", Mock(return_value=libc))
    monkeypatch.setattr(process, "allocator_set", threading.Event())
    monkeypatch.setattr(process.sys, "platform", "linux")
    monkeypatch.setattr(process.os, "environ", {})
    for one in set_up:
        one()
    give_back_holes()
    assert libc.malloc_trim.call_count == trims


DETECTING = """
import threading, time
import numpy as np
from hvt_common.inference.detect import open_detector
from hvt_common.runtime.process import leave

began = threading.Semaphore(0)

def detect():
    detector, picture = open_detector("aerial-nano"), np.zeros((360, 640, 3), np.uint8)
    while True:
        detector.detect(picture)
        began.release()

for _ in range(2):
    threading.Thread(target=detect, daemon=True).start()
for _ in range(4):
    began.acquire()
print("all was written", end="")
leave(3)
"""


def test_a_process_ends_with_its_code_while_a_detection_runs():
    """Python ends such a thread as it finalizes, and onnxruntime aborts: a good flight would count as failed."""
    done = python(DETECTING, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (3, "all was written", "")


def niceness(thread):
    return os.getpriority(os.PRIO_PROCESS, thread)


def may_raise_priority():
    """Whether a thread that has lowered its priority may take it back here."""

    def tried():
        lower_priority()
        try:
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness(os.getpid()))
        except OSError:
            return False
        return True

    answers: list[bool] = []
    thread = threading.Thread(target=lambda: answers.append(tried()))
    thread.start()
    thread.join()
    return answers == [True]


@pytest.mark.skipif(sys.platform != "linux", reason="it is about Linux's niceness")
def test_a_library_that_lowers_its_own_workers_gets_them_back():
    """x265 does: each frame would wait behind the detector."""
    lowered, end = threading.Event(), threading.Event()

    def work():
        lower_priority()
        lowered.set()
        end.wait()

    other = threading.Thread(target=work)
    other.start()
    lowered.wait()
    lowered.clear()
    workers = NewThreads()
    with workers:
        worker = threading.Thread(target=work)
        worker.start()
    lowered.wait()
    try:
        own = niceness(threading.get_native_id())
        assert worker.native_id is not None
        assert other.native_id is not None
        assert niceness(worker.native_id) == max(own, 11), "as the first is"
        workers.raise_priority()
        assert niceness(worker.native_id) == (own if may_raise_priority() else max(own, 11))
        assert niceness(other.native_id) == max(own, 11), "it was there before"
    finally:
        end.set()
        worker.join()
        other.join()
    workers.raise_priority()  # of threads that have ended


ZENOH_THREADS = """
from contextlib import suppress
from pathlib import Path
from hvt_common.runtime.process import share_zenoh_threads
from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import LinkSettings
share_zenoh_threads()
with open_session(LinkSettings(role="edge", connect=("tcp/127.0.0.1:9",))):
    for task in Path("/proc/self/task").iterdir():
        with suppress(OSError):  # a thread that has ended
            print(task.joinpath("comm").read_text().split("-")[0])
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="it looks at the names of threads")
def test_zenoh_shares_its_threads():
    """Each of three more would take megabytes of a small computer."""
    around = {name: value for name, value in os.environ.items() if name != "ZENOH_RUNTIME"}
    names = set(python(ZENOH_THREADS, env=around).stdout.split())
    assert "app" in names
    assert not names & {"net", "acc", "rx"}
