"""A recording in a viewer of this machine, in place of a file."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Sequence

import rerun.blueprint as rrb
from rerun.chunk import Chunk

from hvt_common.errors import UserError
from hvt_ground.sinks.rerun.sdk import RecordingId, new_recording, releasing_recordings, send_blueprint

HOST = "127.0.0.1"


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


def listening(port: int) -> bool:
    """Whether something accepts TCP connections at this port of loopback."""
    with socket.socket() as probe:
        probe.settimeout(0.2)
        return probe.connect_ex((HOST, port)) == 0
