"""A live camera: what its frames' times mean, and what happens when it goes away."""

import threading
import time
from dataclasses import replace
from functools import partial
from itertools import pairwise
from unittest import mock

import cv2
import numpy as np
import pytest

from hvt_common.errors import NotYetError
from hvt_common.runtime.clock import SteadyClock
from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS
from hvt_edge.source import camera as camera_module
from hvt_edge.source import live
from hvt_edge.source.camera import CameraGrabber
from hvt_edge.source.contract import SourceSettings
from hvt_edge.source.live import CameraClock, LiveSource, Shot, SignalLost
from hvt_edge.source.opening import open_source
from hvt_edge.source.resample import Gate
from programs.rtsp_camera import RtspCamera

MS = 1_000_000

SMALL = SourceSettings(size=(64, 64), fps=25)


@pytest.fixture
def quick(monkeypatch):
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


@pytest.mark.parametrize(
    ("fps", "stall_s", "again_s", "held_s"),
    [(30, 4, 4.0, 1.3), (30, 4, 5.2, 1.3), (0.8, 4, 5.0, 1.3), (30, 12, 12.0, 8.0), (0.8, 12, 12.5, 3.0)],
)
def test_frames_that_a_network_held_back_are_as_old_as_they_are(fps, stall_s, again_s, held_s):
    """Boxes of before a stall would lie where the camera looked behind it, and old pictures be called live."""
    clock, zero = CameraClock(), 1_000_000 * SECOND_NS
    for number in range(
        int(40 * fps)
    ):  # those of the stall and later come late at first, at twice their rate
        taken_ns = int(number * SECOND_NS / fps)
        late_ns = max(0, int(held_s * SECOND_NS) - (taken_ns - int(again_s * SECOND_NS)) // 2)
        if not stall_s <= taken_ns / SECOND_NS < again_s:  # the camera dropped these
            come_ns = zero + taken_ns + (late_ns if taken_ns >= stall_s * SECOND_NS else 0)
            assert clock.capture_ns(taken_ns, now_ns=come_ns) == zero + taken_ns


def test_a_camera_whose_stamps_stood_still_is_not_old_for_ever():
    """Its encoder paused and goes on to number its frames: each later picture would be as old as the pause."""
    clock, zero = CameraClock(), 1_000_000 * SECOND_NS
    for number in range(30 * 10):  # its clock is fast, and its frames come unevenly
        now_ns = zero + number * SECOND_NS // 10 + number % 3 * 5 * MS + (number >= 150) * 3 * SECOND_NS
        at_ns = clock.capture_ns(number * 100_050_000, now_ns=now_ns)
    assert now_ns - at_ns < SECOND_NS // 5


@pytest.mark.parametrize("slower", [2, 5])
def test_a_camera_that_goes_on_at_a_lower_rate_than_it_stamps_is_not_old(slower):
    """An encoder that numbers frames, of a camera that takes fewer in the dark: pictures were called 10 s old."""
    clock, now_ns, late_ns = CameraClock(), 1_000_000 * SECOND_NS, 0
    for number in range(1000):
        now_ns += SECOND_NS // 25 * (slower if number > 500 else 1)
        late_ns = max(late_ns, now_ns - clock.capture_ns(number * SECOND_NS // 25, now_ns=now_ns))
    assert late_ns < 2.2 * SECOND_NS


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


class Camera:
    """A device that is always there; ``given`` counts its shots, ``now_ns`` is its time."""

    name, notes = "cam", None

    def __init__(self) -> None:
        self.now_ns, self.given, self.ended = 1_000_000 * SECOND_NS, 0, threading.Event()

    def open(self) -> None:
        """It is open."""

    restart = close = open  # noqa: A003 - the method above

    def shot(self, at_ns: int | None = None) -> Shot:
        return Shot(partial(np.zeros, (48, 64, 3), np.uint8), at_ns)

    def grab(self) -> Shot:
        return self.shot()


class SaysItsTimeLater(Camera):
    """It says no time until it is opened again, and then that each of its frames is four seconds old."""

    def grab(self) -> Shot:
        if self.given == 60:
            self.ended.set()
            raise SignalLost("it is gone")
        self.given, self.now_ns = self.given + 1, self.now_ns + SECOND_NS // 5
        if self.given == 10:
            raise SignalLost("it went away")
        return self.shot(self.now_ns - 4 * SECOND_NS if self.given > 10 else None)


def test_a_camera_that_was_away_and_says_other_times_stops_no_picture(quick):
    """No frame would be due for four seconds, and units that are passed through would go back in time."""
    camera = SaysItsTimeLater()
    with LiveSource(camera, SMALL, clock=lambda: camera.now_ns) as source:
        assert camera.ended.wait(60)
        assert source.passed_over == 0
        (*_, newest) = (next(source.steps(start_ns=0)) for _ in range(source.pending))
    assert camera.now_ns - newest.capture_ns == 4 * SECOND_NS, "it has come to what the camera says"


class HeldBack(SaysItsTimeLater):
    """It counts from its own start; after 20 s its connection breaks, and the frames of 3 s come at once."""

    def grab(self) -> Shot:
        if self.given == 114:
            self.ended.set()
            raise SignalLost("it is gone")
        self.given += 1
        if self.given == 101:
            self.now_ns += 3 * SECOND_NS
            raise SignalLost("it went away")
        self.now_ns += SECOND_NS // 5 if self.given <= 100 else 0
        return self.shot(self.given * SECOND_NS // 5)


def test_frames_that_came_only_with_a_new_connection_are_as_old_as_they_are(quick):
    """The ground would show pictures of seconds ago as live, right after each gap."""
    camera = HeldBack()
    with LiveSource(camera, SMALL, clock=lambda: camera.now_ns) as source:
        assert camera.ended.wait(60)
        (*_, newest) = (next(source.steps(start_ns=0)) for _ in range(source.pending))
    assert camera.now_ns - newest.capture_ns == SECOND_NS // 5


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


def broken():
    raise ValueError("no such layout")


class Faulty(Camera):
    """Its second shot raises ``ValueError``, at once or ``late`` with its picture; each second opening fails too."""

    def __init__(self, *, late: bool) -> None:
        super().__init__()
        self.late, self.restarts = late, 0

    def restart(self) -> None:
        self.restarts += 1
        if self.restarts % 2:
            raise RuntimeError("the driver is not ready")

    def grab(self) -> Shot:
        self.given += 1
        if self.given == 2:
            return Shot(broken if self.late else broken())
        time.sleep(0.02)
        return self.shot()


@pytest.mark.parametrize("late", [False, True])
def test_an_error_that_nobody_expects_of_a_camera_costs_its_pictures_alone(caplog, quick, late):
    """One odd frame of a driver or a decoder would end the flight."""
    camera, failures, waits = Faulty(late=late), Failures(time.time_ns), []
    with LiveSource(camera, SMALL, failures=failures) as source:
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
    camera = Camera()
    camera.grab = lambda: Shot(broken)
    says = r"cam opens but delivers no picture \(ValueError: no such layout\)"
    with pytest.raises(NotYetError, match=says):
        LiveSource(camera, SMALL)


class Bursts(Camera):
    """Its frames, 30 a second by its stamps, come so many at a time, once the first of them is wanted."""

    def __init__(self, together: int = 3) -> None:
        super().__init__()
        self.together = together
        self.come, self.wanted = threading.Semaphore(0), threading.Semaphore(1)

    def grab(self) -> Shot:
        if self.given % self.together == 1 % self.together:  # the source asks for one before it begins
            if self.given > 1:
                self.come.release()
            if not self.wanted.acquire(timeout=60):
                raise SignalLost("nobody wants more")
            self.now_ns += self.together * SECOND_NS // 30
        self.given += 1
        return self.shot(self.given * SECOND_NS // 30)


def test_frames_that_come_in_bursts_are_all_taken_at_the_times_of_their_stamps():
    """Over UDP through a radio two of three frames would be lost, and the others seem to stand and leap."""
    camera, times = Bursts(), []
    with LiveSource(camera, replace(SMALL, fps=30), clock=lambda: camera.now_ns) as source:
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
    with LiveSource(camera, replace(SMALL, fps=30), clock=lambda: camera.now_ns) as source:
        for _ in range(6):
            camera.wanted.release()
            assert camera.come.acquire(timeout=60)
            waiting.append((source.pending, source.missed))
        camera.wanted.release(100)
    assert waiting == [(1, 0), (2, 0), (2, 1), (1, 3), (1, 4), (1, 5)]


@pytest.mark.parametrize(("fps", "stamps"), [(20, 25), (5, 25), (1, 25), (25, 10**6)])
def test_stamps_that_count_another_second_are_not_believed_for_long(fps, stamps):
    """FFmpeg's 25 a second of a camera that makes 20 or 5: each minute would be twelve seconds behind.

    Stamps of 5 frames that rise by the 25th part of a second, or stand still, also lost every second frame.
    """
    clock, gate, late, taken = CameraClock(), Gate(15), [], 0
    for number in range(300 * fps):
        now_ns = SECOND_NS * 1000 + number * SECOND_NS // fps
        at_ns = clock.capture_ns(number * SECOND_NS // stamps, now_ns=now_ns)
        late.append(now_ns - at_ns)
        taken += gate.accept(at_ns)
    assert max(late) <= 2.1 * SECOND_NS
    assert taken >= 0.95 * 300 * min(fps, 15)


def test_a_network_that_holds_frames_back_now_and_then_costs_none():
    """From the third such time on its stamps counted for nothing for a minute, and bursts lost most of a picture."""
    clock, gate, lost = CameraClock(), Gate(25), []
    now_ns = 0
    for number in range(25 * 1500):
        at_s = number / 25
        queued_s = max(0.0, min(at_s % 300 - 200, 25) * 0.1 - max(0.0, at_s % 300 - 245) * 0.8)
        now_ns = max(now_ns + 1, round((1000 + at_s + queued_s + 0.2 - at_s % 0.2) * SECOND_NS))
        at_ns = clock.capture_ns(round(at_s * SECOND_NS), now_ns=now_ns)
        lost += [] if gate.accept(at_ns) else [at_s]
    assert len(lost) < 0.01 * 25 * 1500


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


LEVELS = np.full((48, 64), 29_900, np.uint16)
LEVELS[20:30, 20:30] = 30_200
"""A warm body: both are 116 or 117 of 255 in the upper eight bits."""


@pytest.fixture
def thermal(monkeypatch, tmp_path):
    """The properties of a V4L2 camera of 16-bit grey, for which OpenCV is a stand-in, and its grabber's maker."""
    given = {cv2.CAP_PROP_FOURCC: cv2.VideoWriter.fourcc(*"Y16 "), cv2.CAP_PROP_CONVERT_RGB: 1}
    given |= {cv2.CAP_PROP_FRAME_WIDTH: 64, cv2.CAP_PROP_FRAME_HEIGHT: 48, "raw": LEVELS}

    def retrieve():
        eight = cv2.cvtColor((LEVELS >> 8).astype(np.uint8), cv2.COLOR_GRAY2BGR)
        return True, eight if given[cv2.CAP_PROP_CONVERT_RGB] else given["raw"]

    def opened(_number, *, read_s):
        assert read_s == 4, "two frames of half a frame a second"
        capture = mock.Mock(get=lambda name: given.get(name, 0), retrieve=retrieve)
        capture.set = lambda name, value: given.update(
            {name: value} if name == cv2.CAP_PROP_CONVERT_RGB else {}
        )
        return capture

    def grabber(clock) -> CameraGrabber:
        made = CameraGrabber(str(tmp_path / "video0"), fps=0.5, clock=clock)
        made.open()
        return made

    monkeypatch.setattr(camera_module, "opened_capture", opened)
    monkeypatch.setattr(camera_module.stat, "S_ISCHR", lambda _mode: True)
    (tmp_path / "video0").touch()
    return given, grabber


@pytest.mark.parametrize("raw", [LEVELS, LEVELS.view(np.uint8).reshape(1, -1)], ids=["levels", "bytes"])
def test_a_warm_body_is_seen_by_a_thermal_camera(thermal, raw):
    """It would be one level of 255 above the rest: nobody sees it, and no network."""
    given, grabber_of = thermal
    given["raw"], grabber = raw, grabber_of(SteadyClock())
    picture = grabber.grab().image()
    assert picture.shape == (48, 64, 3)
    assert int(picture[25, 25, 0]) - int(picture[5, 5, 0]) > 200
    (said,) = grabber.notes.taken()
    assert said.startswith(
        "its 16-bit grey is a sensor's: levels 29900 to 30200 are stretched to black and white"
    )


def test_a_clock_that_was_set_back_makes_no_picture_old(thermal):
    """Every picture of a camera that is opened after it would be as old as the step, for the rest of the flight."""
    given, grabber_of = thermal
    clock = SteadyClock(wall_ns=lambda: time.time_ns() + 3 * SECOND_NS)  # set back since the start
    grabber, taken_ns = grabber_of(clock), clock()
    given[cv2.CAP_PROP_POS_MSEC] = time.monotonic_ns() / 1e6
    camera_ns = grabber.grab().camera_ns
    assert camera_ns is not None
    assert abs(CameraClock().capture_ns(camera_ns, now_ns=clock()) - taken_ns) < SECOND_NS
