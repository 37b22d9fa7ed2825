"""Watching while it happens: the native viewer, or the web viewer, always bound to this machine only.

One viewer serves every recorder of a process: open it once, give its ``url`` to each `RecorderSettings`.
"""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal, Self

from hvt_common.errors import NotYetError, UserError
from hvt_ground.extras import Flight, Opening, Service
from hvt_ground.sinks.rerun.live_view import HOST, listening
from hvt_ground.sinks.rerun.recorder import Recorder, RecorderSettings
from hvt_ground.sinks.rerun.sdk import viewer_environment, viewer_program

_log = logging.getLogger(__name__)

_START_S = 30.0
_MEMORY_LIMIT = "512MB"
_LONGEST_PAUSE_S = 5.0
"""Before a failed live view is tried again."""


class LiveView:
    """A viewer process of our own; ends with the context, except the native window, which its user closes.

    ``kind``: ``"spawn"`` opens the native viewer, ``"serve"`` the web viewer (at ``web_port``). Raises `NotYetError`
    where a port is in use by something else, and `UserError` where the viewer does not start. With ``later`` a port
    that is in use is said, and `start_again` starts the viewer once it is free.
    """

    def __init__(
        self, kind: Literal["spawn", "serve"], *, port: int = 9876, web_port: int = 9090, later: bool = False
    ) -> None:
        self.kind = kind
        self.url = f"rerun+http://{HOST}:{port}/proxy"
        self.page = f"http://{HOST}:{web_port}/?url={self.url.replace('+', '%2B')}" if kind == "serve" else ""
        """The address for a browser; empty for the native viewer."""
        displays = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
        if kind == "spawn" and sys.platform == "linux" and not any(map(os.environ.get, displays)):
            raise UserError("--view needs a display and DISPLAY is not set: use --serve and a browser")
        self._port, self._web_port = port, web_port
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        try:
            self._process = self._start()
        except NotYetError as error:
            if not later:
                raise
            _log.warning("%s; all else goes on, and it is tried again with each edge", error)

    @property
    def pid(self) -> int:
        assert self._process is not None, "it waits for a port"
        return self._process.pid

    def start_again(self) -> None:
        """Start the web viewer where it has ended; a native window is its user's to open. Raises as at first."""
        with self._lock:
            if self._process is None or (self.kind == "serve" and self._process.poll() is not None):
                self._process = self._start()

    def _start(self) -> subprocess.Popen[bytes]:
        for taken in (self._port, self._web_port) if self.kind == "serve" else (self._port,):
            if listening(taken):
                raise NotYetError(f"port {taken} of {HOST} is in use: the viewer needs a free one")
        options = ["--server-memory-limit", _MEMORY_LIMIT]
        if self.kind == "serve":
            options += ["--serve-web", "--web-viewer-port", str(self._web_port)]
        else:
            options += ["--memory-limit", "50%", "--hide-welcome-screen"]
        return started_viewer(options, port=self._port, needs="a display for --view; try --serve")

    def close(self) -> None:
        """End the web viewer; leave a native window to its user."""
        if self.kind == "serve" and self._process is not None and self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(timeout=3)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Viewing(Service):
    """Shows each session in a `LiveView`, which it closes."""

    def __init__(self, kind: Literal["spawn", "serve"], *, later: bool) -> None:
        self.view = LiveView(kind, later=later)
        self.links = (self.view.page,) if self.view.page else ()

    def sinks(self, flight: Flight) -> Iterable[Opening]:
        part = f"live view of {flight.info.edge}"
        opens = partial(self._recorder, flight.recording)
        yield Opening(part, opens, waits=False, longest_pause_s=_LONGEST_PAUSE_S)

    def __exit__(self, *_: object) -> None:
        self.view.close()

    def _recorder(self, settings: RecorderSettings) -> Recorder:
        self.view.start_again()
        return Recorder(replace(settings, live_url=self.view.url))


def started_viewer(
    options: Sequence[str], *, port: int, needs: str, environment: Mapping[str, str] | None = None
) -> subprocess.Popen[bytes]:
    """The viewer's process, once it listens at ``port``; `UserError` with its ``needs`` if it never does."""
    process = subprocess.Popen(  # noqa: S603  # the SDK's own program, no shell
        [str(viewer_program()), "--bind", HOST, "--port", str(port), *options],
        env={**(environment or {}), **viewer_environment()},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is for us
    )
    deadline = time.monotonic() + _START_S
    while not listening(port):
        if process.poll() is not None or time.monotonic() > deadline:
            process.kill()
            process.wait()
            raise UserError(f"the Rerun viewer did not start ({viewer_program()}): it needs {needs}")
        time.sleep(0.05)
    return process


def free_port() -> int:
    """A TCP port of loopback that nobody listens on at this moment."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])
