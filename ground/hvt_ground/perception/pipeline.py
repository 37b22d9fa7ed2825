"""The perception of one session: base stream, the edge's own tracks and stills become one list of tracks."""

from __future__ import annotations

import math
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import wait
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace

import numpy as np

from hvt_common.inference.detect import FailingDetector
from hvt_common.inference.scale_search import ScaleSearch
from hvt_common.inference.tiles import areas
from hvt_common.inference.view_trust import ViewTrust
from hvt_common.protocol.messages import StillResult
from hvt_common.runtime.statistics import SequenceWindow
from hvt_common.tracking.bytetrack import ByteTracker
from hvt_common.units import SECOND_NS
from hvt_common.values import Detections, Tracks, View
from hvt_common.video.hevc import Picture, YuvPicture
from hvt_ground.events import Event, Overlay, Refinement
from hvt_ground.perception.fusion.fuse import FusedTracks, Fusion
from hvt_ground.perception.guesses import Guesses, are_firm
from hvt_ground.perception.history import History, as_bgr
from hvt_ground.perception.models import Detection, DetectorThread
from hvt_ground.perception.stills.classify import StillReader
from hvt_ground.perception.stills.decode import ReceivedStill
from hvt_ground.perception.stills.refine import Refiner
from hvt_ground.perception.stills.stage import Progress, StillStage

__all__ = ["DecodedFrame", "PerceptionCounts", "Pipeline", "ReceivedStill"]

_FARTHEST_S = 5
"""A step further ahead of all that is known is not plausible: nothing that comes after it could be shown."""
_GAP_S = 1.0
"""For how long the base stream may leave out frames and still tell where tracks were between."""
_PUT_OFF = 4
"""The longest pause between two detections, in usual pauses, where one is put off again and again."""

_TURN_SHARE = 0.5
"""Share of the time to the next picture that a list waits for the detector, which other sessions use too."""
_LATE_NS = SECOND_NS
"""The longest time that tracks are followed while the detector is busy; after that they are old."""

_HISTORY_S = 3.0
"""Pictures of this time are kept, for residual stills build on them."""
_REACH_S = 4.0
"""The same number of pictures of a stream that leaves out frames reaches back further, but an edge sends its stills
again only within this time."""
_MOST_HISTORY_FRAMES = 45
_MOST_HISTORY_BYTES = 128 * 2**20

_SURE_OF_SOURCE = 0.6
"""An edge that is as sure of an object has seen it in its source, where that is finer than the base."""
_LEAST_INSIDE = 0.5
"""Tracks are carried on for a while. A box of which more than half has left the picture shows nothing any more."""


@dataclass(frozen=True, slots=True)
class DecodedFrame:
    """A decoded base frame."""

    frame_index: int
    capture_ns: int
    reference_ns: int | None
    """The moment on our clock that latency counts from: capture, or in lockstep the receiving; None where the
    camera's clock cannot be right."""
    picture: Picture
    """Converted to BGR by whom it is analyzed."""


@dataclass(frozen=True, slots=True)
class PerceptionCounts:
    """The counts of a `Pipeline`; the defaults are those of one that is not made yet."""

    tracks: int = 0
    """Distinct tracks so far, of all sources."""
    refined: int = 0
    """Distinct tracks that a still has refined."""
    class_changes: int = 0
    """Stills after which the class that is shown was another."""
    doubted: int = 0
    """Tracks that are shown and that stills doubt."""
    detections_run: int = 0
    steps_used: int = 0
    """Reports of the edge's tracks that were taken in."""
    history_bytes: int = 0
    """Size of the pictures that are remembered for stills."""
    stills_pending: int = 0
    """For their base frame."""
    stills_dropped: Counter[str] = field(default_factory=Counter)
    """Stills of which nothing could be made, by reason; ``base_missing`` were asked for again."""
    outcomes: Counter[str] = field(default_factory=Counter)
    """The outcome of each object in the others."""
    view_trust: float | None = None
    """Of the detector in the view, 0…1 (`ViewTrust.mean`); None where nothing tells it."""
    view_unlike: bool = False
    """It is so low that the detector does not know the view."""


