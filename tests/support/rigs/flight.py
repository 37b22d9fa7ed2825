"""A small real flight for the ground: access units and stills with their headers, as the link delivers them."""

import itertools
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np

from hvt_common.inference.scale_search import ScaleSearch
from hvt_common.inference.store import MOTION
from hvt_common.inference.view_trust import ViewTrust
from hvt_common.protocol.channels import MSGPACK_ENCODING
from hvt_common.protocol.ledger import overhead_bytes
from hvt_common.protocol.messages import BaseHeader, Feedback, Flags, Info, TrackStepEncoder
from hvt_common.tracking.bytetrack import ByteTracker
from hvt_common.tracking.settings import TrackerSettings
from hvt_common.transport.inbox import Inbox, Received
from hvt_common.values import Detections, Image, Posterior, Tracks, View
from hvt_common.video.hevc import Picture
from hvt_edge.video.encoder import EncoderSettings
from hvt_edge.video.x265 import BaseEncoder
from hvt_ground.config import GroundConfig
from hvt_ground.perception.fusion.entity import CameraPath
from hvt_ground.perception.fusion.fuse import Fusion, unified_names
from hvt_ground.perception.guesses import Guesses
from hvt_ground.perception.models import Detection, DetectorThread, ModelFacts, Models
from hvt_ground.perception.pipeline import Pipeline
from hvt_ground.perception.session import SessionPerception
from hvt_ground.perception.stills.classify import FrameReadings, ObjectReading
from hvt_ground.perception.stills.decode import DecodedStill
from hvt_ground.perception.stills.refine import Refiner, ViewTilt
from hvt_ground.perception.stills.vocabulary import Vocabulary
from hvt_ground.perception.worker import RealtimeWorker
from media.clips import START_NS, framed, smooth_pictures
from programs.processes import PATIENT_S
from rigs import messages
from rigs.examples import tracks_of

SIZE = (320, 192)
CLASSES = ("car", "bus")
_ids = itertools.count(1000)
_NO_TIMES: Any = dict.fromkeys(("encode_ms", "detect_ms", "cores_needed", "cores_free"), 0.0)
_IDLE = replace(
    messages.HEALTH,
    **dict.fromkeys(("frames_dropped", "tracks", "base_queue", "still_queue"), 0),
    **dict.fromkeys(("frames_dropped_cpu", "frames_unanalyzed"), 0),
    **_NO_TIMES,
    keyframes=1,
    feedback_age_ms=-1,
)


def square_box(index: int) -> tuple[float, float, float, float]:
    """Where `smooth_pictures` draws the red square in this picture."""
    left = (7 * index) % (SIZE[0] - 40)
    return float(left), SIZE[1] / 3, left + 32.0, SIZE[1] / 3 + 32.0


def grainy_pictures(count: int) -> list[np.ndarray]:
    """`smooth_pictures` with a grain on the square, of which a thin base shows little: stills tell something."""
    pictures, rng = smooth_pictures(count, size=SIZE), np.random.default_rng(4)
    for index, picture in enumerate(pictures):
        x1, y1, x2, y2 = np.asarray(square_box(index), int)
        picture[y1:y2, x1:x2, 1] = rng.integers(0, 120, (y2 - y1, x2 - x1), np.uint8)
    return pictures


def tracks_at(index: int, boxes: dict[int, tuple[float, float, float, float]], *, class_id=0) -> Tracks:
    """A tracker's list at a frame: all of one class, at 0.8."""
    return tracks_of(index, boxes, confidences=0.8, classes=class_id, born=index)


class RedSquares:
    """A detector of red things; it may be slow."""

    class_names = CLASSES
    confidence = 0.9

    def __init__(self, *, takes_s: float = 0.0) -> None:
        self.takes_s = takes_s

    def detect(self, image_bgr: Image) -> Detections:
        time.sleep(self.takes_s)
        low, high = np.array([0, 0, 170], np.uint8), np.array([110, 130, 255], np.uint8)
        ys, xs = np.nonzero(cv2.inRange(image_bgr, low, high))
        if len(xs) < 100:
            return Detections.none()
        box = np.array([[xs.min(), ys.min(), xs.max() + 1, ys.max() + 1]], np.float32)
        return Detections(box, np.array([self.confidence], np.float32), np.zeros(1, np.int32))


class NothingSeen:
    """A detector to which all is too small."""

    class_names = CLASSES

    def __init__(self) -> None:
        self.runs = 0

    def detect(self, _image_bgr: Image) -> Detections:
        self.runs += 1
        return Detections.none()


