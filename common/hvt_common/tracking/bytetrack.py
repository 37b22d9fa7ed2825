"""ByteTrack: from the detections of each frame to tracks with lasting ids.

Zhang et al., "ByteTrack: Multi-Object Tracking by Associating Every Detection Box", ECCV 2022. Confident detections
are matched with predicted tracks first; tracks left over may take a weak detection near them; a confident one that
is still free starts a new track. The rules, constants and oddities are those of the authors' program, so that its
results are reproduced.
Added are: frames may pass without detection (`ByteTracker.predict`), and tracks without a match after
them are matched once more with a margin; where the camera is followed, boxes go with their contents (`flow`); between
detections a box hardly changes its size by itself; all tracks end where another scene begins; the time of lost tracks
is counted in frames whatever the rate of detection, and where a slow machine detects more seldom than that time
lasts, in detections; a track has a class.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from hvt_common.camera_motion import Affine
from hvt_common.tracking import kalman
from hvt_common.tracking.association import duplicates, match
from hvt_common.tracking.motion import Pictures, Step, move
from hvt_common.tracking.settings import TrackerSettings
from hvt_common.tracking.track_table import (
    ENDED,
    IF_FOUND,
    IF_MISSED,
    LOST,
    OVER_TIME,
    TRACKED,
    UNCONFIRMED,
    TrackerInput,
    TrackTable,
)
from hvt_common.values import Detections, Image, Tracks

_Floats = npt.NDArray[np.float64]
_Indices = npt.NDArray[np.int64]

_LONGEST_S: Final = 10.0
"""A detection older than this tells nothing of the present picture."""
_LEAST_DETECTIONS: Final = 3
"""Detections that a lost track is remembered for, where they are further apart than the buffer is long."""
_MOST_SHIFT: Final = 0.1
"""Share of the picture's sides that may come into view between updates: it has no tracks (`CameraMotion.shift`)."""

_OLD_S: Final = 1.5
_OLD_GAPS: Final = 2
"""Tracks not seen for 1.5 s, and for twice the longest of the last gaps between detections, are not listed."""

_MOST_PICTURES: Final = 24
"""Kept while one of them is being searched: the objects found there are carried through all later ones."""

_USUAL_STEP_S: Final = 1 / 15
"""From frame to frame. Where a camera gives fewer, as much is unseen between two as between two that are searched."""
_MOST_GROWTH: Final = 0.75
"""Box lengths; wider, and neighbours in a queue of cars are taken for each other."""


