"""ByteTrack: from the detections of each frame to tracks with lasting ids.

Zhang et al., "ByteTrack: Multi-Object Tracking by Associating Every Detection Box", ECCV 2022. Confident detections
are matched with predicted tracks first; tracks left over may take a weak detection near them; what is confident and
still free starts a new track. The rules, constants and oddities are those of the authors' program, so that its
results are reproduced.
What is added: frames may pass without detection (`ByteTracker.predict`), and what finds no match after
them is matched once more with a margin; where the camera is followed, boxes go with what is in them (`flow`); between
detections a box hardly changes its size by itself; all tracks end where another scene begins; the time of lost tracks
is counted in frames whatever the rate of detection, and where a slow machine detects more seldom than that time
lasts, in detections; a track has a class.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from hvt_common.camera_motion import Affine, CameraMotion
from hvt_common.tracking import kalman
from hvt_common.tracking.association import Overlaps, grown, larger, overlaps, pair
from hvt_common.tracking.flow import BoxFlow, Gray, box_flow
from hvt_common.tracking.track_table import LOST, TRACKED, UNCONFIRMED, TrackerInput, TrackTable
from hvt_common.values import Detections, Image, Tracks

_Floats = npt.NDArray[np.float64]
_Indices = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]

_LOW_CONFIDENCE: Final = 0.1
# Fixed in the authors' program, as costs 1 - IoU of at most 0.5, 0.7 and 0.15.
_WEAK_COST_LIMIT: Final = 0.5
_UNCONFIRMED_COST_LIMIT: Final = 0.7
_DUPLICATE_COST_LIMIT: Final = 0.15

_LONGEST_S: Final = 10.0
"""After so long without a detection the last one tells nothing of the picture now."""
_LEAST_DETECTIONS: Final = 3
"""Detections that a lost track is remembered for, where they are further apart than the buffer is long."""
_AS_PREDICTED_IOU: Final = 0.5
_MOST_SURPRISES: Final = 0.1
"""Tracks elsewhere than predicted or not found, and what may start new ones, as a share of the tracks."""
_MOST_SHIFT: Final = 0.1
"""Of the picture's sides, since the last update: what came into view has no tracks yet (`CameraMotion.shift`)."""

_SIZE_DECAY: Final = 0.5
_MOST_SIZE_STEP: Final = 0.1
"""Between detections the velocity of a box's sides halves with each frame, and is at most this share of them."""
_MOST_GROWN: Final = 1.6
"""Times the height that was seen: then it is the road that is followed."""
_OLD_S: Final = 1.5
_OLD_GAPS: Final = 2
"""Tracks not seen for so long, and for so many times the longest of the last gaps, are not listed."""
_FLOW_WEIGHT: Final = 0.5
"""Of the motion seen against the velocity before it."""

_MOST_PICTURES: Final = 24
"""So many are kept while one of them is being searched: what is found there goes through all of them."""