@dataclass
class SameAnswer:
    """Reads every object in a still as a bus, or as nothing; keeps which frames' pictures it was given."""

    class_names: tuple[str, ...] = CLASSES
    knows: bool = True
    confidence: float = 0.9
    wants_base: bool = False
    had_base: list[bool] = field(default_factory=list)
    found: Detections = field(default_factory=Detections.none)
    """What it sees besides, in each frame with stills."""
    at: tuple[float, float, float, float] | None = None
    """Where it sees every object."""

    def read(self, stills: Sequence[DecodedStill], base_bgr: Image | None) -> FrameReadings:
        self.had_base += [base_bgr is not None] * len(stills)
        probabilities = np.array([1 - self.confidence, self.confidence], np.float32)
        answer = Posterior(self.class_names[1], self.confidence, 0.3, probabilities)
        reading = ObjectReading(answer, self.at) if self.knows else ObjectReading()
        return FrameReadings(tuple((reading,) * len(one.boxes_base_px) for one in stills), self.found)


class DetectsAtOnce(DetectorThread):
    """In the thread that asks, so that no list goes out without what its picture shows, however busy the machine."""

    def submit(self, picture: Picture, detect: Callable[[Picture], Detections]) -> Detection:
        detection = Detection(picture, detect)
        detection.run()
        return detection


patient_worker = partial(
    RealtimeWorker, name="test", clock=lambda: 0.0, finish_s=PATIENT_S, leave_s=PATIENT_S
)
"""No picture is too old for it, and at its end it leaves nothing, however busy the machine is."""


def pipeline_of(
    emit,
    *,
    detector=None,
    reader=None,
    detect_every: int = 1,
    detect_still_every: int = 0,
    edge_classes: Sequence[str] = CLASSES,
    trust: ViewTrust | None = None,
    tilt: ViewTilt | None = None,
    guesses: Guesses | None = None,
    search: ScaleSearch | None = None,
    detector_thread: DetectorThread | None = None,
) -> Pipeline:
    reader = reader or SameAnswer()
    names, places = unified_names(CLASSES, edge_classes)
    return Pipeline(
        detector=detector or RedSquares(),
        tracker=ByteTracker(
            TrackerSettings.starting_at(0.25, camera_motion="flow" if detect_still_every else "off"), fps=15
        ),
        reader=reader,
        refiner=Refiner("replace", fps=15, vocabulary=Vocabulary(names, reader.class_names), tilt=tilt),
        fusion=Fusion(fps=15, edge_classes=places, path=CameraPath(ahead_frames=15)),
        detector_thread=detector_thread or DetectsAtOnce(),
        trust=trust or ViewTrust(None, hence=""),
        edge_alike=tuple(edge_classes) == CLASSES,
        guesses=guesses,
        search=search,
        view=View.fitted(SIZE, SIZE, fit="letterbox"),
        fps=15,
        detect_every=detect_every,
        detect_still_every=detect_still_every,
        emit=emit,
    )


class StoredPerception(SessionPerception):
    """Looks at each third stored picture with ``detector_of()``, and reads every still as a bus."""

    def __init__(
        self,
        info: Info,
        *,
        detector_of: Callable[[], RedSquares] = RedSquares,
        trust: ViewTrust | None = None,
        tilt: ViewTilt | None = None,
    ) -> None:
        self._detector_of = detector_of
        facts = ModelFacts(track_confidence=0.25, calibrated=tilt is not None, stills_calibrated=False)
        config = GroundConfig(detector=MOTION, detect_every=3, camera_motion="off")
        super().__init__(config, cast("Models", SimpleNamespace(facts=facts)), info)
        self._trust, self.tilt = trust or self._trust, tilt or self.tilt

    def _taken(self) -> tuple[RedSquares, SameAnswer]:
        return self._detector_of(), SameAnswer()


