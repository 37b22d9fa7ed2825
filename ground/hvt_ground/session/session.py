"""One session of one edge: account, decoder, perception and sinks, from its first keyframe to its end."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from typing import Any

from hvt_common.protocol.channels import Channel
from hvt_common.protocol.clock_offset import ClockOffset
from hvt_common.protocol.edge_words import counts_text
from hvt_common.protocol.messages import BaseHeader, Info, PoseReport, RoiHeader, Status, TrackStep
from hvt_common.transport.inbox import Received, TokenBucket
from hvt_common.units import SECOND_NS
from hvt_common.values import Tracks
from hvt_common.video.hevc import BaseDecoder
from hvt_ground.backlog.session_backlog import SessionBacklog
from hvt_ground.events import Event, Level, Notice, Overlay, PoseUpdate, Refinement, StillsRead, VideoSample
from hvt_ground.link.reassemble import Arrival
from hvt_ground.link.reception import Reception
from hvt_ground.perception.models import NotOpenError
from hvt_ground.perception.pipeline import DecodedFrame, PerceptionCounts, Pipeline, ReceivedStill
from hvt_ground.perception.session import SessionPerception
from hvt_ground.perception.worker import Analyze, LockstepWorker, PerceptionWorker, Read, RealtimeWorker, Step
from hvt_ground.poses import NOWHERE, Locator, SessionPoses
from hvt_ground.session.edge_port import ReceiverReports
from hvt_ground.sinks import QueuedSink, Sink

_MILLION = 1_000_000
_LINES_AT_ONCE = 60
"""Lines in a recording's log; then one a second."""

WorkerFactory = Callable[[Analyze, Step, Read], PerceptionWorker]


def _perceives(act: Callable[..., None]) -> Callable[..., None]:
    # Of the worker's calls: there is nothing to do where the run ends before models are open.
    def acts(*given: Any) -> None:
        with suppress(NotOpenError):
            act(*given)

    return acts


