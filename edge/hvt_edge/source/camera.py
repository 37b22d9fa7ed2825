"""A V4L2 camera through OpenCV."""

from __future__ import annotations

import math
import os
import re
import stat
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.errors import NotYetError, UserError, named_path
from hvt_common.values import Image
from hvt_edge.source.contract import Notes
from hvt_edge.source.decoding.pictures import Stretch
from hvt_edge.source.live import Shot, SignalLost, patience_s

_REQUESTED_SIZE = (1920, 1080)
"""Requested of the camera, which takes the nearest it has. Stills use the pixels beyond the base size."""

_Y16 = cv2.VideoWriter.fourcc(*"Y16 ")


class CameraGrabber:
    """One V4L2 device: ``path`` is /dev/videoN, ``fps`` is requested of the camera.

    ``clock`` is the clock of the source's other times: a wall clock that was set since would give another time.
    """

    def __init__(self, path: str, *, fps: float, clock: Callable[[], int]) -> None:
        self.name = path
        self.notes = Notes(path)
        self._deep = False
        """The camera gives sixteen bits of grey."""
        self._stretch = Stretch(self.notes)
        self._fps = fps
        self._clock = clock
        self._capture: cv2.VideoCapture | None = None

    def open(self) -> None:
        """Open the device. Raises `UserError` if it is missing, no camera, busy or not permitted."""
        path = named_path(self.name, name="camera")
        if not path.exists():
            found = ", ".join(sorted(str(one) for one in Path("/dev").glob("video*"))) or "none"
            raise NotYetError(f"camera {self.name} does not exist; devices here: {found}")
        # By number: a name like /dev/v4l/by-id/… is a link to it, and OpenCV takes a negative one for "any camera".
        number = re.fullmatch(r"video(\d+)", path.resolve().name)
        if number is None or not stat.S_ISCHR(path.stat().st_mode):
            raise UserError(f"camera {self.name} is no video device; accepted is /dev/videoN")
        capture = opened_capture(int(number[1]), read_s=patience_s(self._fps))
        if not capture.isOpened():
            kind = NotYetError if os.access(path, os.R_OK | os.W_OK) else UserError
            raise kind(f"camera {self.name} cannot be opened: it is no V4L2 camera, in use, or not permitted")
        # Uncompressed 1080p does not fit USB 2; a camera without MJPEG keeps its own format.
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, _REQUESTED_SIZE[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, _REQUESTED_SIZE[1])
        capture.set(cv2.CAP_PROP_FPS, self._fps)
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        # OpenCV would keep the upper eight of sixteen bits, in which a warm body is one level above the background.
        self._deep = round(capture.get(cv2.CAP_PROP_FOURCC)) == _Y16
        if self._deep:
            capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        self._capture = capture

    def restart(self) -> None:
        self.close()
        self.open()

    def grab(self) -> Shot:
        """The next frame, at most the read timeout from now, with the driver's time stamp of its buffer."""
        capture = self._capture
        if capture is None or not capture.grab():
            raise SignalLost("the camera delivers no frame")

        def image() -> Image:
            decoded, image = capture.retrieve()
            if not decoded:
                raise SignalLost("the camera's frame cannot be decoded")
            if not self._deep:
                return np.asarray(image, np.uint8)
            shape = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)), int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
            return self._stretch.bgr(_levels(image, shape), at_s=time.monotonic())

        # The driver stamps buffers by the monotonic clock, which stops while the machine sleeps; or not at all: 0.
        buffer_ms, ahead_ns = capture.get(cv2.CAP_PROP_POS_MSEC), self._clock() - time.monotonic_ns()
        return Shot(image, ahead_ns + round(buffer_ms * 1e6) if buffer_ms > 0 else None)

    def close(self) -> None:
        if self._capture is not None:
            self._capture.release()
            self._capture = None


def _levels(raw: npt.NDArray[Any], shape: tuple[int, int]) -> npt.NDArray[np.uint16]:
    # Sixteen-bit levels from OpenCV's unconverted frame: the levels, or their bytes in a row.
    count = 2 * math.prod(shape)
    data = np.ascontiguousarray(raw).view(np.uint8).reshape(-1)
    if data.size < count:
        raise SignalLost("the camera's frame is cut off")
    return data[:count].view("<u2").astype(np.uint16, copy=False).reshape(shape)


def opened_capture(number: int, *, read_s: float) -> cv2.VideoCapture:
    """The capture, opened or not, without OpenCV's own lines on stderr."""
    read_ms = round(1000 * read_s)
    timeouts = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 5000, cv2.CAP_PROP_READ_TIMEOUT_MSEC, read_ms]
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return cv2.VideoCapture(number, cv2.CAP_V4L2, timeouts)
    finally:
        cv2.utils.logging.setLogLevel(level)
