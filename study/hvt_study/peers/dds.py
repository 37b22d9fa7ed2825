"""A server-driven two-pass peer in the manner of DDS, on our codec, our link and our accounting.

Du et al., "Server-Driven Video Streaming for Deep Learning Inference", SIGCOMM 2020. The edge sends every frame at a
low quality; the ground looks at a segment of them, keeps sure objects and asks for the regions of unsure ones; the
edge codes the same frames again with these regions alone, the rest black; the ground pastes them into the first pass,
looks again, and merges both into the final results, over which a tracker runs. docs/design-notes/dds.md lists the
differences from DDS.

Every byte counts, once: the first pass as ``base``, the second as ``roi``, requests of the ground as ``control``. All
of it stays within the budget in every rolling window, and over the clip: the last second pass, which comes after the
clip's end, is cut short where it would go beyond.
"""

from collections import deque
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from itertools import groupby

import cv2
import numpy as np

from hvt_common.inference.detect import Detector
from hvt_common.protocol.channels import Channel
from hvt_common.tracking.bytetrack import ByteTracker
from hvt_common.tracking.settings import TrackerSettings
from hvt_common.values import AccessUnit, Detections, Frame, Image, Tracks, View
from hvt_common.video.hevc import BaseDecoder
from hvt_edge.link.budget import RollingBudget
from hvt_edge.source.resample import Resizer
from hvt_study.datasets.labels import inside_frame
from hvt_study.datasets.sequence import NOMINAL_FPS, Clip, FrameSource
from hvt_study.flights.flight import FlightReport, coded_frames, picture_age_p95_ms
from hvt_study.flights.flight_link import START_NS, LinkReport, frame_ns
from hvt_study.metrics.judged import FrameView
from hvt_study.metrics.observed import ObservedFrame
from hvt_study.peers.dds_edge import DdsEdge, Line, most_stored, pass_rates
from hvt_study.peers.dds_regions import (
    Blocks,
    DdsSettings,
    RegionRequest,
    combined,
    pasted,
    requested_blocks,
    requested_boxes,
)


@dataclass(slots=True)
class _Held:
    """A frame that is not finished."""

    frame_index: int
    capture_ns: int
    picture_bgr: Image
    found: Detections
    """Detections of the first pass; of both once the second has come."""
    blocks: Blocks
    whole: bool = False


