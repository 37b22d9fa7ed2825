"""The tracks on every source frame, from the edge's own decoded stream or from the source itself."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from hvt_common.inference.detect import FailingDetector
from hvt_common.inference.retried import without_tiles
from hvt_common.inference.scale_search import ScaleSearch
from hvt_common.inference.view_trust import ViewTrust
from hvt_common.runtime.statistics import SequenceWindow
from hvt_common.tracking.bytetrack import ByteTracker
from hvt_common.values import AccessUnit, Detections, Frame, Image, Tracks, View
from hvt_common.video.hevc import BaseDecoder, Picture, YuvPicture
from hvt_edge.perception.cpu_budget import CpuBudget


@dataclass(frozen=True, slots=True)
class AnalyzedFrame:
    """One source frame with its base picture, its tracks and the state of detection."""

    frame: Frame
    base: Picture | None
    """The decoded base frame, as the ground has it: a still may build on it. None where the frame is not coded: no
    still applies to it then."""
    tracks: Tracks
    detected: bool
    """Whether this is a decision step: the detector ran on this frame."""
    tracked: bool = True
    """False where nobody would use the results: the frame was neither decoded nor searched, and has no tracks."""
    scene_began: int = -1
    """The newest frame with which another scene began, by the tracker; -1 before any."""
    _bgr: list[Image] = field(default_factory=list, compare=False, repr=False)

    @property
    def base_bgr(self) -> Image | None:
        """`base` in BGR, converted once: only decision steps use it."""
        if self.base is None:
            return None
        if not self._bgr:
            self._bgr.append(self.base.bgr() if isinstance(self.base, YuvPicture) else self.base)
        return self._bgr[0]


class Analyzer:
    """Decodes the edge's own access units, detects on every n-th frame and tracks on each.

    ``candidates`` says on which pixels the detector runs and the tracker follows the camera. "source" means before
    coding, at the finer of the two sizes: a source that the base enlarges is analyzed enlarged, as by the ground's
    detector, which finds less in fewer pixels. ``detect_every`` counts source frames from one detection to the next,
    see `analyze` for streams that code fewer; up to ``detect_still_every`` while nothing changes.

    While the detector gives None the tracks are carried on. ``trust`` receives its detections. ``search`` finds the
    scale; without it the scale is as given. A detection that is due waits until ``cpu_budget`` admits it, and may get
    a smaller input there, without tiles or search, where it ``reduces`` and nothing is enlarged; decoding and
    tracking never wait.
    """

    def __init__(
        self,
        detector: FailingDetector,
        tracker: ByteTracker,
        *,
        view: View,
        detect_every: int = 5,
        candidates: Literal["decoded", "source"] = "decoded",
        detect_still_every: int = 0,
        trust: ViewTrust | None = None,
        search: ScaleSearch | None = None,
        cpu_budget: CpuBudget | None = None,
        reduces: bool = True,
    ) -> None:
        self._reduces = reduces
        self._detector, self._detect_whole = detector, without_tiles(detector)
        self._tracker = tracker
        self._view = view
        self._every, self._still_every, self._candidates = detect_every, detect_still_every, candidates
        self._trust = trust
        self._search = search
        self.cpu_budget = cpu_budget or CpuBudget()
        self._decoder = BaseDecoder()
        self._detected_index: int | None = None
        self.detected_ns: int | None = None
        """Capture time of the newest frame that was searched for objects; None before the first."""
        self._coded_index: int | None = None
        self._coded_gap = 1
        self._track_ids = SequenceWindow()
        self.spent_ns = 0
        self.frames = 0

    @property
    def detect_every(self) -> int:
        """Source frames from one detection to the next, if there is time for it and all of them are coded."""
        return self._every if self._search is None else self._search.interval(self._every)

    @property
    def view_unlike(self) -> bool:
        return self._trust is not None and self._trust.unlike

    @property
    def tracks(self) -> int:
        return self._track_ids.count

    @property
    def mean_ms(self) -> float:
        """Mean time to decode, detect and track, over all frames."""
        return self.spent_ns / max(1, self.frames) / 1e6

    def analyze(
        self, frame: Frame, unit: AccessUnit | None, *, skipped: Sequence[AccessUnit] = ()
    ) -> AnalyzedFrame:
        """Analyze the next source frame; ``unit`` is None where it is not coded.

        Detection is due ``detect_every`` frames after the last one. With candidates of the decoded stream that can
        only be a coded frame. With candidates of the source it waits for a coded frame too, as long as those are no
        further apart than ``detect_every``; otherwise detection runs at its own pace and at each coded frame
        besides, so that stills are always chosen by detections of that very frame. ``skipped`` are the units since
        the frame before, of frames that were not analyzed: they are only decoded.
        """
        began_ns = time.perf_counter_ns()
        for one in skipped:
            self._decode(one.frame_index, one)
        analyzed = self._analyze(frame, unit)
        self.spent_ns += time.perf_counter_ns() - began_ns
        self.frames += 1
        self._track_ids.add(analyzed.tracks.ids.tolist())
        return analyzed

    def pass_over(
        self, frame: Frame, unit: AccessUnit | None, *, skipped: Sequence[AccessUnit] = ()
    ) -> AnalyzedFrame:
        """Pass the next source frame without use for its results: it is neither searched nor tracked.

        A coded frame is decoded all the same (3 ms at 1280x720), so that `analyze` can go on from any frame, and a
        requested still has a base to compare with.
        """
        for one in skipped:
            self._decode(one.frame_index, one)
        picture = None if unit is None else self._decode(frame.index, unit)
        self.detected_ns = None
        tracks = Tracks.none(frame.index)
        return AnalyzedFrame(frame, picture, tracks, detected=False, tracked=False)

    def _analyze(self, frame: Frame, unit: AccessUnit | None) -> AnalyzedFrame:
        picture = None if unit is None else self._decode(frame.index, unit)
        pixels: Image | None = frame.base_bgr
        if self._candidates == "decoded":
            pixels = None if picture is None else picture.gray()
        # Objects of a few pixels, which are looked at enlarged, would come and go.
        self.cpu_budget.reduces = self._reduces and not (self._search is not None and self._search.enlarged)
        due = self.cpu_budget.admits_detection(
            frame.capture_ns, due=self._due(frame.index, coded=unit is not None)
        )
        detections, bgr = None, list[Image]()
        if due:
            if picture is not None and self._candidates == "decoded":
                bgr.append(picture.bgr())
            with self.cpu_budget.spending("detect"):
                detections = self._detect(frame, bgr)
        if detections is None:
            with self.cpu_budget.spending("track"):
                tracks = self._tracker.predict(frame_index=frame.index, image=pixels)
        else:
            if self._trust is not None:
                self._trust.take(detections)
            self._detected_index, self.detected_ns = frame.index, frame.capture_ns
            tracks = self._tracker.update(detections, frame_index=frame.index, image=pixels)
        detected, scene_began = detections is not None, self._tracker.scene_began
        return AnalyzedFrame(frame, picture, tracks, detected=detected, scene_began=scene_began, _bgr=bgr)

    def _decode(self, index: int, unit: AccessUnit) -> YuvPicture:
        picture = self._decoder.decode_yuv(unit.data)
        assert picture is not None, "the edge decodes what it has just encoded"
        if self._coded_index is not None:
            self._coded_gap = index - self._coded_index
        self._coded_index = index
        return picture

    def _due(self, index: int, *, coded: bool) -> bool:
        # Whether the detector is to run on this frame. It depends on frame counts alone, never on a clock.
        every, last = self.detect_every, self._detected_index
        rested = (
            last is None
            or self._tracker.scene_began > last
            or self._tracker.is_due(index - last, every=every, most=self._still_every)
        )
        since_coded = 0 if self._coded_index is None else index - self._coded_index
        sparse = max(self._coded_gap, since_coded) > every
        if coded:
            return rested or sparse
        return rested and sparse and self._candidates == "source"

    def _found(self, image_bgr: Image) -> Detections | None:
        share = self.cpu_budget.detector_share
        if share < 1:
            return self._detect_whole(image_bgr, share=share)
        whole = self._detector.detect(image_bgr)
        return whole if whole is None or self._search is None else self._search.take(whole, image_bgr)

    def _detect(self, frame: Frame, base_bgr: Sequence[Image]) -> Detections | None:
        # ``base_bgr`` is the one decoded picture, if candidates come from the decoded stream.
        if self._candidates == "decoded":
            assert base_bgr, "detection on the decoded stream is due on coded frames only"
            return self._found(base_bgr[0])
        if self._view.enlarges:
            return self._found(frame.base_bgr)
        found = self._found(frame.source_bgr)
        if found is None:
            return None
        width, height = self._view.base_size
        boxes = self._view.to_base(found.boxes_xyxy_px)
        # With --fit crop the source shows more than the base does; objects outside the base are no candidates.
        limits = np.array([width, height, width, height], np.float32)
        boxes = np.clip(boxes, 0, limits)
        inside = (boxes[:, 2] - boxes[:, 0] > 1) & (boxes[:, 3] - boxes[:, 1] > 1)
        return Detections(boxes[inside], found.confidences[inside], found.class_ids[inside])
