"""The thread of perception and stills in real time, so that detection never delays the base stream."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Self

from hvt_common.protocol.messages import StillResult
from hvt_common.runtime.process import lower_priority
from hvt_common.values import AccessUnit, Frame
from hvt_edge.perception.frame_queue import FrameQueue
from hvt_edge.stills.stage import StillStage

__all__ = ["MAX_QUEUE_BYTES", "StillWorker"]

_BEHIND_FRAMES = 3
"""With more frames queued than this, detection is put off; decoding never is."""
MAX_QUEUE_BYTES = 32 * 2**20
"""Of frames that are queued: 6 of 1280x720, 3 of 1920x1080, 2 of 3840x2160."""
_RETRY_S = 0.025


class StillWorker:
    """Runs a `StillStage` in a thread of its own.

    The queue is bounded in frames and in bytes: the newest has a place, and the oldest goes unanalyzed. Before each
    frame the thread takes ``results()``, what grounds have reported of stills. An error in it ends the process:
    `offer` and `close` raise it.
    """

    def __init__(
        self,
        stage: StillStage,
        *,
        results: Callable[[], Sequence[StillResult]],
        clock: Callable[[], int],
        length: int = 16,
        max_bytes: int = MAX_QUEUE_BYTES,
        finish_s: float = 1.0,
    ) -> None:
        self._stage = stage
        self._results = results
        self._clock = clock
        self._frames = FrameQueue(length=length, max_bytes=max_bytes)
        self._finish_s = finish_s
        self._error: BaseException | None = None
        self._given_up = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hvt-stills", daemon=True)
        self._thread.start()

    @property
    def queued(self) -> int:
        """Frames that are not taken yet."""
        return len(self._frames)

    def offer(self, frame: Frame, unit: AccessUnit | None) -> int:
        """Hand over one frame, in order, with its access unit if it has one; return how many go unanalyzed for it."""
        self._raise_error()
        return self._frames.put(frame, unit)

    def close(self) -> None:
        """Let the thread finish what it has, at most for ``finish_s``, then leave the rest; join it."""
        self._frames.close()
        self._thread.join(timeout=self._finish_s)
        self._given_up.set()
        self._thread.join(timeout=self._finish_s)
        self._raise_error()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _run(self) -> None:
        lower_priority()
        try:
            while (item := self._next()) is not None and not self._given_up.is_set():
                behind = len(self._frames) >= _BEHIND_FRAMES
                self._stage.on_results(self._results())
                analyzed = self._stage.analyze(*item, hurry=behind)
                self._stage.send(analyzed, now_ns=self._clock())
        except BaseException as error:  # noqa: BLE001 - handed to the frame loop, which ends the process
            self._error = error

    def _next(self) -> tuple[Frame, AccessUnit | None, Sequence[AccessUnit]] | None:
        """Return the next frame; until it comes what is pending is tried again.

        Right behind a base frame the link is busy: with few frames a second there would be no other moment.
        """
        while not self._frames.ended:
            if (item := self._frames.get(timeout_s=_RETRY_S)) is not None:
                return item
            if self._stage.any_pending:
                self._stage.send_pending(now_ns=self._clock())
        return None

    def _raise_error(self) -> None:
        if self._error is not None:
            error, self._error = self._error, None
            raise error
