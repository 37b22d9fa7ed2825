"""One session of one edge: account, decoder, perception and sinks, from its first keyframe to its end."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial, wraps
from typing import Any, Literal, ParamSpec

from hvt_common.protocol.channels import Channel
from hvt_common.protocol.clock_offset import ClockOffset
from hvt_common.protocol.edge_words import counts_text, lever_decisions, lever_sentences
from hvt_common.protocol.ledger import Account
from hvt_common.protocol.messages import (
    MAX_STILL_RESULTS,
    BacklogHeader,
    BacklogKind,
    BaseHeader,
    Feedback,
    Health,
    Info,
    PoseReport,
    RoiHeader,
    Status,
    StillResult,
    TrackStep,
    TrackStepDecoder,
)
from hvt_common.transport.inbox import Received, TokenBucket
from hvt_common.units import SECOND_NS, bitrate_text
from hvt_common.values import Tracks
from hvt_common.video.hevc import BaseDecoder
from hvt_ground.backlog.session_backlog import SessionBacklog
from hvt_ground.events import Event, Notice, Overlay, PoseUpdate, Refinement, StillsRead, Traffic, VideoSample
from hvt_ground.link.reassemble import Arrival
from hvt_ground.link.reception import ReceptionStatistics
from hvt_ground.perception.models import NotOpenError
from hvt_ground.perception.pipeline import DecodedFrame, NothingPerceived, Pipeline, ReceivedStill
from hvt_ground.perception.session import SessionPerception
from hvt_ground.perception.worker import Analyze, LockstepWorker, PerceptionWorker, Read, RealtimeWorker, Step
from hvt_ground.poses import NOWHERE, Locator, SessionPoses
from hvt_ground.session.edge_port import ReceiverReports
from hvt_ground.sinks import QueuedSink, Sink

_MILLION = 1_000_000
_ANEW_NS = 5 * SECOND_NS
"""What has to rise may begin anew after so long without anything newer: the high numbers may have been forged."""
_LATELY_NS, _FRAMES_LATELY = 3 * SECOND_NS, 4
"""What came longer ago, and so many frames, says nothing of now."""
_MOST_OBJECTS = 65_535
_MOST_RESULTS = 4096
"""Reports take 32 each; in a flood the newest count."""

WorkerFactory = Callable[[Analyze, Step, Read], PerceptionWorker]

P = ParamSpec("P")


def _perceives(act: Callable[P, None]) -> Callable[P, None]:
    # Of the worker's calls: there is nothing to do where the run ends before models are open.
    @wraps(act)
    def acts(*given: P.args, **named: P.kwargs) -> None:
        with suppress(NotOpenError):
            act(*given, **named)

    return acts


class GroundSession:
    """Fed by the receiving thread in order; a worker analyzes, so that decoding never waits for detection.

    In real time the worker passes over what comes too fast. In lockstep nothing is skipped, and the same input
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
        self.method = info.method
        """As it is now, some seconds late."""
        self.lockstep = info.pace == "lockstep"
        self.clock_offset = ClockOffset() if reports is None else reports.clock_offset
        """Of the edge's clock."""
        self.reception = ReceptionStatistics(info, clock=clock, edge_clock=self.clock_offset, emit=self._emit)
        """What came."""
        self._make_pipeline = partial(pipeline_of, self._emit)
        self._pipeline: Pipeline | None = None
        self.frames_decoded = 0
        self._analyzed = (-1, -1)
        """The last frame that was analyzed, and what was detected by then: reports want both of one moment."""
        self.failure = ""
        """What ended it, where that was no regular end."""
        self._clock = clock
        self._reports = reports
        self._decoder = BaseDecoder(size=info.base_size)
        self._step_decoder = TrackStepDecoder()
        self.poses = SessionPoses(info.view, locator=locator)
        """Where the camera is, and where tracks are on the ground."""
        self.last_status: Status | None = None
        self.levers = ""
        """What the edge last said that it sends beside the video, and why."""
        self.edge_failing: Mapping[str, int] = {}
        """Since when each part of the edge fails, by its clock: a report has the newest try."""
        self._log = SessionLog(self._emit, clock=clock)
        self._last_step = -1
        self._stepped_ns = self._status_ns = self._base_ns = 0
        """When the newest report of tracks came, the newest status, and the newest access unit."""
        self._results: tuple[StillResult, ...] = ()
        self._results_lock = threading.Lock()
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
        """What of this session was stored at the edge while the link was down."""

    # What the receiving thread brings

    def base(self, arrival: Arrival[Received]) -> bool:
        """Take one access unit; False where the decoder could make nothing of it."""
        header, item = arrival.header, arrival.message
        decode = arrival.verdict == "decode"
        self._note_capture(header.capture_ns, item.received_ns)
        at_ns = item.received_ns  # its own, also where it waited behind a hole
        delay_ms = self.reception.delay_ms(header.capture_ns, at_ns)
        self.reception.base(header, size_bytes=item.size_bytes, arrived_ns=at_ns, delay_ms=delay_ms)
        good = self._access_unit(header, item, decode=decode, starts_run=arrival.starts_run)
        self.reception.time(Channel.BASE, item, header, handled=good and decode)
        return good

    def _access_unit(self, header: BaseHeader, item: Received, *, decode: bool, starts_run: bool) -> bool:
        reception = self.reception
        reception.count(Channel.BASE, item, at_ns=header.send_ns)
        reception.frame(header)
        self._base_ns = self._clock()
        if not decode:
            return True
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
        if reference_ns is not None:
            reception.receive_latency.add(max(0.0, (item.received_ns - reference_ns) / _MILLION))
        self.worker.picture(DecodedFrame(header.frame_index, header.capture_ns, reference_ns, picture))
        reception.traffic(header, tracks=self.perceived.tracks, tracks_refined=self.perceived.refined)
        return True

    def still(self, header: RoiHeader, item: Received) -> None:
        """Take one still; a second one of the same number is counted and not shown, a third ignored."""
        reception, sequence, at_ns = self.reception, header.sequence, header.send_ns
        reception.still(sequence, size_bytes=item.size_bytes, arrived_ns=item.received_ns)
        if not reception.sequences.is_new(sequence, send_ns=at_ns):
            if reception.sequences.is_copy(sequence, send_ns=at_ns):
                reception.count(Channel.ROI, item, at_ns=at_ns)
            return
        reception.count(Channel.ROI, item, at_ns=at_ns)
        reception.time(Channel.ROI, item, header, handled=None)
        reception.stills += 1
        reception.ledger.record_outcome("received", header.reason)
        self.worker.still(ReceivedStill(header, item.payload))

    def tracks(self, step: TrackStep, item: Received) -> None:
        """Take a newer step of the edge's tracks. Raises `WireError` where its boxes make no sense."""
        now_ns = self._clock()
        if step.sequence <= self._last_step:
            if step.reference >= 0 or now_ns - self._stepped_ns < _ANEW_NS:
                return
            self._step_decoder = TrackStepDecoder()
        self._last_step, self._stepped_ns = step.sequence, now_ns
        self.reception.count(Channel.TRACKS, item, at_ns=step.send_ns)
        self.reception.steps += 1
        tracks = self._step_decoder.decode(step)
        self.reception.time(Channel.TRACKS, item, step, handled=tracks is not None)
        if tracks is not None:
            self.worker.step(tracks, step.capture_ns)

    def pose(self, report: PoseReport, item: Received) -> None:
        """Take a report of where the camera is. Raises `WireError` where its bits make no sense."""
        self.reception.count(Channel.POSE, item, at_ns=report.send_ns)
        pose = self.poses.report(report)
        self.reception.time(Channel.POSE, item, report, handled=pose is not None)
        if pose is not None:
            self.reception.pose_clock.note(pose.capture_ns, received_ns=item.received_ns)
            self.worker.pose(partial(self.poses.use, pose), pose.capture_ns)
            self._emit(PoseUpdate(max(0, self.reception.newest_index), pose.capture_ns, pose, self.info.view))
            self._note_stale(pose.capture_ns)

    def status(self, status: Status, item: Received) -> None:
        """Take the edge's report; one that is not newer than the last is ignored."""
        now_ns = self._clock()
        old = self.last_status is not None and status.sequence <= self.last_status.sequence
        if old and now_ns - self._status_ns < _ANEW_NS:
            return
        self._status_ns = now_ns
        self.reception.count(Channel.STATUS, item, at_ns=status.send_ns)
        self.reception.time(Channel.STATUS, item, status, handled=True)
        self.edge_failing = {
            one.part: self.edge_failing.get(one.part, one.failed_ns)
            for one in status.failed
            if not one.working
        }
        self.last_status = status
        self._note_stale(self.reception.newest_capture_ns)
        before, now = ([one for one, _ in lever_decisions(says)] for says in (self.levers, status.levers))
        self.levers = status.levers or self.levers
        if status.levers and now != before:  # numbers alone change each second: they are in the state
            self.note("info", " ".join(lever_sentences(status.levers)))

    def backlog_chunk(self, header: BacklogHeader, item: Received, *, delivered: bool) -> None:
        """Count a chunk, of whichever session; ``delivered``: with it an object was whole, and is of use."""
        self.reception.backlog(size_bytes=item.size_bytes, arrived_ns=item.received_ns)
        self.reception.count(Channel.BACKLOG, item, at_ns=header.send_ns)
        kind = f"{Channel.BACKLOG}-{header.kind}"
        self.reception.time(kind, item, header, handled=delivered)
        if delivered and header.kind == BacklogKind.STILL and header.session_id == self.info.session_id:
            self.reception.stored_still(header.number)

    def learn(self, info: Info) -> None:
        """Take the session's present `Info`: budget and method may have changed."""
        if (info.budget_bps, info.method) != (self.reception.budget_bps, self.method):
            self.note(
                "info",
                f"from now on the budget is {bitrate_text(info.budget_bps)}, and the method {info.method}",
            )
        self.reception.budget_bps, self.method = info.budget_bps, info.method

    def report_backlog(self) -> None:
        """Say in the recording how much of the backlog has come since the last time."""
        news = self.backlog.take_news()
        if news.first is not None and news.amount():
            at = time.strftime("%H:%M:%S", time.gmtime(news.first[1] // SECOND_NS))
            self.note("info", f"{news.amount()} from the outage at {at} UTC arrived")

    def note(self, level: Level, text: str, *, last: bool = False) -> None:
        """Put a line into the recording's log, unless there is a flood of them (`SessionLog`)."""
        self._log.note(
            level, text, at=(max(0, self.reception.newest_index), self.reception.newest_capture_ns), last=last
        )

    def close(self) -> None:
        """Finish what is queued (for a second or two) and close the sinks, each whatever the others do.

        Raises what went wrong on the way, or ended the worker.
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
        if self.not_sent:
            self.note("info", f"the edge did not send these stills: {counts_text(self.not_sent)}", last=True)
        ended = self.last_status is not None and self.last_status.state == "ended"
        self.note("info", "the flight has ended" if ended else "this session has ended", last=True)

    # What is known of it

    @property
    def pipeline(self) -> Pipeline:
        """Its perception; for the worker's thread, which makes it, and waits here until the models are open."""
        if self._pipeline is None:
            self._pipeline = self._make_pipeline()
        return self._pipeline

    @property
    def perceived(self) -> Pipeline | NothingPerceived:
        """The counts of perception, also before it is made."""
        return self._pipeline or NothingPerceived()

    def traffic(self, now_ns: int) -> Traffic | None:
        """The link's load; None before the first access unit, and where none has come lately."""
        fps = self.info.fps if self.last_status is None else self.last_status.coded_fps or self.info.fps
        lately_ns = max(_LATELY_NS, round(_FRAMES_LATELY * SECOND_NS / fps))
        return None if now_ns - self._base_ns > lately_ns else self.reception.last_traffic

    def health(self, now_ns: int) -> Health | None:
        """The edge's health; None before its first report, and where none has come lately."""
        if self.last_status is None or now_ns - self._status_ns > _LATELY_NS:
            return None
        return self.last_status.health

    @property
    def last_frame_index(self) -> int:
        """The last frame that was decoded, tracked and drawn; -1 before the first."""
        return self._analyzed[0]

    @property
    def not_sent(self) -> Mapping[str, int]:
        """Why candidates have no still: the edge's counts, by reason."""
        return {} if self.last_status is None else self.last_status.outcomes

    @property
    def is_whole(self) -> bool:
        """Whether all has come that the edge counted in its newest report."""
        last, messages = self.last_status, self.reception.ledger.messages
        if last is None:
            return False
        counted = (
            (self.reception.frames, last.base_messages),
            (messages(Account.ROI), last.roi_messages),
            (messages(Account.BACKLOG), last.backlog_messages),
            # A report does not count itself.
            (messages(Account.META), last.meta_messages + 1),
        )
        return all(received >= sent for received, sent in counted)

    @property
    def stills_dropped(self) -> Counter[str]:
        """Stills of which nothing was made, by reason."""
        return +(self.perceived.stills_dropped + self.worker.dropped)

    @property
    def idle(self) -> bool:
        """Nothing waits to be analyzed."""
        return self.worker.idle

    def take_resumed(self) -> bool:
        """Whether a recording goes on after a gap, and waits for a keyframe; True once."""
        resumed = [one.take_resumed() for one in self._queued]
        return any(resumed)

    # Reports

    def report_if_due(self) -> None:
        """Report to the edge, as often as what has arrived is worth it."""
        if self.reception.due(now_ns=self._clock()):
            self.report()

    def report(self) -> None:
        if self._reports is not None:
            self._reports.send(self._feedback)

    def _feedback(self, *, send_ns: int, **of_receiver: Any) -> Feedback:
        last_frame_index, objects_detected = self._analyzed
        return self.reception.feedback(
            send_ns,
            last_frame_index=last_frame_index,
            stills=self.take_results(MAX_STILL_RESULTS),
            objects_detected=min(objects_detected, _MOST_OBJECTS),
            **of_receiver,
        )

    def take_results(self, most: int) -> tuple[StillResult, ...]:
        """Return and forget up to ``most`` results that the edge has not been sent yet."""
        with self._results_lock:
            taken, self._results = self._results[:most], self._results[most:]
            return taken

    def _collect_results(self) -> None:
        with self._results_lock:
            self._results = (*self._results, *self.pipeline.take_results())[-_MOST_RESULTS:]

    def _note_capture(self, capture_ns: int, received_ns: int) -> None:
        if self.lockstep:
            return
        clock = self.reception.capture_clock
        was_sound = clock.is_sound
        clock.note(capture_ns, received_ns=received_ns)
        if was_sound and not clock.is_sound:
            off_s = abs(received_ns - self.clock_offset.to_local_ns(capture_ns)) // SECOND_NS
            self.note(
                "warning",
                f"the camera's clock is {off_s} s off: ages count from the arrival of pictures, and delays are not "
                "known",
            )

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
        self._analyzed = (picture.frame_index, self.pipeline.objects_detected)
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


Level = Literal["info", "warning", "error"]

_BURST, _EVERY_NS = 60, SECOND_NS
"""So many at once, then one a second."""


class SessionLog:
    """Gives out lines; in a flood of them some are left out, and counted. ``at``: frame index and capture time."""

    def __init__(self, emit: Callable[[Notice], None], *, clock: Callable[[], int]) -> None:
        self._emit, self._clock = emit, clock
        self._bucket = TokenBucket(burst=_BURST, every_ns=_EVERY_NS)
        self._left_out = 0

    def note(self, level: Level, text: str, *, at: tuple[int, int], last: bool = False) -> None:
        """Give out a line; one of the ``last`` is never left out."""
        if not (last or self._bucket.take(self._clock())):
            self._left_out += 1
            return
        if self._left_out:
            what = f"{self._left_out} lines were left out here: the edge gave rise to too many"
            self._left_out = 0
            self._emit(Notice(*at, "warning", what))
        self._emit(Notice(*at, level, text))
