"""Watching while it happens: the native viewer, or the web viewer, always bound to this machine only.

One viewer serves every recorder of a process: open it once, give its ``url`` to each `RecorderSettings`.
"""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from types import TracebackType
from typing import Literal, Self

import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import Chunk

from hvt_common.errors import UserError
from hvt_ground.sinks.rerun.sdk import new_recording, send_blueprint, viewer_environment, viewer_program

__all__ = ["LiveRecording", "LiveView", "free_port", "listening"]

log = logging.getLogger(__name__)

_HOST = "127.0.0.1"
_START_S = 15.0
_MEMORY_LIMIT = "512MB"


class LiveView:
    """A viewer process of our own; ends with the context, except the native window, which its user closes.

    ``kind``: ``"spawn"`` opens the native viewer, ``"serve"`` the web viewer (at ``web_port``). Raises `UserError`
    where a port is in use by something else, or the viewer does not start.
    """

    def __init__(self, kind: Literal["spawn", "serve"], *, port: int = 9876, web_port: int = 9090) -> None:
        self.kind = kind
        self.url = f"rerun+http://{_HOST}:{port}/proxy"
        self.page = (
            f"http://{_HOST}:{web_port}/?url=rerun%2Bhttp://{_HOST}:{port}/proxy" if kind == "serve" else ""
        )
        """What to open in a browser; empty for the native viewer."""
        if kind == "spawn" and sys.platform == "linux" and not _display():
            raise UserError("--view needs a display and DISPLAY is not set: use --serve and a browser")
        for taken in (port, web_port) if kind == "serve" else (port,):
            if listening(taken):
                raise UserError(f"port {taken} of {_HOST} is in use: the viewer needs a free one")
        command = [
            str(viewer_program()),
            "--bind",
            _HOST,
            "--port",
            str(port),
            "--server-memory-limit",
            _MEMORY_LIMIT,
        ]
        if kind == "serve":
            command += ["--serve-web", "--web-viewer-port", str(web_port)]
        else:
            command += ["--memory-limit", "50%", "--hide-welcome-screen"]
        self._process = subprocess.Popen(  # noqa: S603  # the SDK's own program, no shell
            command,
            env=viewer_environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for us
        )
        self._wait_until_listening(port)

    def close(self) -> None:
        """End the web viewer; leave a native window to its user."""
        if self.kind == "serve" and self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(timeout=3)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _wait_until_listening(self, port: int) -> None:
        deadline = time.monotonic() + _START_S
        while not listening(port):
            if self._process.poll() is not None or time.monotonic() > deadline:
                self._process.kill()
                raise UserError(
                    f"the Rerun viewer did not start ({viewer_program()}): it needs a display for --view; try --serve"
                )
            time.sleep(0.05)


class LiveRecording:
    """One recording in a viewer. Trouble there costs one warning, then nothing is sent any more."""

    live = True
    size_bytes = 0

    def __init__(self, url: str, *, recording_id: str, name: str) -> None:
        self._url = url
        self._port = int(url.rsplit(":", 1)[1].split("/", maxsplit=1)[0])
        self._next_check_s = 0.0
        self._recording: rr.RecordingStream | None = new_recording(recording_id)
        self._recording.connect_grpc(url)
        self._recording.send_recording_name(name)

    def open(self, screen: rrb.Blueprint, chunks: Sequence[Chunk]) -> None:
        """Show the recording on this screen."""
        if self._recording is not None:
            send_blueprint(self._recording, screen)
        self.write(chunks)

    def write(self, chunks: Sequence[Chunk]) -> None:
        """Send, while the viewer is there."""
        if self._recording is not None and self._viewer_there():
            self._recording.send_chunks(chunks)

    def compact(self, chunks: Sequence[Chunk]) -> None:
        """A viewer has them already."""

    def close(self, *, quickly: bool) -> None:  # noqa: ARG002 - a viewer that is gone is not waited for
        """Send what is under way and disconnect."""
        recording, self._recording = self._recording, None
        if recording is None:
            return
        try:
            recording.flush(timeout_sec=2.0)
        except (RuntimeError, ValueError, OSError) as error:
            log.warning("live view at %s: the last events were not sent: %s", self._url, error)
        recording.disconnect()

    def _viewer_there(self) -> bool:
        """Check once a second: the SDK would keep what it cannot send, and slow every call."""
        now_s = time.monotonic()
        if now_s < self._next_check_s:
            return True
        self._next_check_s = now_s + 1.0
        if listening(self._port):
            return True
        log.warning("live view at %s is gone; the recording goes on", self._url)
        recording, self._recording = self._recording, None
        if recording is not None:
            recording.disconnect()
        return False


def listening(port: int) -> bool:
    """Whether something accepts TCP connections at this port of loopback."""
    with socket.socket() as probe:
        probe.settimeout(0.2)
        return probe.connect_ex((_HOST, port)) == 0


def _display() -> bool:
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"))


def free_port() -> int:
    """A TCP port of loopback that nobody listens on at this moment."""
    with socket.socket() as probe:
        probe.bind((_HOST, 0))
        return int(probe.getsockname()[1])
