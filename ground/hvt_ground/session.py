"""One session of one edge at the ground: account, decoder, eyes and recording, from its first keyframe to its end."""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from hvt_common.distinct import DistinctIds
from hvt_common.latency import LatencyStats
from hvt_common.link.inbox import Received
from hvt_common.link.keys import EdgeKeys, Row
from hvt_common.link.ledger import Channel, Ledger, overhead_bytes
from hvt_common.link.wire import (
    BaseHeader,
    Info,
    RoiHeader,
    Status,
    StillResult,
    TrackStep,
    TrackStepDecoder,
)
from hvt_common.values import Tracks
from hvt_common.vision.hevc import BaseDecoder
from hvt_ground.events import Event, Notice, Traffic, VideoSample
from hvt_ground.export_tracks import TrackTable
from hvt_ground.eyes import Eyes, LockstepEyes, RealtimeEyes
from hvt_ground.reassemble import Counters
from hvt_ground.record import Recorder
from hvt_ground.sight import GroundSight, Picture, ReceivedStill

__all__ = ["GroundSession"]

_log = logging.getLogger(__name__)

_SECOND_NS = 1_000_000_000
_MILLION = 1_000_000


class GroundSession:
    """Fed by the receiving thread in order; sees in a thread of its own, so that decoding never waits for detection.

    In lockstep it sees in the receiving thread instead: nothing is skipped, and the same input gives the same tracks.

    ``sight_of(emit)`` builds the eyes. ``report()`` is called when there is something for the edge to hear.
    """

    def __init__(
        self,
        info: Info,
        *,
        recorder: Recorder | None,
        recording: Path | None,
        tables: Sequence[TrackTable] = (),
        sight_of: Callable[[Callable[[Event], None]], GroundSight],
        to_local_ns: Callable[[int], int],
        clock: Callable[[], int],
        report: Callable[[], None],
    ) -> None:
        self.info = info
        self.recorder = recorder
        self.recording = recording
        self._tables = tables
        self.lockstep = info.pace == "lockstep"
        self.ledger = Ledger(window_ns=info.window_ns)
        self.sight = sight_of(self._emit)
        self.receive_latency = LatencyStats()
        self.overlay_latency = LatencyStats()
        self.frames_decoded = 0
        self.frames_received = 0
        self.stills_received = 0
        self.steps_received = 0
        """Reports of the edge's tracks."""
        self.last_frame_index = -1
        """The last frame that was decoded, tracked and drawn."""
        self.last_status: Status | None = None
        self.counters = Counters()
        """What the reassembly counted in this session; filled in when it ends."""
        self._keys = EdgeKeys(info.edge)
        self._decoder = BaseDecoder()
        self._step_decoder = TrackStepDecoder()
        self._last_step = -1
        self._to_local_ns = to_local_ns
        self._clock = clock
        self._report = report
        self._first_index: int | None = None
        self._last_index = -1
        self._last_capture_ns = 0
        self._next_traffic_ns = 0
        self._results: list[StillResult] = []
        self._results_lock = threading.Lock()
        self._still_sequences = DistinctIds(remember=4096)
        eyes = LockstepEyes if self.lockstep else RealtimeEyes
        self._eyes: Eyes = eyes(self._see, self._step, self._read, name=info.edge)

    # What the receiving thread brings

    def base(self, header: BaseHeader, item: Received, *, decode: bool, starts_run: bool) -> bool:
        """Take one access unit; False where the decoder could make nothing of it."""
        at_ns = header.send_ns
        self._count(Row.BASE, Channel.BASE, item, at_ns=at_ns)
        self.frames_received += 1
        if self._first_index is None:
            self._first_index = header.frame_index
        self._last_index, self._last_capture_ns = header.frame_index, header.capture_ns
        if not decode:
            return True
        if starts_run:
            self._decoder.reset()
        image = self._decoder.decode(item.payload)
        if image is None or image.shape[1::-1] != self.info.base_size:
            return False
        self.frames_decoded += 1
        self._emit(VideoSample(header.frame_index, header.capture_ns, item.payload, header.keyframe))
        # In lockstep capture and sending are media time and say nothing of delay: count from here.
        reference_ns = item.received_ns if self.lockstep else self._to_local_ns(header.capture_ns)
        self.receive_latency.add(max(0.0, (item.received_ns - reference_ns) / _MILLION))
        self._eyes.picture(Picture(header.frame_index, header.capture_ns, reference_ns, image))
        self._traffic(at_ns)
        return True

    def still(self, header: RoiHeader, item: Received, *, media_type: str) -> None:
        """Take one still; a second one of the same number is ignored."""
        if not self._still_sequences.add([header.sequence]):
            return
        self._count(Row.ROI, Channel.ROI, item, at_ns=header.send_ns)
        self.stills_received += 1
        self.ledger.record_fate("received", header.reason)
        still = ReceivedStill(header, item.payload, media_type)
        self._eyes.still(still)

    def tracks(self, step: TrackStep, item: Received) -> None:
        """Take what the edge tracked at one tick; one that is not newer than the last is ignored.

        Raises:
            WireError: its boxes make no sense.
        """
        if step.sequence <= self._last_step:
            return
        self._last_step = step.sequence
        self._count(Row.TRACKS, Channel.META, item, at_ns=step.send_ns)
        self.steps_received += 1
        tracks = self._step_decoder.decode(step)
        if tracks is not None:
            self._eyes.step(tracks, step.capture_ns)

    def status(self, status: Status, item: Received) -> None:
        """Take the edge's report; one that is not newer than the last is ignored."""
        if self.last_status is not None and status.sequence <= self.last_status.sequence:
            return
        self._count(Row.STATUS, Channel.META, item, at_ns=status.send_ns)
        self.last_status = status

    def note(self, level: str, text: str) -> None:
        """Put a line into the recording's log."""
        assert level in ("info", "warning", "error")
        self._emit(Notice(max(0, self._last_index), self._last_capture_ns, level, text))  # type: ignore[arg-type]

    def take_results(self, most: int) -> tuple[StillResult, ...]:
        """Return and forget up to ``most`` results that the edge has not heard yet."""
        with self._results_lock:
            taken, self._results = self._results[:most], self._results[most:]
            return tuple(taken)

    @property
    def duration_s(self) -> float:
        """From the first frame received to the last."""
        if self._first_index is None:
            return 0.0
        return (self._last_index - self._first_index + 1) / self.info.fps

    def close(self) -> None:
        """Finish what waits (for a second or two), close the recording, raise what went wrong in the thread."""
        try:
            if self._eyes.close():
                self.sight.end()
            self.note("info", f"session {self.info.session_id:016x} ended")
        finally:
            for table in self._tables:
                table.close()
            if self.recorder is not None:
                self.recorder.close()
        self.raise_error()

    @property
    def frames_untracked(self) -> int:
        """Frames that were decoded, and passed over by detection and tracking."""
        return self._eyes.untracked

    @property
    def stills_dropped(self) -> Counter[str]:
        """Stills of which nothing was made, by reason."""
        return +(self.sight.stills_dropped + self._eyes.dropped)

    @property
    def idle(self) -> bool:
        """Nothing waits to be seen."""
        return self._eyes.idle

    def raise_error(self) -> None:
        """Raise what went wrong while seeing."""
        self._eyes.raise_error()

    # Seeing, in the thread of the eyes

    def _see(self, picture: Picture, hurry: bool) -> None:  # noqa: FBT001 - called by the eyes only
        self.sight.see(picture, hurry=hurry)
        self.last_frame_index = picture.frame_index
        self.overlay_latency.add(max(0.0, (self._clock() - picture.reference_ns) / _MILLION))
        self._hear_results()
        if self.lockstep:
            self._report()

    def _step(self, tracks: Tracks, capture_ns: int) -> None:
        self.sight.edge_step(tracks, capture_ns=capture_ns)
        self._hear_results()

    def _read(self, stills: Sequence[ReceivedStill]) -> None:
        self.sight.read(stills)
        self._hear_results()
        self._report()

    def _hear_results(self) -> None:
        with self._results_lock:
            self._results += self.sight.take_results()

    # Account

    def _count(self, row: Row, channel: Channel, item: Received, *, at_ns: int) -> None:
        encoding = item.encoding
        self.ledger.count(
            channel,
            payload_bytes=len(item.payload),
            attachment_bytes=len(item.attachment),
            overhead_bytes=overhead_bytes(
                len(item.payload), len(item.attachment), key=self._keys.key(row), encoding=encoding
            ),
            at_ns=at_ns,
        )

    def _traffic(self, at_ns: int) -> None:
        """Twice a second of the stream, how full the link was and how old the picture is."""
        if at_ns < self._next_traffic_ns:
            return
        self._next_traffic_ns = at_ns + _SECOND_NS // 2
        to_bps = 8 * _SECOND_NS / self.info.window_ns
        self._emit(
            Traffic(
                frame_index=self._last_index,
                capture_ns=self._last_capture_ns,
                base_bps=self.ledger.window_bytes(Channel.BASE, at_ns) * to_bps,
                roi_bps=self.ledger.window_bytes(Channel.ROI, at_ns) * to_bps,
                total_bps=self.ledger.window_bytes(None, at_ns) * to_bps,
                budget_bps=self.info.budget_bps,
                receive_latency_ms=None if self.lockstep else self.receive_latency.percentile(50),
                overlay_latency_ms=None if self.lockstep else self.overlay_latency.percentile(50),
                tracks=self.sight.tracks,
                tracks_refined=self.sight.refined,
            )
        )

    def _emit(self, event: Event) -> None:
        if self.recorder is not None:
            self.recorder.log(event)
        for table in self._tables:
            table.log(event)