# Box lengths; wider, and neighbours in a queue of cars are taken for each other.
_MOST_GROWTH: Final = 0.75


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """The parameters of ByteTrack, with the authors' defaults."""

    track_confidence: float = 0.5
    """Detections above it are matched first and may start tracks (``track_thresh``)."""
    low_confidence: float = _LOW_CONFIDENCE
    """Detections above it and below ``track_confidence`` may only carry a track on."""
    new_confidence: float | None = None
    """Least confidence that starts a track; None is ``track_confidence`` + 0.1."""
    match_iou: float = 0.2
    """Least IoU (times confidence, with ``fuse_scores``) of a first match; 1 - ``match_thresh``."""
    track_buffer: int = 30
    """How long a lost track is remembered, in frames at 30 fps; scaled to the real rate. Where detections are
    further apart than that: for three of them."""
    fuse_scores: bool = True
    """Weigh overlaps by the detection's confidence, except for weak detections (off with ``mot20``)."""
    min_box_area_px2: float = 10.0
    """Tracks whose box is not larger than this are not listed."""
    search_growth_per_s: float = 3.0
    """After frames without detection, what is left over is matched once more with boxes larger on every side, by
    this many of their own lengths for a second without (0.75 at most). Where every frame is searched nothing
    changes; 0 is off."""
    class_decay: float = 0.9
    """The remaining weight of a class vote one matched detection later: 1 never forgets."""
    camera_motion: Literal["off", "flow"] = "off"
    """How to estimate the camera's motion, which then moves all tracks before they are matched."""

    @classmethod
    def starting_at(cls, confidence: float, *, camera_motion: Literal["off", "flow"]) -> TrackerSettings:
        """The settings of both sides: detections from ``confidence`` start tracks, weaker ones carry them on."""
        return cls(
            track_confidence=confidence,
            low_confidence=weak_confidence(confidence),
            new_confidence=confidence,
            camera_motion=camera_motion,
        )

    def __post_init__(self) -> None:
        """Check every bound; a `ValueError` names the setting."""
        for name in ("track_confidence", "low_confidence", "match_iou", "class_decay"):
            _check_range(name, getattr(self, name), 0.0, 1.0)
        if self.new_confidence is not None:
            _check_range("new_confidence", self.new_confidence, 0.0, math.inf)
        _check_range("search_growth_per_s", self.search_growth_per_s, 0.0, math.inf)
        _check_range("min_box_area_px2", self.min_box_area_px2, 0.0, math.inf)
        _check_range("track_buffer", self.track_buffer, 0, math.inf)
        if self.low_confidence > self.track_confidence:
            raise ValueError(
                f"low_confidence is {self.low_confidence}, must not exceed track_confidence {self.track_confidence}"
            )
        if self.camera_motion not in ("off", "flow"):
            raise ValueError(f"camera_motion is {self.camera_motion!r}, must be 'off' or 'flow'")

    @property
    def birth_confidence(self) -> float:
        """The least confidence that starts a track."""
        return self.track_confidence + 0.1 if self.new_confidence is None else self.new_confidence


@dataclass(frozen=True, slots=True)
class _Step:
    """To a frame from the one before: the camera's motion, and that of the boxes where it was seen."""

    frame_index: int
    affine: Affine | None
    flow: BoxFlow | None
    gray: Gray | None


@dataclass(frozen=True, slots=True)
class _Searched:
    """What stood before a frame that is being searched, and the steps to it and to those after it."""

    table: TrackTable
    before: int | None
    steps: list[_Step]