@dataclass(slots=True)
class DdsGround:
    """Takes the messages of the line; frames are finished in order, each when the pass that completes it is there.

    A frame about which nothing is asked is complete with its segment's question, that is when the last frame of the
    segment is there; one that the edge had to leave out, when a later one comes. Between two coded frames the list is
    foretold by the tracker.
    """

    detector: Detector
    settings: DdsSettings
    view: View
    segments: Sequence[tuple[int, ...]]
    line: Line
    started_ns: int
    lists: dict[int, ObservedFrame] = field(default_factory=dict)
    delays_ns: list[int] = field(default_factory=list)
    """Delay of every coded frame, in order: capture to the arrival that finished it."""
    shown_ns: list[tuple[int, int]] = field(default_factory=list)
    """(arrival, capture) of every picture of the first pass."""
    requests: deque[tuple[int, bytes]] = field(default_factory=deque)
    """Requests to the edge, with the time at which it hears them."""
    _held: dict[int, _Held] = field(default_factory=dict)
    _last_frames: dict[int, tuple[int, ...]] = field(init=False)
    _first: BaseDecoder = field(init=False)
    _second: BaseDecoder = field(init=False)
    _tracker: ByteTracker = field(init=False)
    _listed_to: int = 0
    _at_ns: int = 0

    def __post_init__(self) -> None:
        size = self.view.base_size
        self._last_frames = {frames[-1]: frames for frames in self.segments}
        self._first, self._second = BaseDecoder(size=size), BaseDecoder(size=size)
        tracking = TrackerSettings.starting_at(
            self.settings.confidence, camera_motion=self.settings.camera_motion
        )
        self._tracker = ByteTracker(tracking, fps=NOMINAL_FPS)

    def advance(self, now_ns: int) -> None:
        for arrival in self.line.arrived(now_ns):
            self._at_ns = arrival.arrival_ns
            for unit in arrival.message.units:
                if arrival.message.row is Channel.BASE:
                    self._first_pass(unit)
                else:
                    self._second_pass(unit)
            self._finish()

    def close(self, *, frames: int) -> None:
        """Nothing more comes: finish the rest, and list every frame up to the last."""
        for held in self._held.values():
            held.whole = True
        self._finish()
        self._list_between(frames)

    def _first_pass(self, unit: AccessUnit) -> None:
        self.shown_ns.append((self._at_ns, unit.capture_ns))
        picture = self._full(_decoded(self._first, unit))
        found = self.detector.detect(picture)
        size = self.view.base_size
        regions = requested_boxes(found, size=size, settings=self.settings)
        blocks = requested_blocks(regions, size=size, align_px=self.settings.align_px)
        frame_index = unit.frame_index
        self._held[frame_index] = _Held(frame_index, unit.capture_ns, picture, found, blocks)
        if frame_index in self._last_frames:
            self._request(self._last_frames[frame_index])
        if len(self._held) > most_stored(self.settings) + self.settings.segment_frames:
            next(iter(self._held.values())).whole = True

    def _request(self, frames: tuple[int, ...]) -> None:
        """Request regions of a whole segment at once, as DDS does."""
        segment = [self._held[frame_index] for frame_index in frames]
        for one in segment:
            one.whole = not one.blocks.any()
        if not all(one.whole for one in segment):
            payload = RegionRequest(frames[0], tuple(one.blocks for one in segment)).pack()
            self.requests.append((self.line.send_request(payload, now_ns=self._at_ns), payload))

    def _second_pass(self, unit: AccessUnit) -> None:
        over = _decoded(self._second, unit)
        for held in self._held.values():
            if held.frame_index < unit.frame_index and not held.whole:
                held.whole = True  # the edge had to leave it out
        mine = self._held.get(unit.frame_index)
        if mine is None or mine.whole:
            return
        mine.picture_bgr = pasted(mine.picture_bgr, over, mine.blocks, align_px=self.settings.align_px)
        again = self.detector.detect(mine.picture_bgr)
        mine.found = combined(mine.found, again, settings=self.settings)
        mine.whole = True

    def _finish(self) -> None:
        while self._held:
            one = next(iter(self._held.values()))
            if not one.whole:
                return
            del self._held[one.frame_index]
            self._list_between(one.frame_index)
            tracks = self._tracker.update(one.found, frame_index=one.frame_index, image=one.picture_bgr)
            self.lists[one.frame_index] = self._seen(tracks, found=one.found)
            self.delays_ns.append(self._at_ns - one.capture_ns)
            self._listed_to = one.frame_index + 1

    def _list_between(self, frame_index: int) -> None:
        """Those before ``frame`` that were not coded."""
        for between in range(self._listed_to, frame_index):
            self.lists[between] = self._seen(self._tracker.extrapolated(frame_index=between))
        self._listed_to = max(self._listed_to, frame_index)

    def _seen(self, tracks: Tracks, *, found: Detections | None = None) -> ObservedFrame:
        names = self._names(tracks.class_ids)
        confidences = tracks.confidences.astype(np.float32)
        return ObservedFrame(
            *(self._inside(tracks.boxes_xyxy_px), tracks.ids, names, confidences, names),
            confidences_before=confidences,
            origins=("base",) * len(names),
            shown_s=(self._at_ns - self.started_ns) / 1e9,
            detections=None
            if found is None
            else FrameView.plain(
                self._inside(found.boxes_xyxy_px), self._names(found.class_ids), found.confidences
            ),
        )

    def _names(self, class_ids: np.ndarray[tuple[int], np.dtype[np.int32]]) -> tuple[str, ...]:
        return tuple(self.detector.class_names[kind] for kind in class_ids.tolist())

    def _inside(self, boxes_base_px: np.ndarray) -> np.ndarray:
        return inside_frame(self.view.to_source(boxes_base_px), self.view.source_size)

    def _full(self, picture: Image) -> Image:
        size = self.view.base_size
        if (picture.shape[1], picture.shape[0]) == size:
            return picture
        return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC), np.uint8)


