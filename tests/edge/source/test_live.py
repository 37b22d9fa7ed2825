"""A live camera: what its frames' times mean, and what happens when it goes away."""

from __future__ import annotations

import time
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS
from hvt_edge.source.camera_clock import CameraClock
from hvt_edge.source.live import LiveSource, Shot
from hvt_edge.source.opening import open_source
from programs.rtsp_camera import RtspCamera

MS = 1_000_000


def taken(camera: RtspCamera, *, count: int) -> list[tuple[int, int]]:
    """(age at arrival, capture time) of so many frames, ns."""
    frames = []
    with open_source(camera.url, size=(320, 240), fps=25) as source:
        for frame in source.frames(start_ns=0):
            frames.append((time.time_ns() - frame.capture_ns, frame.capture_ns))
            if len(frames) == count:
                break
    return frames


@pytest.mark.timeout(60)
def test_a_frame_has_the_time_that_the_camera_says_by_rtcp(free_port):
    """The delay of camera and network would be missing from every latency that the ground shows."""
    with RtspCamera(free_port, delay_s=0.3) as camera:
        ages = [age for age, _ in taken(camera, count=8)]
    assert min(ages) >= 300 * MS


@pytest.mark.timeout(60)
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


@pytest.mark.timeout(120)
def test_a_camera_that_goes_away_is_told_of_and_comes_back(free_port, caplog):
    """A loose cable would end the flight, or nobody learn why the picture stands still."""
    failures = Failures(time.time_ns)
    first, camera, indices, waits = RtspCamera(free_port), None, [], 0
    try:
        with open_source(first.url, size=(320, 240), fps=25, failures=failures) as source:
            for frame in source.steps(start_ns=0):
                if frame is None:
                    waits += 1
                    assert not failures.parts[0].working
                else:
                    indices.append(frame.index)
                if len(indices) == 10 and not failures.parts:
                    first.close()
                if waits == 2 and camera is None:
                    camera = RtspCamera(free_port)
                if len(indices) > 40:
                    break
            assert source.restarts == 1
    finally:
        first.close()
        if camera is not None:
            camera.close()
    (failed,) = failures.parts
    assert (failed.part, failed.working) == ("source", True)
    assert failed.count >= 2, "it was tried in vain while the camera was away"
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


@pytest.mark.timeout(60)
@pytest.mark.parametrize("where", ["grab", "picture"])
def test_an_error_that_nobody_expects_of_a_camera_costs_its_pictures_alone(monkeypatch, caplog, where):
    """One odd frame of a driver or a decoder would end the flight."""
    camera, failures, waits = Faulty(ValueError("no such layout")), Failures(time.time_ns), []
    if where == "picture":
        monkeypatch.setattr(camera, "grab", raising_pictures(camera.grab))
    with LiveSource(camera, size=lambda size: size, fps=25, fit="letterbox", failures=failures) as source:
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