def _check_range(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:  # also refuses NaN
        raise ValueError(f"{name} is {value}, must be from {low} to {high}")


def _coast(states: kalman.States) -> None:
    # Step by one frame without detection, in place: what grew or shrank ever on would soon fit nothing.
    limit = _MOST_SIZE_STEP * np.abs(states[:, kalman.POSITION, 2:])
    sizes = states[:, kalman.VELOCITY, 2:]
    states[:, kalman.VELOCITY, 2:] = np.clip(_SIZE_DECAY * sizes, -limit, limit)
    kalman.predict(states)


def weak_confidence(confidence: float) -> float:
    """From where a detector is to report, so that weak detections may carry on tracks begun at ``confidence``."""
    return min(confidence, _LOW_CONFIDENCE)


class ByteTracker:
    """Tracks objects through consecutive frames of one camera at ``fps`` frames a second.

    Call `update` for a frame that was searched for objects and `predict` for one that was not, with rising frame
    indices; or `predict` with ``searched`` for one that is being searched, and `update_late` once that is done.
    Frames left out altogether are stepped over; 10 s without an update end all tracks. Detections whose numbers are
    not finite, or whose box has no area, are left out.
    Class ids must be small (an index into class names), not negative.

    A track is confirmed when the next update finds it again (with a detection every n-th frame: n frames after the
    one that started it), and at once at the first update of a scene. Only confirmed tracks that the last
    update found are listed; ``started`` marks the update that confirmed them or found them again.
    """

    def __init__(self, settings: TrackerSettings | None = None, *, fps: float) -> None:
        if not (math.isfinite(fps) and fps > 0):
            raise ValueError(f"fps is {fps}, must be a finite number above 0")
        self._settings = settings or TrackerSettings()
        self._fps = fps
        self._buffer_frames = int(fps / 30.0 * self._settings.track_buffer)
        self._longest_frames = max(self._buffer_frames, round(_LONGEST_S * fps))
        method = self._settings.camera_motion
        self._camera = None if method == "off" else CameraMotion(scale=None)
        self._size = (0, 0)
        """(width, height) of the images."""
        self.camera_step: Affine | None = None
        """The camera's motion from the frame before to the newest, base pixels; None where it is not followed."""
        self.reset()

    def reset(self) -> None:
        """Forget everything: as a new tracker, with ids from 1."""
        self._table = TrackTable.empty()
        self._frame_index: int | None = None
        self._pictured: int | None = None
        """The frame of the newest image."""
        self._updated_index: int | None = None
        self._gaps: deque[int] = deque(maxlen=_LEAST_DETECTIONS)
        """Frames from one update to the next, of the last ones."""
        self._searched: _Searched | None = None
        self._late_frames = 0
        """How long after its frame the last update came."""
        self._next_id = 1
        self._steady = 0
        """So many updates in a row found nearly all as predicted."""
        self.scene_began = -1
        """The newest frame that another scene began with, where the camera is followed; -1 before any."""
        if self._camera is not None:
            self._camera.reset()

    def is_due(self, frames: int, *, every: int, most: int) -> bool:
        """Whether the newest frame, so many after the one searched last, is to be searched.

        That is each ``every`` frames while something is to be confirmed or much has come into view; else twice or
        three times as many, up to ``most``, after updates that found nearly all as predicted, and ``most`` while the
        newest frame shows what the last update saw.
        """
        camera = self._camera
        if frames < every or frames >= most or (self._table.phase == UNCONFIRMED).any():
            return frames >= every
        if camera is not None and camera.shift() > _MOST_SHIFT:
            return True
        return frames >= (1 + min(2, self._steady)) * every and (camera is None or not camera.still())

    def update(self, detections: Detections, *, frame_index: int, image: Image | None = None) -> Tracks:
        """The tracks at a frame that a detector has searched; boxes in base pixels.

        ``image`` is that frame, BGR or gray; it is needed only to follow the camera's motion.
        A `ValueError` means that ``frame_index`` does not rise or that the class ids are negative.
        """
        self._searched, self._late_frames = None, 0
        self._check_rises(frame_index)
        return self._update(detections, self._step_to(frame_index, image, mark=True))

    def update_late(self, detections: Detections) -> Tracks:
        """The tracks at the frame that `predict` last took as ``searched``, where this was found meanwhile.

        All is from then on as if it had been found at once.
        """
        searched, self._searched = self._searched, None
        if searched is None:
            raise ValueError("no frame is being searched")
        self._late_frames = searched.steps[-1].frame_index - searched.steps[0].frame_index
        self._table, self._frame_index = searched.table, searched.before
        listed = self._update(detections, searched.steps[0])
        for before, step in pairwise(searched.steps):
            flow = self._flow(
                before.gray, step.gray, step.affine, frames=step.frame_index - before.frame_index
            )
            self._advance(replace(step, flow=flow), hold_unconfirmed=False)
            self._table.started[:] = False
        return listed

    def _update(self, detections: Detections, step: _Step) -> Tracks:
        frame_index = step.frame_index
        seen = TrackerInput.of(detections, low_confidence=self._settings.low_confidence)
        self._advance(step, hold_unconfirmed=True)
        first = self._updated_index is None or self._updated_index < self.scene_began <= frame_index
        gap = 1 if self._updated_index is None else frame_index - self._updated_index
        self._gaps.append(gap)
        self._forget_stale(frame_index)
        self._widen_for(seen)
        match, free, same = self._match(seen, frame_index, growth=self._growth(frame_index))
        self._steady = self._steady + 1 if self._as_predicted(same, len(free)) else 0
        self._updated_index = frame_index
        self._correct(seen, match, frame_index, gap=gap)
        retained = self._retire(match, frame_index)
        self._start(seen.take(free), frame_index, confirmed=first)
        retained = np.concatenate((retained, np.ones(len(self._table) - len(retained), bool)))
        boxes = kalman.boxes_of(self._table.states)
        retained &= ~self._duplicates(retained, boxes)
        if not retained.all():
            self._table.retain(retained)
            boxes = boxes[retained]
        return self._listed(frame_index, boxes)

    def predict(self, *, frame_index: int, image: Image | None = None, searched: bool = False) -> Tracks:
        """The tracks at a frame without detection: those of the last update, moved on by the Kalman filter.

        ``searched``: that frame is being searched, in place of one that was before.
        """
        self._check_rises(frame_index)
        step = self._step_to(frame_index, image, mark=searched)
        if searched:
            self._searched = _Searched(self._table.copy(), self._frame_index, [])
        if self._searched is not None:
            steps = self._searched.steps
            steps.append(step)
            if frame_index - steps[0].frame_index > self._longest_frames + 1:
                del steps[1:-1]  # whatever is found, all tracks will have ended
            if len(steps) > _MOST_PICTURES:
                steps[-_MOST_PICTURES] = replace(steps[-_MOST_PICTURES], gray=None)
        self._advance(step, hold_unconfirmed=False)
        self._table.started[:] = False
        return self._listed(frame_index, kalman.boxes_of(self._table.states))

    def extrapolated(self, *, frame_index: int) -> Tracks:
        """The list of `predict` at this or a later frame if the camera stood still; nothing is changed.

        For lists to show between frames that are given to the tracker. ``started`` is False throughout.
        A `ValueError` means that ``frame_index`` lies before the last frame.
        """
        last = frame_index if self._frame_index is None else self._frame_index
        if frame_index < last:
            raise ValueError(f"frame_index is {frame_index}, must not be below the last one, {last}")
        states = self._table.states.copy()
        ended = self._outdated(frame_index)
        for _ in range(0 if ended else frame_index - last):
            _coast(states)
        listed = self._listed(frame_index, kalman.boxes_of(states[:0] if ended else states))
        return replace(listed, started=np.zeros(len(listed), bool))

    def _check_rises(self, frame_index: int) -> None:
        if self._frame_index is not None and frame_index <= self._frame_index:
            raise ValueError(f"frame_index is {frame_index}, must be above the last one, {self._frame_index}")

    @property
    def _gray(self) -> Gray | None:
        return None if self._camera is None else self._camera.gray

    def _step_to(self, frame_index: int, image: Image | None, *, mark: bool) -> _Step:
        # The step to this image; with ``mark`` `still` compares with it from now on.
        camera, before = self._camera, self._gray
        self.camera_step = None if camera is None or image is None else camera.step(image)
        if camera is not None and image is not None and camera.new_scene:
            self.scene_began = frame_index
        if camera is not None and mark:
            camera.mark()
        if image is None:
            return _Step(frame_index, None, None, None)
        flow, self._size = None, (image.shape[1], image.shape[0])
        if self._frame_index is not None and self._pictured == self._frame_index:
            flow = self._flow(before, self._gray, self.camera_step, frames=frame_index - self._frame_index)
        self._pictured = frame_index
        return _Step(frame_index, self.camera_step, flow, self._gray)

    def _flow(
        self, before: Gray | None, now: Gray | None, affine: Affine | None, *, frames: int
    ) -> BoxFlow | None:
        # From one picture to the other, of the tracks that were found; None without both, and after a long time.
        moving = self._table.phase == TRACKED
        if before is None or now is None or before.shape != now.shape or not moving.any():
            return None
        if frames > self._longest_frames:
            return None
        then = self._table.states[moving]
        expected = then.copy()
        for _ in range(frames):
            _coast(expected)
        if affine is not None:
            kalman.warp(expected, affine)
        shifts = expected[:, kalman.POSITION, :2] - then[:, kalman.POSITION, :2]
        return box_flow(before, now, kalman.boxes_of(then), expected=shifts, size=self._size)

    def _carry(self, then: kalman.States, flow: BoxFlow, *, frames: int) -> None:
        # Put the tracks to where the picture shows them.
        states = self._table.states
        rows = (self._table.phase == TRACKED).nonzero()[0][flow.found]
        seen = then[rows, kalman.POSITION]
        seen[:, :2] += flow.shifts[flow.found]
        seen[:, 3] *= flow.zooms[flow.found]
        own = (seen[:, :2] - states[rows, kalman.POSITION, :2]) / frames
        states[rows, kalman.VELOCITY, :2] += _FLOW_WEIGHT * own
        states[rows, kalman.POSITION] = seen

    def _advance(self, step: _Step, *, hold_unconfirmed: bool) -> None:
        frame_index = step.frame_index
        elapsed = 1 if self._frame_index is None else frame_index - self._frame_index
        self._frame_index = frame_index
        table = self._table
        if self.scene_began == frame_index or self._outdated(frame_index):
            table.retain(np.zeros(len(table), bool))
        if not len(table):
            return
        then = table.states.copy()
        for _ in range(elapsed - 1):
            _coast(table.states)
        # The authors' program matches unconfirmed tracks where they started, without the step to this frame.
        # They are at rest; what it changes is the gain of the correction that confirms them.
        moving = table.phase != UNCONFIRMED
        if not hold_unconfirmed:
            _coast(table.states)
        elif moving.all():
            kalman.predict(table.states)
        else:
            states = table.states[moving]
            kalman.predict(states)
            table.states[moving] = states
        if step.affine is not None:
            kalman.warp(table.states, step.affine)
        if step.flow is not None:
            self._carry(then, step.flow, frames=elapsed)
        heights = table.states[:, kalman.POSITION, 3]
        np.clip(heights, table.heights / _MOST_GROWN, table.heights * _MOST_GROWN, out=heights)

    def _outdated(self, frame_index: int) -> bool:
        last = self._updated_index
        return last is not None and frame_index - last > self._longest_frames + 1

    @property
    def _lost_frames(self) -> int:
        # Where each look comes later than the buffer is long, nothing would be remembered from one to the next.
        gap = max(self._gaps, default=1)
        return self._buffer_frames if gap <= self._buffer_frames + 1 else _LEAST_DETECTIONS * gap

    def _forget_stale(self, frame_index: int) -> None:
        # The authors' program matches up to ``buffer + 2`` frames (it sweeps one update late): the same at any rate.
        table = self._table
        stale = (table.phase == LOST) & (frame_index - table.seen > self._lost_frames + 2)
        if stale.any():
            table.retain(~(stale & (table.lost_at != self._updated_index)))

    def _widen_for(self, seen: TrackerInput) -> None:
        if len(seen):
            if seen.class_ids.min() < 0:
                raise ValueError(f"class_ids holds {seen.class_ids.min()}, must not be negative")
            self._table.widen(int(seen.class_ids.max()) + 1)

    def _growth(self, frame_index: int) -> float:
        # Before its second detection a track has no velocity, and a small object leaves its own box: never confirmed.
        # Larger boxes are of C-BIoU (Yang et al., WACV 2023); at the first match they mix up dense crowds.
        if self._updated_index is None:
            return 0.0
        unsearched = frame_index - self._updated_index - 1
        return min(_MOST_GROWTH, self._settings.search_growth_per_s * unsearched / self._fps)

    def _match(
        self, seen: TrackerInput, frame_index: int, *, growth: float
    ) -> tuple[_Indices, _Indices, int]:
        # The detection of each track (-1: none), the confident detections left that may start tracks, and how many
        # tracks of the last list are where they were predicted.
        settings, table = self._settings, self._table
        # A detection at exactly the threshold is neither confident nor weak in the authors' program.
        confident = seen.confidences > settings.track_confidence
        match = np.full(len(table), -1)
        free = confident.copy()
        same = 0
        if len(table) and len(seen):
            boxes = kalman.boxes_of(table.states)
            shared = overlaps(boxes, seen.boxes)
            fused = self._fused(shared, seen)
            limit = 1 - settings.match_iou
            unconfirmed = table.phase == UNCONFIRMED
            pair(fused, ~unconfirmed, free, match, limit=limit)
            weak = seen.confidences < settings.track_confidence
            pair(shared, (table.phase == TRACKED) & (match < 0), weak, match, limit=_WEAK_COST_LIMIT)
            pair(fused, unconfirmed, free, match, limit=_UNCONFIRMED_COST_LIMIT)
            if growth > 0:
                wide = overlaps(grown(boxes, growth), grown(seen.boxes, growth))
                if max(self._gaps) > self._buffer_frames + 1:
                    held = grown(self._held(frame_index), growth)
                    wide = larger(wide, overlaps(held, grown(seen.boxes, growth)))
                pair(self._fused(wide, seen), match < 0, free, match, limit=limit)
            own = (match[shared.rows] == shared.columns) & (table.phase[shared.rows] == TRACKED)
            same = int((own & (shared.iou >= _AS_PREDICTED_IOU)).sum())
        free &= seen.confidences >= settings.birth_confidence
        return match, free.nonzero()[0], same

    def _as_predicted(self, same: int, new: int) -> bool:
        count = int((self._table.phase == TRACKED).sum())
        return count > 0 and count - same + new <= _MOST_SURPRISES * count

    def _held(self, frame_index: int) -> _Floats:
        # The last boxes, moved with the camera alone: meanwhile a vehicle may have stopped.
        states = self._table.states.copy()
        elapsed = (frame_index - self._table.seen)[:, None]
        states[:, kalman.POSITION] -= elapsed * states[:, kalman.VELOCITY]
        return kalman.boxes_of(states)

    def _fused(self, found: Overlaps, seen: TrackerInput) -> Overlaps:
        if not self._settings.fuse_scores:
            return found
        return found._replace(iou=found.iou * seen.confidences[found.columns])

    def _correct(self, seen: TrackerInput, match: _Indices, frame_index: int, *, gap: int) -> None:
        table, settings = self._table, self._settings
        rows = (match >= 0).nonzero()[0]
        columns = match[rows]
        states = table.states[rows]
        kalman.correct(states, seen.measured[columns], gap=gap)
        table.states[rows] = states
        table.heights[rows] = states[:, kalman.POSITION, 3]
        phase = table.phase[rows]
        table.overdue[rows] |= (phase == LOST) & (frame_index - table.seen[rows] > self._lost_frames + 1)
        table.started[:] = False
        table.started[rows] = phase != TRACKED
        table.phase[rows] = TRACKED
        table.seen[rows] = frame_index
        table.confidences[rows] = seen.confidences[columns]
        votes = table.votes[rows] * settings.class_decay
        votes[np.arange(len(rows)), seen.class_ids[columns]] += seen.confidences[columns]
        table.votes[rows] = votes

    def _retire(self, match: _Indices, frame_index: int) -> _Mask:
        # Mark unmatched tracks as lost; return which tracks live on.
        table = self._table
        missed = match < 0
        over = (table.phase == LOST) & (frame_index - table.seen > self._lost_frames + 1)
        newly_lost = missed & (table.phase == TRACKED)
        ended = (missed & (table.phase == UNCONFIRMED)) | over | (newly_lost & table.overdue)
        table.phase[newly_lost] = LOST
        table.lost_at[newly_lost] = frame_index
        # While lost, a track keeps its height: a velocity from the last partly hidden boxes would blow it up.
        table.states[newly_lost, kalman.VELOCITY, 3] = 0
        return np.asarray(~ended)

    def _start(self, seen: TrackerInput, frame_index: int, *, confirmed: bool) -> None:
        if not len(seen):
            return
        classes = self._table.votes.shape[1]
        born = TrackTable.new(seen, first_id=self._next_id, frame_index=frame_index, classes=classes)
        if confirmed:
            born.phase[:] = TRACKED
            born.started[:] = True
        self._next_id += len(seen)
        self._table.append(born)

    def _duplicates(self, living: _Mask, boxes: _Floats) -> _Mask:
        # The younger one of each pair of a tracked and a lost track at the same place.
        table = self._table
        duplicate = np.zeros(len(table), bool)
        present = (living & (table.phase != LOST)).nonzero()[0]
        lost = (living & (table.phase == LOST)).nonzero()[0]
        if not len(lost) or not len(present):
            return duplicate
        shared = overlaps(boxes[present], boxes[lost])
        alike = 1 - shared.iou < _DUPLICATE_COST_LIMIT
        a, b = present[shared.rows[alike]], lost[shared.columns[alike]]
        age = table.seen - table.born
        lost_is_shorter = age[a] > age[b]
        duplicate[b[lost_is_shorter]] = True
        duplicate[a[~lost_is_shorter]] = True
        return duplicate

    def _listed(self, frame_index: int, boxes: _Floats) -> Tracks:
        table = self._table
        area = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
        fresh = max(round(_OLD_S * self._fps), _OLD_GAPS * max(self._gaps, default=1))
        if len(self._gaps) == 1 and self._late_frames <= fresh:
            fresh = self._longest_frames  # nobody knows yet when the next update comes
        tracked = (table.phase == TRACKED) & (frame_index - table.seen <= fresh)
        rows = (tracked[: len(boxes)] & (area > self._settings.min_box_area_px2)).nonzero()[0]
        votes = table.votes[rows]
        return Tracks(
            frame_index=frame_index,
            ids=table.ids[rows],
            boxes_xyxy_px=boxes[rows].astype(np.float32),
            confidences=table.confidences[rows],
            class_ids=(votes.argmax(axis=1) if votes.size else np.zeros(len(rows))).astype(np.int32),
            born_frames=table.born[rows],
            seen_frames=table.seen[rows],
            started=table.started[rows],
        )