@dataclass(frozen=True, slots=True)
class _Searched:
    """The tracks before a frame that is being searched, and the steps to it and to later frames."""

    table: TrackTable
    before: int | None
    steps: list[Step]


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
        enabled = self._settings.camera_motion == "flow"
        self._pictures = Pictures(enabled=enabled, longest_frames=self._longest_frames)
        self.reset()

    def reset(self) -> None:
        """Forget everything: as a new tracker, with ids from 1."""
        self._table = TrackTable.empty()
        self._frame_index: int | None = None
        self._updated_index: int | None = None
        self._gaps: deque[int] = deque(maxlen=_LEAST_DETECTIONS)
        """Frames from one update to the next, of the last ones."""
        self._searched: _Searched | None = None
        self._late_frames = 0
        """How long after its frame the last update came."""
        self._next_id = 1
        self._steady = 0
        """The number of updates in a row that found nearly all as predicted."""
        self._pictures.reset()

    @property
    def camera_step(self) -> Affine | None:
        """The camera's motion from the frame before to the newest, base pixels; None where it is not followed."""
        return self._pictures.camera_step

    @property
    def scene_began(self) -> int:
        """The newest frame that another scene began with, where the camera is followed; -1 before any."""
        return self._pictures.scene_began

    @property
    def is_empty(self) -> bool:
        """Whether no object is tracked or remembered."""
        return not len(self._table)

    def is_due(self, frames: int, *, every: int, most: int) -> bool:
        """Whether to search the newest frame, which is ``frames`` after the last searched one.

        That is each ``every`` frames while something is to be confirmed or much has come into view; else twice or
        three times as many, up to ``most``, after updates that found nearly all as predicted, and ``most`` while the
        newest frame shows the same as the last update.
        """
        if frames < every or frames >= most or (self._table.phase == UNCONFIRMED).any():
            return frames >= every
        if self._pictures.shift() > _MOST_SHIFT:
            return True
        return frames >= (1 + min(2, self._steady)) * every and not self._pictures.still()

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
            frames = step.frame_index - before.frame_index
            seen = self._pictures.with_flow(step, before.gray, self._table, frames=frames)
            self._advance(seen, hold_unconfirmed=False)
        return listed

    def _update(self, detections: Detections, step: Step) -> Tracks:
        frame_index, before = step.frame_index, self._updated_index
        seen = TrackerInput.of(detections, low_confidence=self._settings.low_confidence)
        self._advance(step, hold_unconfirmed=True)
        gap = 1 if before is None else frame_index - before
        self._gaps.append(gap)
        self._mark_over_time(frame_index)
        self._table = self._table.widened(1 + int(np.maximum.reduce(seen.class_ids, initial=-1)))
        growth = self._growth(gap)
        held = self._held(frame_index) if growth and self._is_slow else None
        found = match(self._table, seen, self._settings, growth=growth, held=held)
        self._steady = self._steady + 1 if found.as_predicted else 0
        self._updated_index = frame_index
        self._correct(seen, found.detections, frame_index, gap=gap)
        self._turn(found.detections, frame_index)
        if len(found.free):
            first = before is None or before < self.scene_began <= frame_index
            self._table = self._table.with_new(
                seen.take(found.free),
                first_id=self._next_id,
                frame_index=frame_index,
                phase=TRACKED if first else UNCONFIRMED,
            )
            self._next_id += len(found.free)
        boxes = kalman.boxes_of(self._table.states)
        double = duplicates(self._table, boxes)
        if len(double):
            living = np.delete(np.arange(len(self._table)), double)
            self._table, boxes = self._table.take(living), boxes.take(living, axis=1)
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
        return self._listed(frame_index, kalman.boxes_of(self._table.states))

    def extrapolated(self, *, frame_index: int) -> Tracks:
        """The list of `predict` at this or a later frame if the camera stood still; nothing is changed.

        For lists to show between frames that are given to the tracker. ``started`` is False throughout.
        A `ValueError` means that ``frame_index`` lies before the last frame.
        """
        last = frame_index if self._frame_index is None else self._frame_index
        if frame_index < last:
            raise ValueError(f"frame_index is {frame_index}, must not be below the last one, {last}")
        if self._outdated(frame_index):
            return Tracks.none(frame_index)
        states = self._table.states.copy()
        for _ in range(frame_index - last):
            kalman.coast(states)
        listed = self._listed(frame_index, kalman.boxes_of(states))
        return replace(listed, started=np.zeros(len(listed), bool))

    def _check_rises(self, frame_index: int) -> None:
        if self._frame_index is not None and frame_index <= self._frame_index:
            raise ValueError(f"frame_index is {frame_index}, must be above the last one, {self._frame_index}")

    def _step_to(self, frame_index: int, image: Image | None, *, mark: bool) -> Step:
        return self._pictures.step(frame_index, image, self._table, before=self._frame_index, mark=mark)

    def _advance(self, step: Step, *, hold_unconfirmed: bool) -> None:
        frame_index, before = step.frame_index, self._frame_index
        self._frame_index = frame_index
        if self.scene_began == frame_index or self._outdated(frame_index):
            self._table = TrackTable.empty()
        if len(self._table):
            frames = 1 if before is None else frame_index - before
            move(self._table, step, frames=frames, hold_unconfirmed=hold_unconfirmed)

    def _outdated(self, frame_index: int) -> bool:
        last = self._updated_index
        return last is not None and frame_index - last > self._longest_frames + 1

    @property
    def _is_slow(self) -> bool:
        # Where each look comes later than the buffer is long, nothing would be remembered from one to the next.
        return max(self._gaps) > self._buffer_frames + 1

    def _mark_over_time(self, frame_index: int) -> None:
        lost_frames = _LEAST_DETECTIONS * max(self._gaps) if self._is_slow else self._buffer_frames
        table, oldest = self._table, frame_index - lost_frames - 1
        if np.minimum.reduce(table.seen, initial=oldest) < oldest:
            late = ((table.phase == LOST) & (table.seen < oldest)).nonzero()[0]
            table.phase[late] = OVER_TIME
            # The authors' program matches a frame longer (it sweeps one update late): the same at any rate.
            stale = (table.seen[late] < oldest - 1) & (table.since[late] != self._updated_index)
            if np.count_nonzero(stale):
                self._table = table.take(np.delete(np.arange(len(table)), late[stale]))

    @property
    def _fresh_frames(self) -> int:
        fresh = max(round(_OLD_S * self._fps), _OLD_GAPS * max(self._gaps, default=1))
        # After the first nobody knows yet when the next update comes.
        return self._longest_frames if len(self._gaps) == 1 and self._late_frames <= fresh else fresh

    def _growth(self, gap: int) -> float:
        # Before its second detection a track has no velocity, and a small object leaves its own box: never confirmed.
        # Larger boxes are of C-BIoU (Yang et al., WACV 2023); at the first match they mix up dense crowds.
        unsearched_s = gap / self._fps - min(1 / self._fps, _USUAL_STEP_S)
        return min(_MOST_GROWTH, self._settings.search_growth_per_s * unsearched_s)

    def _held(self, frame_index: int) -> _Floats:
        # The last boxes, moved with the camera alone: meanwhile a vehicle may have stopped.
        states = self._table.states.copy()
        states[kalman.POSITION] -= (frame_index - self._table.seen) * states[kalman.VELOCITY]
        return kalman.boxes_of(states)

    def _correct(self, seen: TrackerInput, detections: _Indices, frame_index: int, *, gap: int) -> None:
        table, found = self._table, detections >= 0
        rows = found.nonzero()[0]
        if not len(rows):
            return
        corrected = table.states.copy()  # all of them: those that were found are not worth picking out
        kalman.correct(corrected, seen.measured.take(detections, axis=1), gap=gap)
        np.copyto(table.states, corrected, where=found)
        np.copyto(table.heights, corrected[kalman.POSITION, 3], where=found)
        table.seen[found] = frame_index
        columns = detections.take(rows)
        confidences, votes = seen.confidences.take(columns), table.scores[1:]
        np.multiply(votes, self._settings.class_decay, out=votes, where=found)
        places = seen.class_ids.take(columns) * len(table) + rows
        votes.put(places, votes.take(places) + confidences)
        table.scores[0, rows] = confidences

    def _turn(self, detections: _Indices, frame_index: int) -> None:
        # Sets each track's phase after an update; removes ended tracks.
        table = self._table
        phase = np.where(detections >= 0, IF_FOUND.take(table.phase), IF_MISSED.take(table.phase))
        table.since[phase != table.phase] = frame_index
        table.phase[:] = phase
        # While lost, a track keeps its height: a velocity from the last partly hidden boxes would blow it up.
        table.states[kalman.VELOCITY, 3][phase == LOST] = 0
        living = (phase != ENDED).nonzero()[0]
        if len(living) < len(table):
            self._table = table.take(living)

    def _listed(self, frame_index: int, boxes: _Floats) -> Tracks:
        table = self._table
        width, height = boxes[2:] - boxes[:2]
        listed = table.phase >= TRACKED
        if frame_index != self._updated_index:
            listed &= table.seen >= frame_index - self._fresh_frames
        rows = (listed & (width * height > self._settings.min_box_area_px2)).nonzero()[0]
        ids, born, seen, since, _ = table.numbers.take(rows, axis=1)
        scores = table.scores.take(rows, axis=1)
        return Tracks(
            frame_index=frame_index,
            ids=ids,
            boxes_xyxy_px=boxes.take(rows, axis=1).T.astype(np.float32, order="C"),
            confidences=scores[0],
            class_ids=scores[1:].argmax(axis=0).astype(np.int32),
            born_frames=born,
            seen_frames=seen,
            started=since == frame_index,
        )
