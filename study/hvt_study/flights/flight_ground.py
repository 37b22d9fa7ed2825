"""The ground's end of a flight: takes messages when the link delivers them, and keeps the list of every frame."""

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from hvt_common.inference.classify import Classifier
from hvt_common.inference.detect import FailingDetector
from hvt_common.protocol import messages as wire
from hvt_common.protocol.channels import DELIVERIES, Channel, EdgeKeys, parse_key
from hvt_common.protocol.ledger import overhead_bytes
from hvt_common.runtime.failures import Failures
from hvt_common.transport.inbox import Received
from hvt_common.values import Tracks
from hvt_edge.perception.shadow import Detected
from hvt_ground.config import GroundConfig
from hvt_ground.events import Event, Overlay, Refinement
from hvt_ground.link.reassemble import Arrival as AccessUnitArrival
from hvt_ground.perception.models import DetectorThread, ModelFacts
from hvt_ground.perception.pipeline import DecodedFrame, ReceivedStill
from hvt_ground.perception.worker import Analyze, LockstepWorker, Read, Step
from hvt_ground.session.session import Session
from hvt_ground.wiring import Models, SessionPerception
from hvt_study.flights.flight_link import Arrival, SerialLink
from hvt_study.flights.flight_record import FlightRecord, Watch
from hvt_study.metrics.judged import FrameView
from hvt_study.metrics.observed import ObservedFrame

_MOST_RESULTS = 1024
_RECEIVER = 1 << 40  # as many bytes on the wire as a random one
_T = TypeVar("_T")


class InlineExecutor(ThreadPoolExecutor):
    """Does everything at once in the thread that asks: work that is parallel in flight comes one by one here."""

    def __init__(self) -> None:
        super().__init__(1)

    def submit(self, fn: Callable[..., _T], /, *args: Any, **kwargs: Any) -> Future[_T]:
        future: Future[_T] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


class SharedModels(Models):
    """Models that are open already, of this configuration; flights of one process share them."""

    def __init__(
        self,
        detector: FailingDetector,
        classifier: Classifier | None = None,
        *,
        config: GroundConfig | None = None,
    ) -> None:
        self._shared = detector, classifier
        self.facts = ModelFacts.of(config or GroundConfig())
        self.failures = Failures(time.time_ns)
        self.detector_thread = DetectorThread()

    def take(self) -> tuple[FailingDetector, Classifier | None]:
        return self._shared


class _Worker(LockstepWorker):
    """Sees at once; stills that come within one frame are read together, as in real time."""

    def __init__(self, analyze: Analyze, step: Step, read: Read, *, name: str) -> None:
        super().__init__(analyze, step, read, name=name)
        self._worker = InlineExecutor()
        self._gathered: list[ReceivedStill] = []

    def picture(self, picture: DecodedFrame) -> None:
        self.read_gathered()
        super().picture(picture)

    def still(self, still: ReceivedStill) -> None:
        if still.header.frame_index > self._newest_frame:
            super().still(still)  # it overtook its frame
        else:
            self._gathered.append(still)

    def step(self, tracks: Tracks, capture_ns: int) -> None:
        self._step(tracks, capture_ns)  # the simulated link leaves no doubt about the order

    def read_gathered(self) -> None:
        gathered, self._gathered = self._gathered, []
        if gathered:
            self._read(gathered)


