"""An edge whose frames come from the program that it is a part of: `hvt_edge.open`.

It is the edge of ``hvt-edge`` with another source. As with a camera, a new frame replaces an earlier one that was not
taken yet.
"""

from __future__ import annotations

import operator
import threading
from typing import Any, Self, cast

import numpy as np

from hvt_common.config import load, settings_words
from hvt_common.errors import FlightError, UserError
from hvt_common.runtime.failures import RetryPause
from hvt_common.values import Fit, Image
from hvt_edge.app import Edge
from hvt_edge.config import EdgeConfig, check, with_profile
from hvt_edge.source.contract import Source, SourceSettings
from hvt_edge.source.live import LiveSource, Shot, SignalLost
from hvt_edge.wiring import base_size
from hvt_edge.world import World
from hvt_library.program import InThread

_NAME = "pushed frames"
PATIENCE_S = 5.0
"""A program that pushes nothing for this long, and for two frames, is reported as away, as a camera is."""


def open_edge(**settings: object) -> PushedEdge:
    """An edge with the settings of ``hvt-edge`` (docs/options.md), such as ``connect="tcp/10.0.0.1:7447"``.

    Names have underscores for dashes; a setting that may be repeated takes a list, and a switch True or False.
    Raises `UserError` where a setting is unknown or wrong.
    """
    if "source" in settings:
        raise UserError(f"source {settings['source']!r} is not accepted: frames are pushed")
    words = settings_words({"quiet": True, **settings, "source": _NAME})
    config, given = load(EdgeConfig, words, program="hvt_edge.open", description="")
    if config.pace != "realtime":
        raise UserError(f"pace {config.pace!r} is not accepted: pushed frames come in real time")
    return PushedEdge(check(with_profile(config, given=given.values)))


class PushedEdge:
    """Sends pushed frames until it is closed; use it with ``with``. For any thread.

    Its ``summary`` is the content of ``--summary``; empty before the end.
    """

    def __init__(self, config: EdgeConfig) -> None:
        self._grabber = _PushGrabber(fps=config.nominal_fps)
        self._stop = threading.Event()
        world = _PushedWorld(self._grabber)
        self._clock = world.clock
        self._edge = Edge(config, stop=self._stop, world=world)
        self._flight = InThread(self._run, stop=self._cancel, name="hvt-edge")

    @property
    def summary(self) -> dict[str, Any]:
        return self._flight.summary or {}

    def push(self, frame_bgr: Image, *, capture_ns: int | None = None) -> None:
        """Hand over a frame: (height, width, 3) uint8 BGR, copied. The first one sets the source's size.

        ``capture_ns`` is its capture time, Unix nanoseconds, a whole number; None is now. Raises `ValueError` for
        another array or time, `UserError` or `FlightError` if that has ended the edge, and `FlightError` after
        its end.
        """
        taken_ns = self._clock() if capture_ns is None else _nanoseconds(capture_ns)
        if not isinstance(frame_bgr, np.ndarray):
            raise ValueError(f"{frame_bgr!r:.40} is no frame: an array of uint8, (height, width, 3), is")  # noqa: TRY004
        if (
            frame_bgr.dtype != np.uint8
            or frame_bgr.ndim != 3
            or frame_bgr.shape[2] != 3
            or not frame_bgr.size
        ):
            raise ValueError(
                f"a frame of {frame_bgr.dtype} {frame_bgr.shape} is not accepted: (height, width, 3) uint8 is"
            )
        self._flight.raise_error()
        if self._stop.is_set() or not self._flight.thread.is_alive():
            raise FlightError("the edge has ended: it sends no more frames")
        self._grabber.put(frame_bgr.copy(), taken_ns)

    def close(self) -> None:
        """Send the rest, say goodbye, and wait for the end; raises the error that ended the edge before."""
        self._flight.end()
        self._flight.raise_error()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_error: object) -> None:
        try:
            self.close()
        except Exception:
            if kind is None:  # else the program's own error goes first
                raise

    def _cancel(self) -> None:
        self._stop.set()
        self._grabber.begin_closing()

    def _run(self) -> dict[str, Any]:
        try:
            return self._edge.run()
        except _NothingPushed:
            return {}


def _nanoseconds(capture_ns: int) -> int:
    try:
        taken_ns = operator.index(capture_ns)
    except TypeError:
        taken_ns = -1
    if not 0 <= taken_ns < 1 << 63:
        raise ValueError(f"capture_ns {capture_ns!r} is not accepted: whole nanoseconds of Unix time are")
    return taken_ns


class _NothingPushed(Exception):  # noqa: N818 - an event
    """It was closed before the first frame."""


class _PushGrabber:
    name = _NAME
    notes = None

    def __init__(self, *, fps: float) -> None:
        self._patience_s = max(PATIENCE_S, 2 / fps)
        self._news = threading.Condition()
        self._newest: tuple[Image, int] | None = None
        self._replaced = 0
        self._opened = self._closing = self._ended = False

    def put(self, frame_bgr: Image, capture_ns: int) -> None:
        with self._news:
            self._replaced += self._newest is not None
            self._newest = frame_bgr, capture_ns
            self._news.notify_all()

    def end(self) -> None:
        with self._news:
            self._ended = True
            self._news.notify_all()

    def begin_closing(self) -> None:
        """From now on no frame is missed; who waits for the first one is told."""
        with self._news:
            self._closing = True
            self._ended |= not self._opened
            self._news.notify_all()

    def open(self) -> None:
        """Wait for the first frame."""
        with self._news:
            self._news.wait_for(lambda: self._newest or self._ended)
            if self._newest is None:
                raise _NothingPushed
            self._opened = True

    def restart(self) -> None:
        """Wait for the next frame: there is nothing to try again meanwhile."""
        with self._news:
            self._news.wait_for(lambda: self._newest or self._ended)
            if self._newest is None:
                raise SignalLost("no frame is pushed")

    def grab(self) -> Shot:
        with self._news:
            if (
                not self._news.wait_for(lambda: self._newest or self._ended, self._patience_s)
                and self._closing
            ):
                self._news.wait_for(lambda: self._newest or self._ended)
            if self._newest is None:
                reason = f"no frame was pushed for {self._patience_s:.3g} s"
                raise SignalLost("it is closed" if self._ended else reason)
            (frame_bgr, capture_ns), self._newest = self._newest, None
            replaced, self._replaced = self._replaced, 0
        return Shot(lambda: frame_bgr, camera_ns=capture_ns, missed=replaced)

    def close(self) -> None:
        """There is no device."""


class _PushedSource(LiveSource):
    def __init__(self, grabber: _PushGrabber, config: EdgeConfig, world: World) -> None:
        settings = SourceSettings(
            size=base_size(config),
            fps=config.nominal_fps,
            fit=cast("Fit", config.fit),
            max_frames=config.max_frames,
        )
        super().__init__(grabber, settings, clock=world.clock, failures=world.failures)
        self._pushed = grabber
        self._pause = RetryPause(0, 0)  # a program that pushes again is there at once

    def close(self) -> None:
        self._end()
        self._pushed.end()
        super().close()


class _PushedWorld(World):
    def __init__(self, grabber: _PushGrabber) -> None:
        super().__init__()
        self._grabber = grabber

    def open_source(self, config: EdgeConfig) -> Source:
        return _PushedSource(self._grabber, config, self)
