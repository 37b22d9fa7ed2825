"""One session of one edge at the ground: account, decoder, eyes and recording, from its first keyframe to its end."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from hvt_common.distinct import DistinctIds
from hvt_common.latency import LatencyStats
from hvt_common.link.inbox import Received
from hvt_common.link.keys import EdgeKeys, Row
from hvt_common.link.ledger import Channel, Ledger, overhead_bytes
from hvt_common.link.wire import BaseHeader, Info, RoiHeader, Status, StillResult
from hvt_common.priority import give_way
from hvt_common.vision.hevc import BaseDecoder
from hvt_ground.events import Event, Notice, Traffic, VideoSample
from hvt_ground.export_tracks import TrackTable
from hvt_ground.reassemble import Counters
from hvt_ground.record import Recorder
from hvt_ground.sight import GroundSight, Picture, ReceivedStill

__all__ = ["GroundSession"]

_log = logging.getLogger(__name__)

_SECOND_NS = 1_000_000_000
_MILLION = 1_000_000
_WAITING_PICTURES = 24
"""How many decoded frames may wait for detection and tracking; beyond, the oldest goes untracked."""
_BEHIND_PICTURES = 1
_STILLS_AT_ONCE = 16
_WAITING_STILLS = 256
_FINISH_S = 1.5
_LEAVE_S = 1.0


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
        self.frames_untracked = 0
        self.stills_received = 0
        self.last_frame_index = -1
        """The last frame that was decoded, tracked and drawn."""
        self.last_status: Status | None = None
        self.counters = Counters()
        """What the reassembly counted in this session; filled in when it ends."""
        self._keys = EdgeKeys(info.edge)
        self._decoder = BaseDecoder()
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
        self._pictures: queue.Queue[Picture] = queue.Queue(_WAITING_PICTURES)
        self._stills: queue.Queue[ReceivedStill] = queue.Queue(_WAITING_STILLS)
        self._early: list[ReceivedStill] = []
        self._wake = threading.Event()
        self._ending = threading.Event()
        self._given_up = threading.Event()
        self._error: BaseException | None = None
        self._thread: threading.Thread | None = None
        if not self.lockstep:
            self._thread = threading.Thread(target=self._run, name=f"hvt-sight-{info.edge}", daemon=True)
            self._thread.start()

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
        self._offer(Picture(header.frame_index, header.capture_ns, reference_ns, image))
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
        if self.lockstep:
            self._early.append(still)
            if len(self._early) > _WAITING_STILLS:
                self._early.pop(0)
                self.sight.stills_dropped["overflow"] += 1
            self._read_known()
            return
        try:
            self._stills.put_nowait(still)
        except queue.Full:
            self.sight.stills_dropped["overflow"] += 1
        self._wake.set()

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
    def unheard_results(self) -> int:
        """How many results wait to be reported."""
        return len(self._results)

    @property
    def duration_s(self) -> float:
        """From the first frame received to the last."""
        if self._first_index is None:
            return 0.0
        return (self._last_index - self._first_index + 1) / self.info.fps

    def close(self) -> None:
        """Finish what waits (for a second or two), close the recording, raise what went wrong in the thread."""
        self._ending.set()
        self._wake.set()
        if self._thread is not None:
            self._thread.join(_FINISH_S)
            self._given_up.set()
            self._thread.join(_LEAVE_S)
        try:
            if self._thread is None or not self._thread.is_alive():
                self.sight.stills_dropped.update(["ended"] * (self._stills.qsize() + len(self._early)))
                self.frames_untracked += self._pictures.qsize()
                self.sight.end()
            self.note("info", f"session {self.info.session_id:016x} ended")
        finally:
            for table in self._tables:
                table.close()
            if self.recorder is not None:
                self.recorder.close()
        self.raise_error()

    def raise_error(self) -> None:
        """Raise what went wrong in the seeing thread."""
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    # Seeing

    def _offer(self, picture: Picture) -> None:
        if self.lockstep:
            self._see(picture, hurry=False)
            return
        while True:
            try:
                self._pictures.put_nowait(picture)
                break
            except queue.Full:
                try:
                    self._pictures.get_nowait()
                    self.frames_untracked += 1
                except queue.Empty:
                    continue
        self._wake.set()

    def _run(self) -> None:
        give_way()
        try:
            while not self._given_up.is_set():
                self._wake.wait(0.2)
                self._wake.clear()
                self._work_off()
                if self._ending.is_set() and self._pictures.empty() and self._stills.empty():
                    return
        except BaseException as error:  # noqa: BLE001 - handed to the receiving thread, which ends the process
            self._error = error

    def _work_off(self) -> None:
        """See all pictures that came before the stills taken here, then read these: their frames have to be known."""
        stills: list[ReceivedStill] = []
        while len(stills) < _STILLS_AT_ONCE and not self._stills.empty():
            stills.append(self._stills.get_nowait())
        while not self._given_up.is_set():
            try:
                picture = self._pictures.get_nowait()
            except queue.Empty:
                break
            self._see(picture, hurry=self._pictures.qsize() > _BEHIND_PICTURES)
        if stills:
            self._read(stills)
            self._wake.set()

    def _see(self, picture: Picture, *, hurry: bool) -> None:
        self.sight.see(picture, hurry=hurry)
        self.last_frame_index = picture.frame_index
        self.overlay_latency.add(max(0.0, (self._clock() - picture.reference_ns) / _MILLION))
        self._hear_results()
        if self.lockstep:
            self._report()
            self._read_known()

    def _read_known(self) -> None:
        """In lockstep: a still may overtake its frame on the link; it is read once that frame has been seen."""
        known = [one for one in self._early if one.header.frame_index <= self.last_frame_index]
        if known:
            self._early = [one for one in self._early if one.header.frame_index > self.last_frame_index]
            self._read(known)

    def _read(self, stills: list[ReceivedStill]) -> None:
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