class Session:
    """Fed by the receiving thread in order; a worker analyzes, so that decoding never waits for detection.

    In real time the worker passes over pictures that are too many. In lockstep nothing is skipped, and the same input
    gives the same tracks. ``worker_of`` makes the worker, which makes perception by ``pipeline_of`` before its first
    picture, and may wait for models there. Without ``reports`` nothing is reported, and the edge's clock is this one
    (Unix nanoseconds without steps).
    """

    def __init__(
        self,
        info: Info,
        *,
        sinks: Sequence[Sink[Event]] = (),
        pipeline_of: Callable[[Callable[[Event], None]], Pipeline],
        clock: Callable[[], int],
        reports: ReceiverReports | None = None,
        backlog_perception: SessionPerception | None = None,
        worker_of: WorkerFactory | None = None,
        locator: Locator = NOWHERE,
    ) -> None:
        self.sinks = sinks
        self._queued = [one for one in sinks if isinstance(one, QueuedSink)]
        self.info = info
        """As the session began."""
        self.lockstep = info.pace == "lockstep"
        self.reception = Reception(
            info,
            clock=clock,
            edge_clock=ClockOffset() if reports is None else reports.clock_offset,
            emit=self._emit,
            note=self.note,
        )
        """The account of its messages."""
        self._make_pipeline = partial(pipeline_of, self._emit)
        self._pipeline: Pipeline | None = None
        self.frames_decoded = 0
        self.failure = ""
        """The reason of its end, where that was no regular end."""
        self._clock = clock
        self._reports = reports
        self._decoder = BaseDecoder(size=info.base_size)
        self.poses = SessionPoses(info.view, locator=locator)
        """Where the camera is, and where tracks are on the ground."""
        self._lines = TokenBucket(burst=_LINES_AT_ONCE, every_ns=SECOND_NS)
        self._lines_left_out = 0
        if worker_of is None:
            worker_of = (
                partial(LockstepWorker, name=info.edge)
                if self.lockstep
                else partial(
                    RealtimeWorker, name=info.edge, pass_over=self._pass_over, take_late=self._take_late
                )
            )
        self.worker = worker_of(self._analyze, self._step, _perceives(self._read_stills))
        self.backlog = SessionBacklog(
            info,
            log=self._emit,
            perception=backlog_perception,
            read=lambda still: self._read_stills([still]),
            stills=self.reception.sequences,
            outputs=[one for one in self._queued if one.for_backlog],
        )
        """Objects of this session that the edge stored while the link was down."""

    # From the receiving thread

    def base(self, arrival: Arrival[Received]) -> bool:
        """Take one access unit; False where the decoder could make nothing of it."""
        header, item, decode = arrival.header, arrival.message, arrival.verdict == "decode"
        self.reception.base(header, item)
        good = not decode or self._picture(header, item, starts_run=arrival.starts_run)
        self.reception.time(Channel.BASE, item, header, handled=good and decode)
        return good

    def _picture(self, header: BaseHeader, item: Received, *, starts_run: bool) -> bool:
        reception = self.reception
        if starts_run:
            self._decoder.reset()
        picture = self._decoder.decode_yuv(item.payload)
        if picture is None or picture.size != self.info.base_size:
            return False
        self.frames_decoded += 1
        self._emit(VideoSample(header.frame_index, header.capture_ns, item.payload, header.keyframe))
        self.backlog.live(header.frame_index, item.payload, keyframe=header.keyframe, after_gap=starts_run)
        # In lockstep capture and sending are media time and say nothing of delay: count from here.
        reference_ns = item.received_ns if self.lockstep else None
        if reception.knows_delay:
            reference_ns = reception.capture_clock.to_local_ns(header.capture_ns)
            reception.receive_latency.add(max(0.0, (item.received_ns - reference_ns) / _MILLION))
        self.worker.picture(DecodedFrame(header.frame_index, header.capture_ns, reference_ns, picture))
        perceived = self.perceived
        reception.measure(header, tracks=perceived.tracks, tracks_refined=perceived.refined)
        return True

    def take(self, header: RoiHeader | TrackStep | PoseReport | Status, item: Received) -> None:
        """Take another message than an access unit. Raises `WireError` where its contents make no sense."""
        match header:
            case RoiHeader():
                header = header.named(self.info.class_names)
                if self.reception.still(header, item):
                    self.worker.still(ReceivedStill(header, item.payload))
            case TrackStep():
                tracks = self.reception.tracks(header, item)
                if tracks is not None:
                    self.worker.step(tracks, header.capture_ns)
            case Status():
                if self.reception.status(header, item):
                    self._note_stale(self.reception.newest_capture_ns)
            case PoseReport():
                self._pose(header, item)

    def _pose(self, report: PoseReport, item: Received) -> None:
        self.reception.count(Channel.POSE, item, at_ns=report.send_ns)
        pose = self.poses.report(report)
        self.reception.time(Channel.POSE, item, report, handled=pose is not None)
        if pose is not None:
            self.reception.pose_clock.note(pose.capture_ns, received_ns=item.received_ns)
            self.worker.pose(partial(self.poses.use, pose), pose.capture_ns)
            self._emit(PoseUpdate(max(0, self.reception.newest_index), pose.capture_ns, pose, self.info.view))
            self._note_stale(pose.capture_ns)

    def report_backlog(self) -> None:
        """Say in the recording how much of the backlog has come since the last time."""
        news = self.backlog.take_news()
        if news.first is not None and news.amount():
            at = time.strftime("%H:%M:%S", time.gmtime(news.first[1] // SECOND_NS))
            self.note("info", f"{news.amount()} from the outage at {at} UTC arrived")

    def note(self, level: Level, text: str, *, last: bool = False) -> None:
        """Put a line into the recording's log; in a flood some but the ``last`` are left out, and counted."""
        at = max(0, self.reception.newest_index), self.reception.newest_capture_ns
        if not (last or self._lines.take(self._clock())):
            self._lines_left_out += 1
            return
        if self._lines_left_out:
            what = f"{self._lines_left_out} lines were left out here: the edge gave rise to too many"
            self._lines_left_out = 0
            self._emit(Notice(*at, "warning", what))
        self._emit(Notice(*at, level, text))

    def close(self) -> None:
        """Finish the queue (for a second or two) and close the sinks, each whatever the others do.

        Raises an exception of these, or the one that ended the worker.
        """
        with ExitStack() as stack:
            for sink in self.sinks:
                stack.callback(sink.close)
            stack.callback(self._note_end)
            stack.callback(self._decoder.reset)
            stack.callback(self.report_backlog)
            ended = True
            try:
                ended = self.worker.close()
            finally:
                if ended and self._pipeline is not None:
                    self._pipeline.end()
        self.worker.raise_error()

    def _note_end(self) -> None:
        if self.failure:
            self.note("error", f"the session failed: {self.failure}", last=True)
        not_sent, last = self.reception.not_sent, self.reception.last_status
        if not_sent:
            self.note("info", f"the edge did not send these stills: {counts_text(not_sent)}", last=True)
        ended = last is not None and last.state == "ended"
        self.note("info", "the flight has ended" if ended else "this session has ended", last=True)

    # Its state

    @property
    def pipeline(self) -> Pipeline:
        """Its perception; for the worker's thread, which makes it, and waits here until the models are open."""
        if self._pipeline is None:
            self._pipeline = self._make_pipeline()
        return self._pipeline

    @property
    def perceived(self) -> PerceptionCounts:
        return PerceptionCounts() if self._pipeline is None else self._pipeline.counts

    @property
    def stills_dropped(self) -> Counter[str]:
        return +(self.perceived.stills_dropped + self.worker.dropped)

    @property
    def idle(self) -> bool:
        return self.worker.idle

    def take_resumed(self) -> bool:
        """Whether a recording goes on after a gap, and waits for a keyframe; True once."""
        resumed = [one.take_resumed() for one in self._queued]
        return any(resumed)

    # Reports

    def report_if_due(self) -> None:
        """Report to the edge, the more often the more bytes arrive."""
        if self.reception.due(now_ns=self._clock()):
            self.report()

    def report(self) -> None:
        if self._reports is not None:
            self._reports.send(self.reception.feedback)

    def _collect_results(self) -> None:
        self.reception.add_results(self.pipeline.take_results())

    def _note_stale(self, capture_ns: int) -> None:
        stale = self.poses.turned_stale(capture_ns)
        if stale:
            self.note(
                "warning", "the pose is stale: nothing is placed on the ground until there is a new one"
            )
        elif stale is False:
            self.note("info", "there is a pose again")

    # In the worker's thread

    @_perceives
    def _analyze(
        self,
        picture: DecodedFrame,
        hurry: bool,  # noqa: FBT001 - called by the worker only
        news: threading.Event | None,
    ) -> None:
        self.pipeline.analyze(picture, hurry=hurry, news=news)
        self.reception.analyzed = (picture.frame_index, self.pipeline.objects_detected)
        if picture.reference_ns is not None:
            self.reception.overlay_latency.add(max(0.0, (self._clock() - picture.reference_ns) / _MILLION))
        self._collect_results()
        if self.lockstep:
            self.report()

    def _take_late(self) -> bool:
        if self._pipeline is None:
            return False
        searching = self._pipeline.take_late()
        self._collect_results()
        return searching

    @_perceives
    def _pass_over(self, frame_index: int, capture_ns: int) -> None:
        self.pipeline.pass_over(frame_index, capture_ns)

    @_perceives
    def _step(self, tracks: Tracks, capture_ns: int) -> None:
        self.pipeline.edge_step(tracks, capture_ns=capture_ns)
        self._collect_results()

    def _read_stills(self, stills: Sequence[ReceivedStill]) -> None:
        self.pipeline.read(stills)
        self._emit(StillsRead(tuple(one.header.sequence for one in stills), self._clock()))
        self._collect_results()
        self.report()

    # Events

    def _emit(self, event: Event) -> None:
        if isinstance(event, Refinement):
            self.backlog.note(event)
        if self.poses.has_pose and isinstance(event, Overlay) and not event.stored:
            event = self.poses.located(event)
        for sink in self.sinks:
            sink.log(event)
