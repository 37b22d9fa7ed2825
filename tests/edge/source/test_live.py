"""A live camera: what its frames' times mean, and what happens when it goes away."""

from __future__ import annotations

import threading
import time
from functools import partial
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from hvt_common.errors import NotYetError
from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS
from hvt_edge.source import live
from hvt_edge.source.contract import SourceSettings
from hvt_edge.source.live import CameraClock, LiveSource, Shot, SignalLost
from hvt_edge.source.opening import open_source
from hvt_edge.source.resample import Gate
from programs.rtsp_camera import RtspCamera

MS = 1_000_000

SMALL = SourceSettings(size=(64, 64), fps=25)


@pytest.fixture
def quick(monkeypatch):
    """A lost camera is tried again at once, and a wait for its picture is short."""
    monkeypatch.setattr(live, "FIRST_WAIT_NS", 20 * MS)
    monkeypatch.setattr(live, "IDLE_S", 0.05)


def taken(camera: RtspCamera, *, count: int) -> list[tuple[int, int]]:
    """(age at arrival, capture time) of so many frames, ns."""
    frames = []
    with open_source(camera.url, size=(320, 240), fps=25) as source:
        for frame in source.frames(start_ns=0):
            frames.append((time.time_ns() - frame.capture_ns, frame.capture_ns))
            if len(frames) == count:
                break
    return frames


def test_a_frame_has_the_time_that_the_camera_says_by_rtcp(free_port):
    """The delay of camera and network would be missing from every latency that the ground shows."""
    with RtspCamera(free_port, delay_s=0.05) as camera:
        ages = [age for age, _ in taken(camera, count=8)]
    assert min(ages) >= 50 * MS


def test_a_camera_whose_clock_was_never_set_counts_by_its_differences(free_port):
    """Its frames would be of 1970, and the ground show a delay of half a century."""
    with RtspCamera(free_port, clock_ns=lambda: time.time_ns() - 50 * 365 * 86_400 * SECOND_NS) as camera:
        frames = taken(camera, count=12)
    assert all(0 <= age < 20 * SECOND_NS for age, _ in frames)
    assert all(later > earlier for (_, earlier), (_, later) in pairwise(frames))


def test_camera_times_without_jitter_and_never_back():
    """A busy network would shake the time stamps; a camera that sets its clock would turn them back."""
    clock, zero = CameraClock(), 1_000_000 * SECOND_NS
    arrivals = [0, 43, 81, 155, 161, 204]
    times = [
        clock.capture_ns(zero + number * 40 * MS - 20 * MS, now_ns=zero + at * MS)
        for number, at in enumerate(arrivals)
    ]
    assert [later - earlier for earlier, later in pairwise(times)] == [40 * MS] * 5
    back = [
        clock.capture_ns(zero + at * MS - 3600 * SECOND_NS, now_ns=zero + at * MS) for at in (300, 340, 380)
    ]
    assert times[-1] < back[0]
    assert back == [zero + at * MS for at in (300, 340, 380)], "else none would be due for an hour"
    assert clock.capture_ns(None, now_ns=zero + 400 * MS) == zero + 400 * MS


def test_a_camera_that_says_its_time_late_stops_no_picture():
    """Its first RTCP report comes seconds after its first frame: no frame would be due until its time had been."""
    clock, gate, times = CameraClock(), Gate(15), []
    for number in range(400):
        now_ns = 1_000_000 * SECOND_NS + number * SECOND_NS // 25
        camera_ns = now_ns - (3 if number >= 100 else 999_000) * SECOND_NS
        at_ns = clock.capture_ns(camera_ns, now_ns=now_ns)
        times += [(now_ns, at_ns)] if gate.accept(at_ns) else []
    assert max(later - earlier for (earlier, _), (later, _) in pairwise(times)) < SECOND_NS // 4
    assert all(earlier < later for (_, earlier), (_, later) in pairwise(times))
    assert times[-1][0] - times[-1][1] == 3 * SECOND_NS


