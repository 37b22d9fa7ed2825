"""An operator's requests from the page: a closer look, a keyframe, another budget or method."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from hvt_common.errors import UserError
from hvt_common.protocol.messages import Info
from hvt_ground.control import EdgeClient, RefusedError
from hvt_web.video.pictures import jpeg

_MOST_AT_ONCE = 4
_LEAST_SIDE_PX = 16
_STILL_S = 10.0


class BadRequestError(UserError):
    """It cannot be understood."""


class BusyError(UserError):
    """Too much is asked at once."""


class EdgeRequests:
    """Asks through the ground's own link; each call waits for its answer, a few at once. For any thread."""

    def __init__(self, client: Callable[[], EdgeClient]) -> None:
        self._client = client
        self._free = threading.BoundedSemaphore(_MOST_AT_ONCE)

    def request_still(self, edge: str, body: Mapping[str, Any]) -> tuple[bytes, dict[str, Any]]:
        """A still of ``box`` (x1, y1, x2, y2 in base pixels) at ``frame``, or at the newest: JPEG, and its place.

        Raises `BadRequestError`, `BusyError`, or the exceptions of `RemoteEdge.still`.
        """
        box, frame = _box(body.get("box")), _frame(body.get("frame"))
        with _one_of(self._free):
            remote = self._client()[edge]
            place = source_place(box, remote.info())
            try:
                still = remote.still(box=place, frame=frame, timeout_s=_STILL_S)
            except RefusedError:
                if frame is None:
                    raise
                # That frame may be gone: the newest is there.
                still = remote.still(box=place, timeout_s=_STILL_S)
        header = still.header
        data = still.data if header.codec == "jpeg" else jpeg(still.image_bgr, quality_pct=90)
        return data, {"frame": header.frame_index, "captureNs": str(header.capture_ns), "place": place}

    def keyframe(self, edge: str) -> None:
        """Have a picture coded that needs none before it."""
        with _one_of(self._free):
            self._client()[edge].keyframe()

    def set(self, edge: str, body: Mapping[str, Any]) -> None:
        """Set the total budget (``kbps``), from the next keyframe on, or who gets a still (``method``), at once."""
        match body:
            case {"kbps": int() | float() as kbps} if not isinstance(kbps, bool) and 1 <= kbps < 1e6:
                with _one_of(self._free):
                    self._client()[edge].set_budget(round(kbps * 1000))
            case {"method": str() as method} if 0 < len(method) <= 32:
                with _one_of(self._free):
                    self._client()[edge].set_method(method)
            case _:
                raise BadRequestError("give kbps, from 1 on, or method, such as M5")


@contextmanager
def _one_of(free: threading.BoundedSemaphore) -> Iterator[None]:
    if not free.acquire(blocking=False):
        raise BusyError(f"{_MOST_AT_ONCE} requests are under way: wait for one of them")
    try:
        yield
    finally:
        free.release()


def source_place(box_base_px: tuple[float, float, float, float], info: Info) -> tuple[int, int, int, int]:
    """x, y, width and height in source pixels, within the picture and not too small to show anything."""
    width, height = info.source_size
    x1, y1, x2, y2 = info.view.to_source(np.array([box_base_px], np.float32))[0].tolist()
    left, top = (
        min(max(0, math.floor(low)), side - _LEAST_SIDE_PX) for low, side in ((x1, width), (y1, height))
    )
    right = min(width, max(math.ceil(x2), left + _LEAST_SIDE_PX))
    bottom = min(height, max(math.ceil(y2), top + _LEAST_SIDE_PX))
    return left, top, right - left, bottom - top


def _box(given: object) -> tuple[float, float, float, float]:
    match given:
        case [int() | float() as x1, int() | float() as y1, int() | float() as x2, int() | float() as y2] if (
            all(abs(one) < 1e5 for one in (x1, y1, x2, y2)) and x1 < x2 and y1 < y2
        ):
            return float(x1), float(y1), float(x2), float(y2)
    raise BadRequestError("box is no [x1, y1, x2, y2] in pixels of the picture")


def _frame(given: object) -> int | None:
    if given is None or (isinstance(given, int) and not isinstance(given, bool) and 0 <= given < 2**62):
        return given
    raise BadRequestError("frame is no whole number")
