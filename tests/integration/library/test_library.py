"""HVT as a part of another program: frames are pushed in at one end, pictures and tracks come out at the other."""

import queue
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any, cast

import cv2
import numpy as np
import pytest

import hvt_edge
import hvt_ground
from hvt_common.errors import FlightError, UserError
from hvt_edge.source import live
from hvt_ground.events import Overlay
from hvt_library import edge as library
from hvt_library.edge import PushedEdge, _PushGrabber
from hvt_library.ground import Picture, Received, _Events
from media.recorded_feed import drawn_frames
from programs.processes import eventually, free_ports

pytestmark = pytest.mark.integration

FPS = 15


def push_all(edge: PushedEdge, frames: list[np.ndarray], *, rounds: int = 1) -> list[int]:
    """At the rate of a camera; the capture times."""
    times = []
    for frame in frames * rounds:
        times.append(time.time_ns())
        edge.push(frame, capture_ns=times[-1])
        time.sleep(1 / FPS)
    return times


def push_until(edge: PushedEdge, frames: list[np.ndarray], times: list[int], enough: threading.Event) -> None:
    while not enough.wait(1 / FPS):
        times.append(time.time_ns())
        edge.push(frames[(len(times) - 1) % len(frames)], capture_ns=times[-1])


def test_what_is_pushed_arrives_as_pictures_and_tracks(tmp_path, monkeypatch):
    """A robot's own program would have to write clips for hvt-edge, and read recordings of hvt-ground."""
    monkeypatch.chdir(tmp_path)
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    frames = drawn_frames(90, (320, 192))
    received, times, enough, tracked = [], [], threading.Event(), False
    settings = {"listen": endpoint, "detector": "motion", "classifier": "none", "once": True, "wait": "60s"}
    with hvt_ground.listen(**settings) as ground:
        with hvt_edge.open(
            edge_id="rover-1", connect=[endpoint], detector="motion", budget="400kbps", method="M0"
        ) as edge:
            # On a busy machine the link may come up late.
            pushing = threading.Thread(target=lambda: push_until(edge, frames, times, enough))
            pushing.start()
            for one in ground:
                received.append(one)
                tracked |= isinstance(one.event, Overlay) and len(one.event.track_ids) > 0
                if tracked and sum(isinstance(one.event, Picture) for one in received) > 40:
                    break
            enough.set()
            pushing.join()
        received += list(ground)
    pictures = [one.event for one in received if isinstance(one.event, Picture)]
    assert {one.edge for one in received} == {"rover-1"}
    assert len(pictures) > 40
    sent = {taken_ns: frames[place % len(frames)] for place, taken_ns in enumerate(times)}
    nearest = [min(times, key=lambda at: abs(at - one.capture_ns)) for one in pictures]
    assert max(abs(a - b.capture_ns) for a, b in zip(nearest, pictures, strict=True)) < 50_000_000
    alike = [
        np.corrcoef(
            cv2.cvtColor(one.image_bgr, cv2.COLOR_BGR2GRAY).ravel(),
            cv2.cvtColor(sent[at], cv2.COLOR_BGR2GRAY).ravel(),
        )[0, 1]
        for at, one in zip(nearest, pictures, strict=True)
    ]
    assert np.median(alike) > 0.95
    assert edge.summary["frames"] >= len(pictures)
    assert edge.summary["failed"] == [], "to be closed is no failure"
    assert len(ground.summaries) == 1
    assert list(tmp_path.glob("*.rrd")) == [], "nobody asked for a recording"


@pytest.mark.nightly
def test_a_program_that_takes_nothing_holds_nobody(tmp_path, monkeypatch):
    """The ground's recording, or another edge, would wait for it."""
    monkeypatch.chdir(tmp_path)
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    frames = drawn_frames(60, (320, 192))
    with (
        hvt_ground.listen(
            listen=endpoint, detector="motion", classifier="none", record=tmp_path / "flight.rrd"
        ) as ground,
        hvt_edge.open(edge_id="rover-1", connect=endpoint, detector="motion", method="M0") as edge,
    ):
        push_all(edge, frames, rounds=2)
    assert ground.summaries[0]["frames"] > 60
    assert (tmp_path / "flight.rrd").stat().st_size > 50_000
    assert len(list(ground)) <= 40, "what waits is bounded"