@dataclass(eq=False, kw_only=True)
class Pipeline:
    """One session's perception. Used by one thread; ``emit`` takes the events.

    But for the detector and its thread no part of it may be shared with another session. Detections are at least
    ``detect_every`` frames apart, up to ``detect_still_every`` while nothing changes.
    """

    detector: FailingDetector
    detector_thread: DetectorThread
    tracker: ByteTracker
    reader: StillReader
    refiner: Refiner
    fusion: Fusion
    trust: ViewTrust
    """How far the detector can be trusted in this session's video."""
    view: View
    fps: float
    detect_every: int
    detect_still_every: int = 0
    emit: Callable[[Event], None]
    edge_alike: bool = False
    """The edge's detector has our classes: it is taken for the same, which knows no view that ours does not."""
    guesses: Guesses | None = None
    """None where the detector's scores are no probabilities."""
    search: ScaleSearch | None = None
    """The search for the scale of this session's video; None where the scale is given."""
    turns: AbstractContextManager[None] = field(default_factory=nullcontext)
    """Around analysis and the reading of stills, which may hang."""

    def __post_init__(self) -> None:
        fps = self.fps
        self._frame_ns = SECOND_NS / fps
        self._turn_s = _TURN_SHARE / fps
        self._detection: Detection | None = None
        """The picture that is searched, or waits for it."""
        self._watched: Detection | None = None
        """The newest one whose end wakes up who waits for it."""
        self._due_ns = 0
        """When the one that was to be searched was captured, which another may have replaced."""
        self._farthest = round(_FARTHEST_S * fps)
        self._pending: list[Event] = []
        """By stills, until it is known which tracks are guesses."""
        gap_frames = max(1, round(_GAP_S * fps))
        self._history = History(
            max_frames=min(_MOST_HISTORY_FRAMES, max(1, round(_HISTORY_S * fps))),
            max_bytes=_MOST_HISTORY_BYTES,
            reach_frames=max(1, round(_REACH_S * fps)),
            gap_frames=gap_frames,
        )
        self._stills = StillStage(
            self.reader,
            self.refiner,
            history=self._history,
            fusion=self.fusion,
            view=self.view,
            gap_frames=gap_frames,
            emit=self._pending.append,
        )
        self._detected_frame: int | None = None
        self._now = Progress()
        self._picture_ns = 0
        self._own: Tracks | None = None
        self._listed_frame = -1
        self._track_ids = SequenceWindow()
        self._detections_run = 0
        self.objects_detected = -1
        """Objects that the detector showed when it last looked; -1 before the first time."""
        self._doubted = 0
        self._steps_used = 0
        self.tilt = self.refiner.tilt

    @property
    def searching(self) -> bool:
        """A picture is with the detector, or waits for it."""
        return self._detection is not None and not self._detection.found.done()

    @property
    def counts(self) -> PerceptionCounts:
        return PerceptionCounts(
            tracks=self._track_ids.count,
            refined=self.refiner.tracks_refined,
            class_changes=self.refiner.class_changes,
            doubted=self._doubted,
            detections_run=self._detections_run,
            steps_used=self._steps_used,
            history_bytes=self._history.size_bytes,
            stills_pending=self._stills.pending,
            stills_dropped=self._stills.dropped,
            outcomes=self._stills.outcomes,
            view_trust=self.trust.mean,
            view_unlike=self.trust.unlike,
        )

    def analyze(self, picture: DecodedFrame, *, hurry: bool, news: threading.Event | None = None) -> None:
        """Take the next frame; with ``hurry`` detection waits for a later one, but not for ever.

        Once ``news`` is set the list goes out without the detector's result: a later frame, or `take_late`, takes it
        in as if it had been known at once. Without ``news``, as in lockstep, the detector is waited for.
        """
        index = picture.frame_index
        with self.turns:
            self._history.add_frame(index, picture.picture)
            own = self._own = self._track(picture, hurry=hurry, news=news)
        self._picture_ns = picture.capture_ns
        ahead = self._now.frame_index > index
        shown_at = (self._now.frame_index, self._now.capture_ns) if ahead else (index, picture.capture_ns)
        self._now = Progress(*shown_at, picture_index=index)
        self.fusion.take_own(own)
        self._show(own, picture.capture_ns)

    def take_late(self) -> bool:
        """Take in objects found after the list of their picture went out; True while the detector still searches.

        Stills would else find no tracks at the last pictures before a pause.
        """
        if self._detection is not None and not self.searching:
            self._take_found(self._detection)
            own = self._own = self.tracker.extrapolated(frame_index=self._now.picture_index)
            self.fusion.take_own(own)
            self._track_ids.add(self._revise(own).tracks.ids.tolist())
            self._tell()
        return self.searching

    def pass_over(self, index: int, capture_ns: int) -> None:
        """Take the next frame without its picture: its list goes on from the newest picture that was looked at.

        Else the boxes of that one would stand on this picture while the camera moves on.
        """
        if index > self._now.frame_index and self._own is not None:
            self._now = Progress(index, capture_ns, self._now.picture_index)
            self._show(self._own_at(index), capture_ns, looked_ns=self._picture_ns)

    def edge_step(self, step: Tracks, *, capture_ns: int | None = None) -> None:
        """Take the list of the edge's tracker at one frame: its own ids and class ids, boxes in base pixels.

        A step of a frame that is newer than all that was shown is shown at once: the base stream may leave that frame
        out. ``capture_ns`` is that frame's; None reckons it from the newest picture.
        """
        frame_index = step.frame_index
        newest = max(self._now.frame_index, self._now.picture_index)
        if self._own is None or frame_index - newest > self._farthest:
            return
        own = self._own_at(frame_index)
        if not self.fusion.take_step(step, own=own):
            return
        self._steps_used += 1
        if frame_index > self._now.frame_index:
            at_ns = self._capture_ns(frame_index) if capture_ns is None else capture_ns
            self._now = Progress(frame_index, at_ns, self._now.picture_index)
            self._show(own, at_ns)
            return
        self._revise(own)
        self._tell()

    def read(self, stills: Sequence[ReceivedStill]) -> None:
        """Take stills, in the order in which they came; those of one frame are looked at together."""
        with self.turns:
            self._stills.take(stills, self._now)
        self._tell()
        self._carry_merges()

    def list_at(self, frame_index: int) -> Overlay:
        """The list at a frame, from all that is known now; changes nothing.

        The frame must not lie before the newest decoded frame (`ValueError`). Nothing known is an empty list.
        """
        if frame_index < self._now.picture_index:
            raise ValueError(f"frame {frame_index} lies before the newest frame, {self._now.picture_index}")
        fused = self.fusion.listed(self._own_at(frame_index))
        shown = self.refiner.preview(
            fused.tracks, capture_ns=self._capture_ns(frame_index), origins=fused.origins
        )
        return self._inside(self._doubting(shown))

    def take_results(self) -> list[StillResult]:
        return self._stills.take_results()

    def end(self) -> None:
        """End the session: pending stills are given out as unmatched, and large memory is freed.

        A ground goes on for days, and its edges come and go.
        """
        if self._detection is not None:
            self._detection.found.cancel()
        self._stills.end(self._now)
        self._tell()
        self._history.clear()

    # The base stream

    def _track(self, picture: DecodedFrame, *, hurry: bool, news: threading.Event | None) -> Tracks:
        index = picture.frame_index
        if self._detection is not None and not self.searching:
            self._take_found(self._detection)
        begins = self._submits(picture, hurry=hurry)
        # Gray is enough to follow the camera. Only searched pictures are converted to BGR.
        image = picture.picture.gray() if isinstance(picture.picture, YuvPicture) else picture.picture
        own = self.tracker.predict(frame_index=index, image=image, searched=begins)
        if self.tracker.scene_began == index:
            self.fusion.end_scene(index)
        before, affine = self._now.picture_index, self.tracker.camera_step
        if before >= 0 and affine is not None:  # the tracker has followed it: it is not estimated twice
            self.fusion.path.add(affine, start=before, end=index)
        if begins and self._detection is not None and self._is_found(self._detection, news):
            return self._take_found(self._detection)
        return own

    def _submits(self, picture: DecodedFrame, *, hurry: bool) -> bool:
        # Whether this picture is searched: begun here, or in place of one that has waited until now.
        last, index = self._detected_frame, picture.frame_index
        if self._detection is not None:
            if not self._detection.queued or not self._detection.replace(picture.picture):
                return False
            self._detected_frame = index
            return True
        every = self.detect_every if self.search is None else self.search.interval(self.detect_every)
        every *= _PUT_OFF if hurry else 1
        due = (
            last is None
            or self.tracker.scene_began > last
            or self.tracker.is_due(index - last, every=every, most=self.detect_still_every)
        )
        if due:
            self._detected_frame = index
            self._due_ns = picture.capture_ns
            self._detection = self.detector_thread.submit(picture.picture, self._detect)
        return due

    def _is_found(self, detection: Detection, news: threading.Event | None) -> bool:
        # Whether the detector is done with this picture, before there are ``news``.
        if news is None:
            return bool(wait([detection.found]).done)
        if self._watched is not detection:  # one that hangs is asked for with each picture
            self._watched = detection
            detection.found.add_done_callback(lambda _: news.set())
        news.wait(self._turn_s)
        if not detection.queued:
            news.wait()
        return detection.found.done()

    def _detect(self, picture: Picture) -> Detections:
        # In the detector's thread, which makes the picture's BGR: one that is replaced before needs none.
        image = as_bgr(picture)
        self._detections_run += 1
        found = self.detector.detect(image) or Detections.none()
        return found if self.search is None else self.search.take(found, image)

    def _take_found(self, detection: Detection) -> Tracks:
        # Takes the objects of the searched picture; our tracks there.
        self._detection = None
        found = detection.found.result()
        self.trust.take(found)
        own = self.tracker.update_late(found)
        self.objects_detected = int((own.seen_frames == own.frame_index).sum())
        self.tilt.take(own, self.refiner.vocabulary.names, height_px=self.view.base_size[1])
        return own

    def _own_at(self, frame_index: int) -> Tracks:
        # Our tracker's list at a frame: as it was, or moved on from the newest frame.
        own = self._own
        if own is None:
            return Tracks.none(frame_index)
        if frame_index > own.frame_index:
            ahead = self.tracker.extrapolated(frame_index=frame_index)
            boxes = ahead.boxes_xyxy_px.astype(np.float64)
            moved = self.fusion.path.carry(boxes, start=own.frame_index, end=frame_index)
            return replace(ahead, boxes_xyxy_px=moved.astype(np.float32))
        before = self.fusion.own_at(frame_index)
        return Tracks.none(frame_index) if before is None else replace(before, frame_index=frame_index)

    def _capture_ns(self, frame_index: int) -> int:
        return self._picture_ns + round((frame_index - self._now.picture_index) * self._frame_ns)

    # The list

    def _revise(self, own: Tracks) -> FusedTracks:
        # Put the list at the frame of ``own`` on record.
        self._carry_merges()
        fused = self.fusion.listed(own)
        self._history.add_tracks(fused.tracks)
        self._stills.update(self._now)
        return fused

    def _show(self, own: Tracks, capture_ns: int, *, looked_ns: int | None = None) -> None:
        # Put the list on record and, where nothing newer has been shown, give it out.
        fused = self._revise(own)
        self._track_ids.add(fused.tracks.ids.tolist())
        if own.frame_index > self._listed_frame:
            step = self.fusion.path.between(max(0, self._listed_frame), own.frame_index)
            self._listed_frame = own.frame_index
            shown = self.refiner.shown(fused.tracks, capture_ns=capture_ns, origins=fused.origins)
            if self.guesses is not None:
                self.guesses.update(fused.tracks, shown.base_classes, step, scores=fused.means)
            shown = self._doubting(shown)
            self._doubted = int(shown.doubted.sum())
            if self._detection is not None and capture_ns - self._due_ns > _LATE_NS:
                looked_ns = self._due_ns
            self._tell()
            self.emit(replace(self._inside(shown), looked_ns=looked_ns))
        self._tell()

    def _tell(self) -> None:
        while self._pending:
            event = self._pending.pop(0)
            if self.guesses is not None and isinstance(event, Refinement):
                event = self.guesses.doubting(event, unlike=self.trust.unlike and self.edge_alike)
            self.emit(event)

    def _doubting(self, shown: Overlay) -> Overlay:
        # In a view that our detector does not know all its tracks are guesses, and no class is certain. Tracks
        # that the edge sees with another detector, or well in a finer picture, are not touched.
        guesses, sure, vague = self.guesses, shown.sure, shown.vague
        if guesses is None and not self.trust.unlike:
            return shown
        doubted = shown.doubted
        firm = shown.refined & are_firm(shown.boxes_base_px, shown.confidences, scale=self.view.scale)
        if guesses is not None:
            doubted = doubted | guesses.among(shown.track_ids) & ~firm
            vague = vague & ~guesses.agreed(shown.track_ids, shown.classes, aslant=self.tilt.aslant)
        if self.trust.unlike:
            ours = np.array([one == "base" for one in shown.origins], np.bool_)
            if self.edge_alike:
                ours = ours | (shown.confidences < (_SURE_OF_SOURCE if self.view.scale < 1 else math.inf))
            doubted = doubted | ours & ~firm
            sure = np.zeros_like(sure)
        return replace(shown, doubted=doubted, sure=sure, vague=vague)

    def _inside(self, shown: Overlay) -> Overlay:
        # The tracker lets boxes leave the picture.
        boxes = np.clip(
            shown.boxes_base_px, 0, np.array([*self.view.base_size, *self.view.base_size], np.float32)
        )
        rows = np.flatnonzero(areas(boxes) > _LEAST_INSIDE * areas(shown.boxes_base_px))
        shown = replace(shown, boxes_base_px=boxes)
        return shown if len(rows) == len(boxes) else shown.take(rows)

    def _carry_merges(self) -> None:
        for survivor_id, merged_id in self.fusion.take_merged():
            self.refiner.merge(survivor_id, merged_id)
            self._history.rename_track(survivor_id, merged_id)
