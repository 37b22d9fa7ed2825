"""A V4L2 camera, of which OpenCV is a stand-in here."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from hvt_edge.source import camera
from hvt_edge.source.camera import CameraGrabber

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


@pytest.mark.parametrize("raw", [LEVELS, LEVELS.view(np.uint8).reshape(1, -1)], ids=["levels", "bytes"])
def test_a_warm_body_is_seen_by_a_thermal_camera(monkeypatch, tmp_path, raw):
    """It would be one level of 255 above the rest: nobody sees it, and no network."""
    monkeypatch.setattr(camera, "opened_capture", lambda _number: Thermal(raw))
    monkeypatch.setattr(camera.stat, "S_ISCHR", lambda _mode: True)
    (tmp_path / "video0").touch()
    grabber = CameraGrabber(str(tmp_path / "video0"), fps=9)
    grabber.open()
    picture = grabber.grab().image()
    assert picture.shape == (48, 64, 3)
    assert int(picture[25, 25, 0]) - int(picture[5, 5, 0]) > 200
    (said,) = grabber.notes.taken()
    assert said.startswith(
        "its 16-bit grey is a sensor's: levels 29900 to 30200 are stretched to black and white"
    )