def test_what_is_wrong_is_raised_where_the_program_can_see_it(tmp_path, monkeypatch):
    """A robot would fly on blind and not know."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="budget"):
        hvt_edge.open(budget="none at all")
    with pytest.raises(UserError, match=r"source 'clip\.mp4' is not accepted: frames are pushed"):
        hvt_edge.open(source="clip.mp4")
    with pytest.raises(UserError, match="colour"):
        hvt_ground.listen(colour="blue")
    edge = hvt_edge.open(connect="tcp/127.0.0.1:9", detector=tmp_path / "absent.onnx")
    with pytest.raises(ValueError, match=r"float64 \(4, 4\) is not accepted"):
        edge.push(cast("Any", np.zeros((4, 4))))
    with pytest.raises(ValueError, match="None is no frame"):  # as of `cv2.VideoCapture.read` at its end
        edge.push(cast("Any", None))
    for wrong in cast("tuple[int, ...]", (1.5e18, "now", -1, 1 << 63)):
        with pytest.raises(ValueError, match="whole nanoseconds of Unix time are"):
            edge.push(np.zeros((4, 4, 3), np.uint8), capture_ns=wrong)
    with pytest.raises((UserError, FlightError), match=r"absent\.onnx"):
        push_all(edge, drawn_frames(60, (320, 192)))
    with pytest.raises((UserError, FlightError), match=r"absent\.onnx"):
        edge.close()
    ground = hvt_ground.listen(listen="tcp/127.0.0.1:0nonsense")
    with pytest.raises(UserError, match="0nonsense"):
        next(ground)


def test_a_flight_that_fails_keeps_its_summary(monkeypatch):
    """What was sent before the disk was gone would be known to nobody."""

    def fail(_edge):
        raise FlightError("the disk is gone", summary={"frames": 3})

    monkeypatch.setattr(library.Edge, "run", fail)
    edge = hvt_edge.open(connect="tcp/127.0.0.1:9", detector="motion")
    with pytest.raises(FlightError, match="the disk is gone"):
        edge.close()
    assert edge.summary == {"frames": 3}


def test_a_program_that_pushes_again_after_a_pause_is_sent_at_once(monkeypatch, caplog):
    """Its video would stay dark for up to eight seconds after it is there again, as after a camera that is gone."""
    monkeypatch.setattr(library, "PATIENCE_S", 0.01)
    monkeypatch.setattr(live, "FIRST_WAIT_NS", 10**18)  # who waits as for a camera waits for ever
    with hvt_edge.open(connect="tcp/127.0.0.1:9", wait="0s", method="M0", store="0", fps="10") as edge:
        frame = np.zeros((96, 128, 3), np.uint8)
        edge.push(frame)
        eventually(lambda: "no frame was pushed" in caplog.text, what="it is away")
        eventually(lambda: edge.push(frame) or "works again" in caplog.text, what="it is there again")


def test_a_program_that_closes_while_the_edge_begins_is_not_away(monkeypatch):
    """On a busy machine its summary said that the source had failed, and the log that it is tried again."""
    monkeypatch.setattr(library, "PATIENCE_S", 0)
    grabber = _PushGrabber(fps=100)
    grabber.put(np.zeros((96, 128, 3), np.uint8), 0)
    grabber.open()
    grabber.grab()
    with pytest.raises(
        live.SignalLost, match=r"for 0\.02 s"
    ):  # two frames: one each 6 s was away before each
        grabber.grab()
    grabber.begin_closing()
    with ThreadPoolExecutor(1) as pool:
        grabbing = pool.submit(grabber.grab)
        grabber.end()
        with pytest.raises(live.SignalLost, match="it is closed"):
            grabbing.result()


def test_an_edge_that_never_got_a_frame_ends_quietly():
    """A program that could not open its camera would hang at its end; one that pushes later would think it sends."""
    with hvt_edge.open(connect="tcp/127.0.0.1:9", detector="motion") as edge:
        pass
    assert edge.summary == {}
    with pytest.raises(FlightError, match="the edge has ended: it sends no more frames"):
        edge.push(np.zeros((96, 128, 3), np.uint8))


ENDING = """
import gc, sys, threading, time
import {library}
from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import LinkSettings

heard = threading.Event()

def receive(sample):
    heard.set()
    time.sleep(0.5)

def fly():
    with open_session(LinkSettings("edge", (), (sys.argv[1],))) as session:
        subscriber = session.declare_subscriber("a", receive)
        session.put("a", b"")
        heard.wait(60)

flight = threading.Thread(target=fly, daemon=True)
flight.start()
flight.join()
gc.callbacks.append(lambda *_: time.sleep(0.5))  # Python's end takes longer than the callback
"""


@pytest.mark.parametrize("library", ["hvt_library.edge", "hvt_library.ground"])
def test_a_program_ends_while_zenoh_calls(library):
    """Python ends a thread that comes back from a callback as it finalizes, and Zenoh's library aborts."""
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    done = subprocess.run(
        [sys.executable, "-c", ENDING.format(library=library), endpoint],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_a_program_that_forgets_to_close_ends():
    """It would abort, or hang, or say no goodbye."""
    program = """
import atexit, sys, time
import numpy as np
import hvt_edge
atexit.register(lambda: print("frames" in edge.summary))  # the first, and so the last of all
edge = hvt_edge.open(listen=sys.argv[1], detector="motion", size="320x192")
edge.push(np.zeros((192, 320, 3), np.uint8))
time.sleep(1)
"""
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    done = subprocess.run(
        [sys.executable, "-c", program, endpoint], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "True\n"), done.stderr


def test_large_pictures_that_nobody_takes_have_a_bound_in_bytes(monkeypatch):
    """32 pictures of 8192x4352 would be three gigabytes, of an edge that sent a few kilobytes."""
    monkeypatch.setattr("hvt_library.ground.MOST_QUEUED_BYTES", 1000)
    events, large = _Events(), Picture(0, 0, np.zeros((10, 10, 3), np.uint8))
    for _ in range(4):
        events.put(Received("uav-1", 1, large), block=False)
    with pytest.raises(queue.Full):
        events.put(Received("uav-1", 1, large), block=False)
    events.get()
    events.put(Received("uav-1", 1, large), block=False)
    for _ in range(4):
        events.get()
    events.put(Received("uav-1", 1, large), block=False)
