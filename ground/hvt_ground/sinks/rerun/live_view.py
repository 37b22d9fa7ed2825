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
from collections.abc import Mapping, Sequence
from typing import Literal, Self

import rerun.blueprint as rrb
from rerun.chunk import Chunk

from hvt_common.errors import NotYetError, UserError
from hvt_ground.sinks.rerun.sdk import (
    RecordingId,
    new_recording,
    releasing_recordings,
    send_blueprint,
    viewer_environment,
    viewer_program,
)

_log = logging.getLogger(__name__)

_HOST = "127.0.0.1"
_START_S = 30.0
_MEMORY_LIMIT = "512MB"


class LiveView:
    """A viewer process of our own; ends with the context, except the native window, which its user closes.

    ``kind``: ``"spawn"`` opens the native viewer, ``"serve"`` the web viewer (at ``web_port``). Raises `NotYetError`
    where a port is in use by something else, and `UserError` where the viewer does not start. With ``later`` a port
    that is in use is said, and `start_again` starts the viewer once it is free.
    """

    def __init__(
        self,
        kind: Literal["spawn", "serve"],
        *,
        port: int = 9876,
        web_port: int = 9090,
        later: bool = False,
    ) -> None:
        self.kind = kind
        self.url = f"rerun+http://{_HOST}:{port}/proxy"
        self.page = (
            f"http://{_HOST}:{web_port}/?url={self.url.replace('+', '%2B')}" if kind == "serve" else ""
        )
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
                raise NotYetError(f"port {taken} of {_HOST} is in use: the viewer needs a free one")
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


class LiveRecording:
    """One recording in the viewer at ``url``. Raises `UserError` where that is not there, or no more."""

    path = None
    size_bytes = 0

    def __init__(
        self, url: str, recording_id: RecordingId, screen: rrb.Blueprint, chunks: Sequence[Chunk]
    ) -> None:
        self._url = url
        self._id = recording_id
        self._port = int(url.rsplit(":", 1)[1].split("/", maxsplit=1)[0])
        self._next_check_s = 0.0
        self._check()
        self._recording = new_recording(recording_id)
        self._recording.connect_grpc(url)
        self._recording.send_recording_name(recording_id.edge)
        send_blueprint(self._recording, recording_id, screen)
        self._recording.send_chunks(chunks)

    def write(self, chunks: Sequence[Chunk]) -> None:
        self._check()
        self._recording.send_chunks(chunks)

    def show(self, screen: rrb.Blueprint) -> None:
        send_blueprint(self._recording, self._id, screen)

    def compact(self, chunks: Sequence[Chunk]) -> None:
        """A viewer has them already."""

    def close(self, hurry: threading.Event | None) -> None:
        """Send the queue and disconnect."""
        try:
            if not (hurry and hurry.is_set()):
                self._recording.flush(timeout_sec=2.0)
        except (RuntimeError, ValueError, OSError) as error:
            raise UserError(f"live view at {self._url}: the last events were not sent: {error}") from error
        finally:
            with releasing_recordings():
                self._recording.disconnect()
                del self._recording

    def _check(self) -> None:
        # Look for the viewer once a second: the SDK would keep everything it cannot send, and slow every call.
        now_s = time.monotonic()
        if now_s < self._next_check_s:
            return
        self._next_check_s = now_s + 1.0
        if not listening(self._port):
            raise UserError(f"the viewer at {self._url} is gone")


def started_viewer(
    options: Sequence[str], *, port: int, needs: str, environment: Mapping[str, str] | None = None
) -> subprocess.Popen[bytes]:
    """The viewer's process, once it listens at ``port``; `UserError` with its ``needs`` if it never does."""
    process = subprocess.Popen(  # noqa: S603  # the SDK's own program, no shell
        [str(viewer_program()), "--bind", _HOST, "--port", str(port), *options],
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


def listening(port: int) -> bool:
    """Whether something accepts TCP connections at this port of loopback."""
    with socket.socket() as probe:
        probe.settimeout(0.2)
        return probe.connect_ex((_HOST, port)) == 0


def free_port() -> int:
    """A TCP port of loopback that nobody listens on at this moment."""
    with socket.socket() as probe:
        probe.bind((_HOST, 0))
        return int(probe.getsockname()[1])