def _decoded(decoder: BaseDecoder, unit: AccessUnit) -> Image:
    picture = decoder.decode(unit.data)
    assert picture is not None, f"frame {unit.frame_index} cannot be decoded"
    return picture


_LONGEST_TAIL_S = 30
"""How long after the clip the last second pass may take."""


def fly_dds(
    clip: Clip,
    *,
    budget_bps: int,
    link_bps: int,
    size: tuple[int, int],
    detector: Detector,
    settings: DdsSettings = DdsSettings(),  # noqa: B008 - frozen
) -> FlightReport:
    """Fly the peer once; ``detector`` is the ground's, ``size`` (width, height) that of the base frames.

    The list of a frame is the final one of that very frame, as an operator sees it when it is known, which is later
    than with a stream that is shown as it comes: the delays of ``FlightReport.link`` are, for each coded frame, from
    capture to the arrival of the pass that completes it (segment, question, second pass, and the frames before it).
    ``picture_age_p95_ms`` is of the newest picture at the ground, that of a first pass, as in
    `hvt_study.flights.flight.fly`. Raises `UserError` where the budget is too small for two passes of this size and
    frame rate.
    """
    rates = pass_rates(budget_bps, size=size, settings=settings)
    line = Line(link_bps=link_bps, budget=RollingBudget(rates.budget), window_ns=settings.window_ns)
    coded = coded_frames(clip.frame_count, settings.fps)
    segments = _segments(coded, settings.segment_frames)
    most_bytes = int(budget_bps * clip.frame_count / NOMINAL_FPS / 8)
    resizer = Resizer(clip.source_size, size, fit="letterbox")
    edge = DdsEdge(rates, size=size, settings=settings, segments=segments, line=line, most_bytes=most_bytes)
    ground = DdsGround(detector, settings, resizer.view, segments, line, started_ns=frame_ns(0))
    with closing(_by_frame(FrameSource(clip, resizer, frames=coded), clip.frame_count)) as frames:
        for now_ns, frame in frames:
            ground.advance(now_ns)
            while ground.requests and ground.requests[0][0] <= now_ns:
                edge.on_request(ground.requests.popleft()[1])
            if frame is not None:
                edge.first_pass(frame)
            edge.second_pass(now_ns)
            if now_ns > frame_ns(clip.frame_count) and edge.idle and line.empty and not ground.requests:
                break
    ground.close(frames=clip.frame_count)
    return _report(clip.frame_count, edge=edge, ground=ground, line=line)


def _segments(coded: frozenset[int], segment_frames: int) -> tuple[tuple[int, ...], ...]:
    """The coded frames of each segment that has any."""
    return tuple(
        tuple(frames)
        for _, frames in groupby(sorted(coded), key=lambda frame_index: frame_index // segment_frames)
    )


def _by_frame(source: FrameSource, frames: int) -> Generator[tuple[int, Frame | None], None, None]:
    """(time, frame to code) of every frame, and empty ones after the clip for messages still to come."""
    frame_index = 0
    for frame in source.frames(start_ns=START_NS):
        for between in range(frame_index, frame.index):
            yield frame_ns(between), None
        yield frame.capture_ns, frame
        frame_index = frame.index + 1
    for after in range(frame_index, frames + round(_LONGEST_TAIL_S * NOMINAL_FPS)):
        yield frame_ns(after), None


def _report(frames: int, *, edge: DdsEdge, ground: DdsGround, line: Line) -> FlightReport:
    return FlightReport(
        lists=tuple(ground.lists[frame_index] for frame_index in range(frames)),
        account=line.ledger.summary(frames / NOMINAL_FPS),
        line_bytes=dict(line.line_bytes),
        messages=dict(line.messages),
        max_frame_bytes=line.max_frame_bytes,
        link=LinkReport.of(ground.delays_ns, line.arrivals),
        picture_age_p95_ms=picture_age_p95_ms(ground.shown_ns, frames),
        edge_cpu_ms=1e3 * edge.cpu_s / frames,
        digest=line.digest,
    )
