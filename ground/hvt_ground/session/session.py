"""One session of one edge: account, decoder, perception and sinks, from its first keyframe to its end."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.protocol.ledger import Account, Ledger, overhead_bytes
from hvt_common.protocol.messages import (
    BacklogHeader,
    BacklogUnit,
    BaseHeader,
    Info,
    RoiHeader,
    Status,
    StillResult,
    TrackStep,
    TrackStepDecoder,
)
from hvt_common.runtime.latency import LatencyStats
from hvt_common.transport.inbox import Received
from hvt_common.values import Tracks
from hvt_common.video.hevc import BaseDecoder
from hvt_ground.backlog.fill import BacklogFill, BacklogTotals, Work
from hvt_ground.backlog.perception import BacklogPerception
from hvt_ground.events import Event, Notice, Traffic, VideoSample
from hvt_ground.link.reassemble import StreamCounters
from hvt_ground.link.sequence_window import StillSequenceWindow
from hvt_ground.perception.pipeline import DecodedFrame, Pipeline, ReceivedStill
from hvt_ground.perception.worker import LockstepWorker, PerceptionWorker, RealtimeWorker
from hvt_ground.sinks.rerun.recorder import Recorder
from hvt_ground.sinks.timing import SessionTiming
from hvt_ground.sinks.tracks_table import TrackTable

__all__ = ["GroundSession"]

_SECOND_NS = 1_000_000_000
_MILLION = 1_000_000
_ANEW_NS = 5 * _SECOND_NS
"""What has to rise may begin anew after so long without anything newer: the high numbers may have been forged."""
_MOST_RESULTS = 4096
"""Reports take 32 each; in a flood the newest count."""


class GroundSession:
    """Fed by the receiving thread in order; sees in a thread of its own, so that decoding never waits for detection.

    In lockstep it sees in the receiving thread instead: nothing is skipped, and the same input gives the same tracks.

    ``pipeline_of(emit)`` builds perception. ``report()`` is called when there is something for the edge to hear.
    ``backlog_perception`` finds boxes in video that was kept while the link was away.
    """

    def __init__(
        self,
        info: Info,
        *,
        recorder: Recorder | None,
        recording: Path | None,
        tables: Sequence[TrackTable] = (),
        timing: SessionTiming | None = None,
        pipeline_of: Callable[[Callable[[Event], None]], Pipeline],
        to_local_ns: Callable[[int], int],
        clock: Callable[[], int],
        report: Callable[[], None],
        backlog_perception: BacklogPerception | None = None,
    ) -> None:
        self.info = info
        self.recorder = recorder
        self.recording = recording
        self._tables = tables
        self._timing = timing
        self.lockstep = info.pace == "lockstep"
        self.ledger = Ledger(window_ns=info.window_ns)
        self.pipeline = pipeline_of(self._emit)
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
        self.counters = StreamCounters()
        """What the reassembly counted in this session; filled in when it ends."""
        self._keys = EdgeKeys(info.edge)
        self._decoder = BaseDecoder(size=info.base_size)
        self._step_decoder = TrackStepDecoder()
        self._last_step = -1
        self._stepped_ns = self._reported_ns = 0
        """When the newest report of tracks came, and the newest status."""
        self._to_local_ns = to_local_ns
        self._clock = clock
        self._report = report
        self._first_index: int | None = None
        self._last_index = -1
        self._last_capture_ns = 0
        self._next_traffic_ns = 0
        self._results: list[StillResult] = []
        self._results_lock = threading.Lock()
        self._still_window = StillSequenceWindow()
        self._backlog = BacklogFill(info, log=self._log_backlog, perception=backlog_perception)
        worker = LockstepWorker if self.lockstep else RealtimeWorker
        self._worker: PerceptionWorker = worker(self._analyze, self._step, self._read, name=info.edge)

    # What the receiving thread brings

    def base(self, header: BaseHeader, item: Received, *, decode: bool, starts_run: bool) -> bool:
        """Take one access unit; False where the decoder could make nothing of it."""
        good = self._access_unit(header, item, decode=decode, starts_run=starts_run)
        if self._timing is not None:
            self._timing.message(
                Channel.BASE,
                item,
                sequence=header.sequence,
                frame_index=header.frame_index,
                capture_ns=header.capture_ns,
                send_ns=header.send_ns,
                shown=good and decode,
            )
        return good

    def _access_unit(self, header: BaseHeader, item: Received, *, decode: bool, starts_run: bool) -> bool:
        at_ns = header.send_ns
        self._count(Channel.BASE, Account.BASE, item, at_ns=at_ns)
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
        self._backlog.live(header.frame_index, item.payload, keyframe=header.keyframe, after_gap=starts_run)
        # In lockstep capture and sending are media time and say nothing of delay: count from here.
        reference_ns = item.received_ns if self.lockstep else self._to_local_ns(header.capture_ns)
        self.receive_latency.add(max(0.0, (item.received_ns - reference_ns) / _MILLION))
        self._worker.picture(DecodedFrame(header.frame_index, header.capture_ns, reference_ns, image))
        self._traffic(at_ns)
        return True

    def still(self, header: RoiHeader, item: Received, *, media_type: str) -> None:
        """Take one still; a second one of the same number is counted and not shown, a third ignored."""
        if not self._still_window.is_new(header.sequence, send_ns=header.send_ns):
            if self._still_window.is_copy(header.sequence, send_ns=header.send_ns):
                self._count(Channel.ROI, Account.ROI, item, at_ns=header.send_ns)
            return
        self._count(Channel.ROI, Account.ROI, item, at_ns=header.send_ns)
        if self._timing is not None:
            self._timing.still(
                item,
                sequence=header.sequence,
                frame_index=header.frame_index,
                capture_ns=header.capture_ns,
                send_ns=header.send_ns,
            )
        self.stills_received += 1
        self.ledger.record_outcome("received", header.reason)
        still = ReceivedStill(header, item.payload, media_type)
        self._worker.still(still)

    def tracks(self, step: TrackStep, item: Received) -> None:
        """Take what the edge tracked at one frame; one that is not newer than the last is ignored.

        Raises:
            WireError: its boxes make no sense.
        """
        now_ns = self._clock()
        if step.sequence <= self._last_step:
            if step.reference >= 0 or now_ns - self._stepped_ns < _ANEW_NS:
                return
            self._step_decoder = TrackStepDecoder()
        self._last_step, self._stepped_ns = step.sequence, now_ns
        self._count(Channel.TRACKS, Account.META, item, at_ns=step.send_ns)
        self.steps_received += 1
        tracks = self._step_decoder.decode(step)
        if self._timing is not None:
            self._timing.message(
                Channel.TRACKS,
                item,
                sequence=step.sequence,
                frame_index=step.frame_index,
                capture_ns=step.capture_ns,
                send_ns=step.send_ns,
                shown=tracks is not None,
            )
        if tracks is not None:
            self._worker.step(tracks, step.capture_ns)

    def status(self, status: Status, item: Received) -> None:
        """Take the edge's report; one that is not newer than the last is ignored."""
        now_ns = self._clock()
        old = self.last_status is not None and status.sequence <= self.last_status.sequence
        if old and now_ns - self._reported_ns < _ANEW_NS:
            return
        self._reported_ns = now_ns
        self._count(Channel.STATUS, Account.META, item, at_ns=status.send_ns)
        if self._timing is not None:
            self._timing.message(Channel.STATUS, item, sequence=status.sequence, send_ns=status.send_ns)
        self.last_status = status

    # What was kept while the link was away

    @property
    def backlog(self) -> BacklogTotals:
        """How much of it has come."""
        return self._backlog.arrived

    @property
    def accepts_jobs(self) -> bool:
        """Whether `later` takes more."""
        return self._worker.accepts_jobs

    def backlog_chunk(self, header: BacklogHeader, item: Received, *, delivered: bool) -> None:
        """Count a chunk, of whichever session; ``delivered``: with it an object was whole, and is of use."""
        self._count(Channel.BACKLOG, Account.BACKLOG, item, at_ns=header.send_ns)
        if self._timing is not None:
            self._timing.message(
                f"{Channel.BACKLOG}-{header.kind}",
                item,
                sequence=header.number,
                send_ns=header.send_ns,
                shown=delivered,
            )

    def stored_still(self, still: ReceivedStill) -> Work | None:
        """What perception are to do with a still of this session; None where it has come before, on whichever way."""
        if not self._still_window.is_new_stored(still.header.sequence):
            return None
        return self._read_stored(still)

    def stored_video(self, units: Sequence[BacklogUnit]) -> Work:
        """What the receiving thread is to do with a stretch of this session's base stream, when nothing comes."""
        return self._backlog.fill(units, boxes=self.at_leisure)

    def later(self, work: Work) -> bool:
        """Let perception do it, as far as the picture of now leaves them time; False where too much waits already."""
        return self._worker.later(work)

    def at_leisure(self, work: Work) -> bool:
        """The same for what gives way to that, too."""
        return self._worker.at_leisure(work)

    def report_backlog(self) -> None:
        """Put a line into the recording's log on what has come since the last one."""
        news = self._backlog.take_news()
        if news.first is not None:
            at = time.strftime("%H:%M:%S", time.gmtime(news.first[1] // _SECOND_NS))
            self.note("info", f"{news.amount()} from the outage at {at} UTC arrived")

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
    def newest_index(self) -> int:
        """Frame index of the newest access unit; -1 before the first."""
        return self._last_index

    @property
    def duration_s(self) -> float:
        """From the first frame received to the last."""
        if self._first_index is None:
            return 0.0
        return (self._last_index - self._first_index + 1) / self.info.fps

    def close(self) -> None:
        """Finish what waits (for a second or two), close the recording, raise what went wrong in the thread."""
        try:
            if self._worker.close():
                self.pipeline.end()
            self.report_backlog()
            self._decoder.reset()
            self.note("info", f"session {self.info.session_id:016x} ended")
        finally:
            if self._timing is not None:
                self._timing.close()
            for table in self._tables:
                table.close()
            if self.recorder is not None:
                self.recorder.close()
        self.raise_error()

    @property
    def frames_untracked(self) -> int:
        """Frames that were decoded, and passed over by detection and tracking."""
        return self._worker.untracked

    @property
    def stills_dropped(self) -> Counter[str]:
        """Stills of which nothing was made, by reason."""
        return +(self.pipeline.stills_dropped + self._worker.dropped)

    @property
    def idle(self) -> bool:
        """Nothing waits to be seen."""
        return self._worker.idle

    def raise_error(self) -> None:
        """Raise what went wrong while seeing."""
        self._worker.raise_error()

    # Seeing, in the thread of perception

    def _analyze(self, picture: DecodedFrame, hurry: bool) -> None:  # noqa: FBT001 - called by perception only
        self.pipeline.analyze(picture, hurry=hurry)
        self.last_frame_index = picture.frame_index
        self.overlay_latency.add(max(0.0, (self._clock() - picture.reference_ns) / _MILLION))
        self._collect_results()
        if self.lockstep:
            self._report()

    def _step(self, tracks: Tracks, capture_ns: int) -> None:
        self.pipeline.edge_step(tracks, capture_ns=capture_ns)
        self._collect_results()

    def _read(self, stills: Sequence[ReceivedStill]) -> None:
        self.pipeline.read(stills)
        if self._timing is not None:
            self._timing.read(one.header.sequence for one in stills)
        self._collect_results()
        self._report()

    def _read_stored(self, still: ReceivedStill) -> Work:
        self.pipeline.read([still])
        self._backlog.note_still(still.header.frame_index, still.header.capture_ns)
        self._collect_results()
        self._report()
        yield
        return True

    def _collect_results(self) -> None:
        with self._results_lock:
            self._results = (self._results + self.pipeline.take_results())[-_MOST_RESULTS:]

    # Account

    def _count(self, row: Channel, channel: Account, item: Received, *, at_ns: int) -> None:
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
                base_bps=self.ledger.window_bytes(Account.BASE, at_ns) * to_bps,
                roi_bps=self.ledger.window_bytes(Account.ROI, at_ns) * to_bps,
                total_bps=self.ledger.window_bytes(None, at_ns) * to_bps,
                budget_bps=self.info.budget_bps,
                receive_latency_ms=None if self.lockstep else self.receive_latency.percentile(50),
                overlay_latency_ms=None if self.lockstep else self.overlay_latency.percentile(50),
                tracks=self.pipeline.tracks,
                tracks_refined=self.pipeline.refined,
            )
        )

    def _log_backlog(self, event: Event) -> None:
        """Into the recording only: a table of tracks is in the order of frames."""
        if self.recorder is not None:
            self.recorder.log(event)

    def _emit(self, event: Event) -> None:
        if self.recorder is not None:
            self.recorder.log(event)
        for table in self._tables:
            table.log(event)