class SaysItsTimeLater:
    """A camera that says no time until it is opened again, and then that each of its frames is four seconds old."""

    name, notes = "cam", None

    def __init__(self) -> None:
        self.now_ns, self.given, self.ended = 1_000_000 * SECOND_NS, 0, threading.Event()

    def open(self) -> None:
        """It is open."""

    restart = close = open  # noqa: A003 - the method above

    def grab(self) -> Shot:
        """Each fifth of a second; it goes away once, and after sixty for good."""
        if self.given == 60:
            self.ended.set()
            raise SignalLost("it is gone")
        self.given, self.now_ns = self.given + 1, self.now_ns + SECOND_NS // 5
        if self.given == 10:
            raise SignalLost("it went away")
        at_ns = self.now_ns - 4 * SECOND_NS if self.given > 10 else None
        return Shot(partial(np.zeros, (48, 64, 3), np.uint8), at_ns)


def test_a_camera_that_was_away_and_says_other_times_stops_no_picture(quick):
    """No frame would be due for four seconds, and units that are passed through would go back in time."""
    camera = SaysItsTimeLater()
    with LiveSource(camera, SMALL, clock=lambda: camera.now_ns) as source:
        assert camera.ended.wait(60)
        assert source.passed_over == 0
        (*_, newest) = (next(source.steps(start_ns=0)) for _ in range(source.pending))
    assert camera.now_ns - newest.capture_ns == 4 * SECOND_NS, "it has come to what the camera says"


def test_a_camera_that_goes_away_is_told_of_and_comes_back(free_port, caplog, quick):
    """A loose cable would end the flight, or nobody learn why the picture stands still."""
    failures = Failures(time.time_ns)
    first, camera, indices, told = RtspCamera(free_port), None, [], False
    try:
        with open_source(first.url, size=(320, 240), fps=25, failures=failures) as source:
            for frame in source.steps(start_ns=0):
                indices += [] if frame is None else [frame.index]
                if len(indices) == 10 and not failures.parts:
                    first.close()
                away = bool(failures.parts) and not failures.parts[0].working
                told |= away and frame is None
                if away and failures.parts[0].count >= 2 and camera is None:  # it was tried in vain
                    camera = RtspCamera(free_port)
                if camera is not None and not away:
                    break
            assert source.restarts == 1
    finally:
        first.close()
        if camera is not None:
            camera.close()
    (failed,) = failures.parts
    assert (failed.part, failed.working, told) == ("source", True, True)
    assert first.url in failed.reason
    assert indices == list(range(len(indices)))
    assert len(caplog.records) <= 2, "said once, and once that it is back"


class Faulty:
    """A camera whose driver raises one of ``errors`` after each opening, as long as there are some."""

    name, notes = "cam", None

    def __init__(self, *errors: Exception) -> None:
        self._errors = iter(errors)
        self._whole = True
        self.restarts = 0

    def open(self) -> None:
        """It is open."""

    def restart(self) -> None:
        """Every second one fails, too."""
        self.restarts += 1
        if self.restarts % 2:
            raise RuntimeError("the driver is not ready")
        self._whole = True

    def grab(self) -> Shot:
        """A picture at once, and then what goes wrong."""
        self._whole, whole = False, self._whole
        if not whole and (error := next(self._errors, None)) is not None:
            raise error
        time.sleep(0.02)
        return Shot(partial(np.zeros, (48, 64, 3), np.uint8))

    def close(self) -> None:
        """There is nothing to close."""


@pytest.mark.parametrize("where", ["grab", "picture"])
def test_an_error_that_nobody_expects_of_a_camera_costs_its_pictures_alone(monkeypatch, caplog, quick, where):
    """One odd frame of a driver or a decoder would end the flight."""
    camera, failures, waits = Faulty(ValueError("no such layout")), Failures(time.time_ns), []
    if where == "picture":
        monkeypatch.setattr(camera, "grab", raising_pictures(camera.grab))
    with LiveSource(camera, SourceSettings(size=lambda size: size, fps=25), failures=failures) as source:
        for frame in source.steps(start_ns=0):
            waits += [] if frame is None else [frame.index]
            if source.restarts and len(waits) > 5:
                break
    assert waits == list(range(len(waits)))
    assert (camera.restarts, source.restarts) == (2, 1)
    (failed,) = failures.parts
    assert (failed.part, failed.working, failed.count) == ("source", True, 2)
    assert failed.reason == "cam stopped (RuntimeError: the driver is not ready)"
    assert [one.message for one in caplog.records] == [
        "source: cam stopped (ValueError: no such layout); all else goes on, and it is tried again",
        "source: works again",
    ]


