"""A V4L2 camera, of which OpenCV is a stand-in here."""

from __future__ import annotations

import time

import cv2
import numpy as np
import pytest

from hvt_common.runtime.clock import SteadyClock
from hvt_edge.source import camera
from hvt_edge.source.camera import CameraGrabber
from hvt_edge.source.live import CameraClock

LEVELS = np.full((48, 64), 29_900, np.uint16)
LEVELS[20:30, 20:30] = 30_200
"""A warm body: both are 116 or 117 of 255 in the upper eight bits."""


class Thermal:
    """Gives 16-bit grey as the levels, or as their bytes, unless it is to convert them."""

    def __init__(self, raw: np.ndarray) -> None:
        self.raw = raw
        self.properties = {cv2.CAP_PROP_FOURCC: float(cv2.VideoWriter.fourcc(*"Y16 "))}
        self.properties |= {cv2.CAP_PROP_FRAME_WIDTH: 64.0, cv2.CAP_PROP_FRAME_HEIGHT: 48.0}

    def isOpened(self) -> bool:  # noqa: N802 - OpenCV's name
        """It is."""
        return True

    def set(self, name: int, value: float) -> bool:
        """It takes conversion alone."""
        self.properties |= {name: value} if name == cv2.CAP_PROP_CONVERT_RGB else {}
        return True

    def get(self, name: int) -> float:
        """As it was set."""
        return self.properties.get(name, 0.0)

    def grab(self) -> bool:
        """There is a frame."""
        return True

    def retrieve(self) -> tuple[bool, np.ndarray]:
        """As OpenCV does."""
        converts = self.properties.get(cv2.CAP_PROP_CONVERT_RGB, 1.0)
        return True, cv2.cvtColor(
            (LEVELS >> 8).astype(np.uint8), cv2.COLOR_GRAY2BGR
        ) if converts else self.raw


def stand_in(monkeypatch, tmp_path, capture):
    """The device that OpenCV opens, where it may be as slow as is asked of it."""

    def opened(_number, *, read_s):
        assert read_s == 4, "two frames of half a frame a second"
        return capture

    monkeypatch.setattr(camera, "opened_capture", opened)
    monkeypatch.setattr(camera.stat, "S_ISCHR", lambda _mode: True)
    (tmp_path / "video0").touch()


@pytest.mark.parametrize("raw", [LEVELS, LEVELS.view(np.uint8).reshape(1, -1)], ids=["levels", "bytes"])
def test_a_warm_body_is_seen_by_a_thermal_camera(monkeypatch, tmp_path, raw):
    """It would be one level of 255 above the rest: nobody sees it, and no network."""
    stand_in(monkeypatch, tmp_path, Thermal(raw))
    grabber = CameraGrabber(str(tmp_path / "video0"), fps=0.5, clock=SteadyClock())
    grabber.open()
    picture = grabber.grab().image()
    assert picture.shape == (48, 64, 3)
    assert int(picture[25, 25, 0]) - int(picture[5, 5, 0]) > 200
    (said,) = grabber.notes.taken()
    assert said.startswith(
        "its 16-bit grey is a sensor's: levels 29900 to 30200 are stretched to black and white"
    )


def test_a_clock_that_was_set_back_makes_no_picture_old(monkeypatch, tmp_path):
    """Every picture of a camera that is opened after it would be as old as the step, for the rest of the flight."""
    clock = SteadyClock(
        wall_ns=lambda: time.time_ns() + 3 * 10**9
    )  # set back by three seconds since the start
    thermal = Thermal(LEVELS)
    stand_in(monkeypatch, tmp_path, thermal)
    grabber = CameraGrabber(str(tmp_path / "video0"), fps=0.5, clock=clock)
    grabber.open()
    taken_ns = clock()
    thermal.properties[cv2.CAP_PROP_POS_MSEC] = time.monotonic_ns() / 1e6
    camera_ns = grabber.grab().camera_ns
    assert camera_ns is not None
    assert abs(CameraClock().capture_ns(camera_ns, now_ns=clock()) - taken_ns) < 10**9