class Flight:
    """One session of an edge: its messages by frame."""

    def __init__(
        self,
        count: int,
        *,
        keyframes: Sequence[int] = (),
        pace: str = "realtime",
        size=SIZE,
        session_id: int | None = None,
    ) -> None:
        self.session_id, self.pace, self.size = session_id or next(_ids), pace, size
        encoder = BaseEncoder(EncoderSettings(size=size, fps=15, bitrate_bps=300_000, preset="ultrafast"))
        self.pictures = smooth_pictures(count, size=size)
        self.units = [
            encoder.encode(frame, keyframe=frame.index in keyframes) for frame in framed(self.pictures)
        ]
        self._statuses = 0
        self._steps = TrackStepEncoder(session_id=self.session_id)

    def info(self) -> Info:
        now = time.time_ns()
        return replace(
            messages.INFO,
            session_id=self.session_id,
            software="0",
            started_ns=START_NS,
            source_size=SIZE,
            base_size=SIZE,
            view_scale=1.0,
            pace=self.pace,
            class_names=CLASSES,
            received_ns=now,
            answered_ns=now,
            still_codecs=(),
            channels=(),
        )

    def base(self, index: int) -> Received:
        unit = self.units[index]
        header = BaseHeader(
            session_id=self.session_id,
            sequence=index,
            frame_index=index,
            capture_ns=unit.capture_ns,
            send_delay_ns=20_000_000,
            flags=int(Flags.KEYFRAME | Flags.PARAMETER_SETS) if unit.keyframe else 0,
        )
        return _received("base", unit.data, header.pack(unit.data), "video/h265")

    def still(self, index: int, sequence: int, *, data: bytes | None = None, **changes) -> Received:
        x1, y1, x2, y2 = square_box(index)
        crop = (int(x1), int(y1), int(x2), int(y2))
        if data is None:
            pixels = self.pictures[index][crop[1] : crop[3], crop[0] : crop[2]]
            data = cv2.imencode(".jpg", pixels)[1].tobytes()
        header = replace(
            messages.PLAIN,
            session_id=self.session_id,
            sequence=sequence,
            frame_index=index,
            capture_ns=self.units[index].capture_ns,
            send_delay_ns=30_000_000,
            track_id=1,
            box_source_px=(x1, y1, x2, y2),
            crop_source_px=crop,
            class_name="car",
            confidence=0.5,
            reason="utility",
        )
        return _received("roi", data, replace(header, **changes).pack(data), "image/jpeg")

    def step(self, index: int, listed: dict[int, tuple[float, float, float, float]], **changes) -> Received:
        """What the edge tracked at a frame, ``{track id: box}``: all cars at 0.8."""
        tracks = tracks_at(index, listed)
        step = self._steps.encode(tracks, capture_ns=self.units[index].capture_ns, send_delay_ns=25_000_000)
        return _received("tracks", replace(step, **changes).pack(), b"", MSGPACK_ENCODING)

    def status(
        self, *, base: int, roi: int = 0, backlog: int = 0, state: str = "running", meta: int = 0
    ) -> Received:
        self._statuses += 1
        counts: dict[str, Any] = dict.fromkeys(
            ("base_bytes", "roi_bytes", "backlog_bytes", "meta_bytes", "overhead_bytes"), 0
        )
        counts |= {name: {} for name in ("sent", "deferred", "dropped")}
        report = replace(
            messages.STATUS,
            session_id=self.session_id,
            sequence=self._statuses,
            state=state,
            send_ns=START_NS + self._statuses * 1_000_000_000,
            media_ns=0,
            last_base_sequence=base - 1,
            last_still_sequence=roi - 1,
            base_messages=base,
            roi_messages=roi,
            backlog_messages=backlog,
            meta_messages=meta,
            **counts,
            health=replace(_IDLE, frames_captured=base, frames_encoded=base),
            failed=(),
            decisions="",
        )
        return _received("status", report.pack(), b"", "")


def line_bytes(items: Iterable[Received]) -> int:
    return sum(
        one.size_bytes
        + overhead_bytes(len(one.payload), len(one.attachment), key=one.key, encoding=one.encoding)
        for one in items
    )


def _received(row: str, payload: bytes, attachment: bytes, encoding: str) -> Received:
    return Received(f"hvt/uav-1/{row}", payload, attachment, encoding, time.time_ns())


class Port:
    """An edge as the link knows it, in this process: what `EdgePort` is over Zenoh."""

    def __init__(self) -> None:
        self.edge = "uav-1"
        self.inbox = Inbox(capacity=1024)
        self.present = threading.Event()
        self.present.set()
        self.used = threading.Event()
        self.flight: Flight | None = None
        """Who answers; None is silence."""
        self.requested = 0
        self.keyframe_requests = 0
        self.reports: list[Feedback] = []
        self.clock_requests: list[int] = []
        """Sessions that were asked for their time, in passing."""
        self.broken: Exception | None = None
        """What a callback hands over."""

    def query_info(self, session_id: int | None = None) -> tuple[Info, int, int] | None:
        """The flight's facts, where it is the one that is asked for."""
        self.requested += 1
        now = time.time_ns()
        if self.flight is None or session_id not in (None, self.flight.session_id):
            return None
        return self.flight.info(), now, time.time_ns()

    def request_keyframe(self) -> None:
        self.keyframe_requests += 1

    def report(self, feedback: Feedback) -> None:
        self.reports.append(Feedback.parse(feedback.pack()))

    def request_info(self, session_id: int) -> None:
        self.clock_requests.append(session_id)

    def take_info(self) -> tuple[Info, int, int] | None:
        return self.query_info(self.clock_requests.pop()) if self.clock_requests else None

    def raise_error(self) -> None:
        broken, self.broken = self.broken, None
        if broken is not None:
            raise broken