def test_a_camera_whose_first_picture_fails_in_an_odd_way_is_waited_for():
    """A camera that is still starting would end the start with a traceback, and nobody try again."""
    camera = SimpleNamespace(name="cam", open=lambda: None, grab=lambda: Shot(broken), close=lambda: None)

    def broken():
        raise ValueError("no such layout")

    with pytest.raises(
        NotYetError, match=r"cam opens but delivers no picture \(ValueError: no such layout\)"
    ):
        LiveSource(camera, SMALL)


def raising_pictures(grab):
    """The same, where the error comes as late as the conversion of the picture."""

    def late() -> Shot:
        try:
            return grab()
        except ValueError as error:
            raised = error

        def image():
            raise raised

        return Shot(image)

    return late


class Bursts:
    """A camera whose frames, 30 a second by its stamps, come so many at a time."""

    name, notes = "cam", None

    def __init__(self, together: int = 3) -> None:
        self.together = together
        self.given, self.now_ns = 0, 1_000 * SECOND_NS
        self.come, self.wanted = threading.Semaphore(0), threading.Semaphore(1)

    def open(self) -> None:
        """It is open."""

    restart = close = open  # noqa: A003 - the method above

    def grab(self) -> Shot:
        """The next; before the first of a burst, once it is wanted."""
        if self.given % self.together == 1 % self.together:  # the source asks for one before it begins
            if self.given > 1:
                self.come.release()
            if not self.wanted.acquire(timeout=60):
                raise SignalLost("nobody wants more")
            self.now_ns += self.together * SECOND_NS // 30
        self.given += 1
        return Shot(partial(np.zeros, (48, 64, 3), np.uint8), self.given * SECOND_NS // 30)


def test_frames_that_come_in_bursts_are_all_taken_at_the_times_of_their_stamps():
    """Over UDP through a radio two of three frames would be lost, and the others seem to stand and leap."""
    camera, times = Bursts(), []
    with LiveSource(
        camera, SourceSettings(size=lambda size: size, fps=30), clock=lambda: camera.now_ns
    ) as source:
        steps = source.steps(start_ns=0)
        for _ in range(6):
            assert camera.come.acquire(timeout=60), "three have come"
            while source.pending:
                times.append(next(steps).capture_ns)
            camera.wanted.release()
        camera.wanted.release(100)
    steady = times[-12:]
    assert len(times) >= 6 * 3 - 3
    assert all(abs(later - earlier - SECOND_NS // 30) < MS for earlier, later in pairwise(steady))


def test_one_frame_may_wait_beside_the_newest_and_no_second_one_soon():
    """A keyframe takes longer to code than two frames are apart; a machine that is too slow gains no delay."""
    camera, waiting = Bursts(together=1), []
    settings = SourceSettings(size=lambda size: size, fps=30)
    with LiveSource(camera, settings, clock=lambda: camera.now_ns) as source:
        for _ in range(6):
            camera.wanted.release()
            assert camera.come.acquire(timeout=60)
            waiting.append((source.pending, source.missed))
        camera.wanted.release(100)
    assert waiting == [(1, 0), (2, 0), (2, 1), (1, 3), (1, 4), (1, 5)]


def test_stamps_that_count_another_second_are_not_believed_for_long():
    """FFmpeg's 25 a second of a camera that makes 20: each minute would be twelve seconds behind."""
    clock = CameraClock()
    late = [
        now_ns - clock.capture_ns(number * SECOND_NS // 25, now_ns=now_ns)
        for number in range(2000)
        for now_ns in (SECOND_NS * 1000 + number * SECOND_NS // 20,)
    ]
    assert max(late) <= 2.1 * SECOND_NS


class Hangs(SaysItsTimeLater):
    """After its first picture it does not answer."""

    def grab(self) -> Shot:
        if self.given:
            self.ended.wait()
        return super().grab()


def test_a_camera_that_hangs_is_left_behind_with_one_sentence(monkeypatch, caplog):
    """Ctrl-C closes it, and so does the end of the flight: the log said it twice."""
    monkeypatch.setattr(live, "JOIN_S", 0.01)
    camera = Hangs()
    source = LiveSource(camera, SMALL, clock=lambda: camera.now_ns)
    source.close()
    source.close()
    camera.ended.set()
    assert caplog.text.count("is left behind") == 1