class GroundSide:
    """Takes messages of ``link`` as time goes on; keeps the list of every frame, in source pixels.

    ``info`` is the edge's, with the rate of frames as its frame rate.
    """

    def __init__(
        self,
        info: wire.Info,
        *,
        config: GroundConfig,
        models: Models,
        link: SerialLink[Received],
    ) -> None:
        self._link = link
        self._info = info
        self._captures = wire.CaptureTimes()
        self.now_ns = info.started_ns
        detector, classifier = models.take()
        perception = SessionPerception(config, SharedModels(detector, classifier, config=config), info)
        self._session = Session(
            info,
            pipeline_of=lambda emit: perception.pipeline(self._observed_by(emit)),
            clock=lambda: self.now_ns,
            worker_of=self._make_worker,
        )
        self._watch = Watch(self._session.pipeline)
        self._record = FlightRecord(
            info.view,
            started_ns=info.started_ns,
            classes=len(detector.class_names),
            classifier=classifier,
        )
        self._newest = ObservedFrame()
        self._decoded = False
        self._behind_ns = 0
        """By how much the newest picture came after its capture."""
        self._uncoded: deque[tuple[int, int]] = deque()
        self.lists: dict[int, ObservedFrame] = {}
        self.results: deque[tuple[int, wire.StillResult]] = deque()
        """Answers to the edge, with the time at which it hears them."""
        self.detected: deque[tuple[int, Detected]] = deque()
        self.back_bytes = 0
        """Line bytes of the reports that say something of stills; the way back is not the budget's."""
        self.arrivals: list[Arrival[Received]] = []
        self.base_delays_ns: list[int] = []
        """Capture to arrival of every picture."""
        self.shown_ns: list[tuple[int, int]] = []
        """(arrival, capture) of every picture."""

    def pass_over(self, frame_index: int, *, capture_ns: int) -> None:
        """This frame is not coded; its list is taken when the others of its time are."""
        self._uncoded.append((frame_index, capture_ns))

    def advance(self, now_ns: int | None) -> None:
        """Take in messages that have arrived by now; None: all, to the end."""
        for arrival in self._link.arrived(now_ns):
            self._take_uncoded(until_ns=arrival.arrival_ns)
            self.now_ns = arrival.arrival_ns
            self.arrivals.append(arrival)
            self._receive(arrival)
            self._answer(arrival)
        self._worker.read_gathered()
        if self.arrivals:
            self._answer(self.arrivals[-1])
        self._take_uncoded(until_ns=now_ns)

    def close(self) -> None:
        """Take in the rest and end the session."""
        self.advance(None)
        self._session.close()
        if self.lists:
            last = max(self.lists)
            self.lists[last] = self._record.complete(self.lists[last], lists=self.lists)

    def _make_worker(self, analyze: Analyze, step: Step, read: Read) -> LockstepWorker:
        self._worker = _Worker(analyze, step, read, name=self._info.edge)
        return self._worker

    def _receive(self, arrival: Arrival[Received]) -> None:
        """As `hvt_ground.link.receiver` hands on whole messages in order."""
        item = arrival.message
        row = (parse_key(item.key) or ("", None))[1]
        if row is Channel.BASE:
            base = wire.BaseHeader.parse(item.attachment, item.payload)
            self._captures.note(base)
            self._picture(base, arrival)
        elif row is Channel.ROI:
            header = wire.RoiHeader.parse(item.attachment, item.payload)
            header = self._captures.filled(header, otherwise_ns=arrival.arrival_ns - header.send_delay_ns)
            header = header.named(self._info.class_names)
            self._record.still(header, arrival)
            self._session.take(header, item)
        elif row is Channel.TRACKS:
            self._session.take(wire.TrackStep.parse(item.payload), item)
        elif row is Channel.STATUS:
            self._session.take(wire.Status.parse(item.payload), item)

    def _answer(self, last: Arrival[Received]) -> None:
        """The answers of the ground go back in the time that the newest message took to come."""
        back_ns = self.now_ns + (last.arrival_ns - last.enter_ns)
        results = self._session.reception.take_results(_MOST_RESULTS)
        self._record.answers(results)
        for first in range(0, len(results), wire.MAX_STILL_RESULTS):
            self.back_bytes += self._weight(results[first : first + wire.MAX_STILL_RESULTS])
        self.results.extend((back_ns, one) for one in results)
        objects = self._session.pipeline.objects_detected
        if objects >= 0:
            self.detected.append((back_ns, Detected(_RECEIVER, self._session.reception.analyzed[0], objects)))

    def _weight(self, results: tuple[wire.StillResult, ...]) -> int:
        """Line bytes of a report with these, as `hvt_ground.session.edge_port` would send it."""
        frames, stills = self._session.reception.frames, self._session.reception.stills
        payload = wire.Feedback(
            session_id=self._info.session_id,
            receiver_id=_RECEIVER,
            sequence=frames,
            send_ns=self.now_ns,
            last_frame_index=self._session.reception.analyzed[0],
            base_messages=frames,
            base_bytes=self._session.reception.ledger.base_bytes,
            roi_messages=stills,
            roi_bytes=self._session.reception.ledger.roi_bytes,
            lost=0,
            corrupt=0,
            base_sequence=frames - 1,
            base_held_us=0,
            still_sequence=stills - 1,
            missing_stills=(),
            delay_p50_ms=self._behind_ns / 1e6,
            clock_offset_ns=0,
            clock_error_ns=0,
            stills=results,
            backlog=(),
            objects_detected=self._session.pipeline.objects_detected,
        ).pack()
        key, encoding = EdgeKeys(self._info.edge)[Channel.FEEDBACK], DELIVERIES[Channel.FEEDBACK].encoding
        return len(payload) + overhead_bytes(len(payload), 0, key=key, encoding=encoding)

    def _picture(self, header: wire.BaseHeader, arrival: Arrival[Received]) -> None:
        while self._uncoded and self._uncoded[0][0] < header.frame_index:
            self._take_list(self._uncoded.popleft()[0], at_ns=arrival.arrival_ns)
        self._behind_ns = arrival.arrival_ns - header.capture_ns
        self.base_delays_ns.append(self._behind_ns)
        self.shown_ns.append((arrival.arrival_ns, header.capture_ns))
        starts = not self._decoded
        self._decoded = True
        item = arrival.message
        unit = AccessUnitArrival("decode", header, item, arrival.arrival_ns, starts_run=starts)
        whole = self._session.base(unit)
        assert whole, f"the base frame {header.frame_index} cannot be decoded"
        self._answer(arrival)
        found = self._watch.take_found()
        detections = None if found is None else self._record.detected(found, self._watch.class_names)
        self._put_down(header.frame_index, at_ns=arrival.arrival_ns, detections=detections)

    def _take_uncoded(self, *, until_ns: int | None) -> None:
        while self._uncoded:
            frame_index, capture_ns = self._uncoded[0]
            at_ns = capture_ns + self._behind_ns
            if until_ns is not None and at_ns > until_ns:
                return
            self._uncoded.popleft()
            self._take_list(frame_index, at_ns=at_ns)

    def _take_list(self, frame_index: int, *, at_ns: int) -> None:
        """The list that an operator sees at a frame of which no picture comes."""
        if self._decoded:
            self._note(self._session.pipeline.list_at(frame_index))
        self._put_down(frame_index, at_ns=at_ns)

    def _put_down(self, frame_index: int, *, at_ns: int, detections: FrameView | None = None) -> None:
        self.lists[frame_index] = self._record.complete(
            self._newest, lists=self.lists, at_ns=at_ns, detections=detections
        )

    def _observed_by(self, emit: Callable[[Event], None]) -> Callable[[Event], None]:
        def tell(event: Event) -> None:
            if isinstance(event, Overlay):
                self._note(event)
            elif isinstance(event, Refinement):
                self._record.refinement(event, at_ns=self.now_ns)
            emit(event)

        return tell

    def _note(self, overlay: Overlay) -> None:
        tracks = self._watch.listed
        assert tracks is not None, "a list was made of some"
        self._newest = self._record.listed(overlay, tracks)
