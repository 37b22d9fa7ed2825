"""Tracks from one frame to the next: by their velocity, the camera's motion, and the optical flow inside them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.camera_motion import Affine, CameraMotion
from hvt_common.tracking import kalman
from hvt_common.tracking.track_table import TRACKED, UNCONFIRMED, TrackTable
from hvt_common.values import Image

Gray = npt.NDArray[np.uint8]
_Floats = npt.NDArray[np.float64]

_SIDE: Final = 3
_POINTS: Final = _SIDE * _SIDE
_MIDDLE: Final = 0.7
"""Share of a box's sides that the points lie in: beyond it is the ground."""
_WINDOW_PX: Final = 9
_LEVELS: Final = 2
_AROUND_PX: Final = 64
_ALIGNED: Final = 2**_LEVELS
"""A part begins at a multiple of this: then its pixels of the smallest level are those of the whole picture."""
_LEAST_AGREEING: Final = 5
_MOST_APART_PX: Final = 1.5
_MOST_APART: Final = 0.15
"""Points agree where they lie so far from the median motion, of the box's shorter side, or in gray pixels."""
_MOST_CHANGED: Final = 30.0
"""Levels: a point that looks so different shows something else."""
_MOST_SCALE: Final = 1.1
_LEAST_PX: Final = 10.0
"""Least shorter side in the pictures: the windows around smaller objects mostly see the ground."""

_across = (np.arange(_SIDE) + 0.5) / _SIDE * _MIDDLE + (1 - _MIDDLE) / 2
_GRID: Final = np.stack(np.meshgrid(_across, _across), axis=-1).reshape(1, _POINTS, 2)


@dataclass(frozen=True, slots=True)
class BoxFlow:
    """The motion of N boxes, pixels of the full image."""

    shifts: _Floats
    """(N, 2) of the centres."""
    zooms: _Floats
    """(N,) of the sides."""
    found: npt.NDArray[np.bool_]
    """(N,) where the other two mean something."""


def box_flow(before: Gray, now: Gray, boxes: _Floats, *, expected: _Floats, size: tuple[int, int]) -> BoxFlow:
    """The motion of (N, 4) boxes between two pictures of equal shape, near the ``expected`` (N, 2) shifts.

    Boxes are in pixels of the full image, whose ``size`` is (width, height); the pictures may be smaller.
    """
    ratio = np.array([now.shape[1] / size[0], now.shape[0] / size[1]])
    large = ((boxes[:, 2:] - boxes[:, :2]) * ratio).min(axis=1) >= _LEAST_PX
    flow = BoxFlow(np.zeros((len(boxes), 2)), np.ones(len(boxes)), large.copy())
    if large.any():
        flow.shifts[large], flow.zooms[large], flow.found[large] = _of_large(
            before, now, boxes[large], expected[large], ratio
        )
    return flow


def _of_large(
    before: Gray, now: Gray, boxes: _Floats, expected: _Floats, ratio: _Floats
) -> tuple[_Floats, _Floats, npt.NDArray[np.bool_]]:
    starts, sides = boxes[:, None, :2] * ratio, (boxes[:, None, 2:] - boxes[:, None, :2]) * ratio
    points = starts + sides * _GRID
    first = (points - 0.5).reshape(-1, 1, 2).astype(np.float32)
    guess = first + np.repeat(expected * ratio, _POINTS, axis=0)[:, None].astype(np.float32)
    # Most of the time goes into the pictures' pyramids: only the surroundings of the boxes get one.
    ends = np.concatenate((first, guess))[:, 0]
    low = np.clip(ends.min(axis=0).astype(int) - _AROUND_PX, 0, None) // _ALIGNED * _ALIGNED
    high = np.minimum(ends.max(axis=0).astype(int) + _AROUND_PX, now.shape[::-1])
    if not 0 < 2 * np.prod(np.maximum(high - low, 0)) < now.size:  # it would only cost the copies
        low, high = np.zeros(2, int), np.array(now.shape[::-1])
    part = np.s_[low[1] : high[1], low[0] : high[0]]
    origin = low.astype(np.float32)
    moved, status, changed = cv2.calcOpticalFlowPyrLK(
        np.ascontiguousarray(before[part]),
        np.ascontiguousarray(now[part]),
        first - origin,
        guess - origin,
        winSize=(_WINDOW_PX, _WINDOW_PX),
        maxLevel=_LEVELS,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.05),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    shape = (len(boxes), _POINTS)
    good = (status.reshape(shape) == 1) & (changed.reshape(shape) < _MOST_CHANGED)
    shifts = (moved + origin - first).reshape(*shape, 2).astype(np.float64)
    median = np.partition(shifts, _POINTS // 2, axis=1)[:, _POINTS // 2, None]
    apart = np.abs(shifts - median).max(axis=2)
    good &= apart < np.maximum(_MOST_APART_PX, _MOST_APART * sides.min(axis=2))
    weights = good[:, :, None] / np.maximum(1, good.sum(axis=1))[:, None, None]
    middle, shift = (weights * points).sum(axis=1), (weights * shifts).sum(axis=1)
    around = weights * (points - middle[:, None])
    spread = (around * (points - middle[:, None])).sum(axis=(1, 2))
    growth = (around * (shifts - shift[:, None])).sum(axis=(1, 2)) / np.maximum(spread, 1e-9)
    growth = np.clip(growth, 1 / _MOST_SCALE - 1, _MOST_SCALE - 1)
    centre = (starts + sides / 2)[:, 0]
    shift += growth[:, None] * (centre - middle)
    return shift / ratio, 1 + growth, good.sum(axis=1) >= _LEAST_AGREEING


_MOST_GROWN: Final = 1.6
"""Times the height that was seen: then it is the road that is followed."""
_FLOW_WEIGHT: Final = 0.5
"""Weight of the motion seen against the velocity before it."""


@dataclass(frozen=True, slots=True)
class Step:
    """To a frame from the one before: the camera's motion, and that of the boxes where it was seen."""

    frame_index: int
    affine: Affine | None = None
    flow: BoxFlow | None = None
    gray: Gray | None = None


class Pictures:
    """The motion between frames as pictures show it; nothing unless ``enabled``."""

    def __init__(self, *, enabled: bool, longest_frames: int) -> None:
        self._camera = CameraMotion(scale=None) if enabled else None
        self._longest_frames = longest_frames
        self._size = (0, 0)
        """(width, height) of the images."""
        self.reset()

    def reset(self) -> None:
        self._newest: int | None = None
        """The frame of the newest one."""
        self.camera_step: Affine | None = None
        self.scene_began = -1
        if self._camera is not None:
            self._camera.reset()

    def shift(self) -> float:
        return 0.0 if self._camera is None else self._camera.shift()

    def still(self) -> bool:
        return self._camera is not None and self._camera.still()

    def step(
        self, frame_index: int, image: Image | None, table: TrackTable, *, before: int | None, mark: bool
    ) -> Step:
        """The step to this image from the frame ``before``; with ``mark`` `still` compares with it from now on."""
        camera, self.camera_step, step = self._camera, None, Step(frame_index)
        if camera is None:
            return step
        if image is not None:
            then, self.camera_step = camera.gray, camera.step(image)
            if camera.new_scene:
                self.scene_began = frame_index
            self._size = (image.shape[1], image.shape[0])
            step = Step(frame_index, self.camera_step, None, camera.gray)
            if before is not None and self._newest == before:
                step = self.with_flow(step, then, table, frames=frame_index - before)
            self._newest = frame_index
        if mark:
            camera.mark()
        return step

    def with_flow(self, step: Step, before: Gray | None, table: TrackTable, *, frames: int) -> Step:
        """The same step with the flow inside the tracks of the last detection; without it after a long time."""
        moving = (table.phase >= TRACKED).nonzero()[0]
        now = step.gray
        if before is None or now is None or before.shape != now.shape or not len(moving):
            return replace(step, flow=None)
        if frames > self._longest_frames:
            return replace(step, flow=None)
        then = table.states.take(moving, axis=-1)
        expected = then.copy()
        for _ in range(frames):
            kalman.coast(expected)
        if step.affine is not None:
            kalman.warp(expected, step.affine)
        shifts = (expected - then)[kalman.POSITION, :2].T.copy()
        boxes = kalman.boxes_of(then).T.copy()
        return replace(step, flow=box_flow(before, now, boxes, expected=shifts, size=self._size))


def move(table: TrackTable, step: Step, *, frames: int, hold_unconfirmed: bool) -> None:
    """Move all tracks to a frame, ``frames`` after the one before, in place."""
    states = table.states
    then = None if step.flow is None else states[kalman.POSITION].copy()
    for _ in range(frames - 1):
        kalman.coast(states)
    if hold_unconfirmed:
        # The authors' program matches unconfirmed tracks where they started, without the step to this frame.
        # They are at rest; it only changes the gain of the correction that confirms them.
        held = (table.phase == UNCONFIRMED).nonzero()[0]
        before = states.take(held, axis=2) if len(held) else None
        kalman.predict(states)
        if before is not None:
            states[:, :, held] = before
    else:
        kalman.coast(states)
    if step.affine is not None:
        kalman.warp(states, step.affine)
    if then is not None and step.flow is not None:
        _carry(table, then, step.flow, frames=frames)
    heights = states[kalman.POSITION, 3]
    np.maximum(heights, table.heights / _MOST_GROWN, out=heights)
    np.minimum(heights, table.heights * _MOST_GROWN, out=heights)


def _carry(table: TrackTable, then: kalman.States, flow: BoxFlow, *, frames: int) -> None:
    # Put the tracks to where the picture shows them, from their positions ``then``.
    rows = (table.phase >= TRACKED).nonzero()[0][flow.found]
    position, velocity = table.states[: kalman.VAR_P]
    seen = then.take(rows, axis=-1)
    seen[:2] += flow.shifts[flow.found].T
    seen[3] *= flow.zooms[flow.found]
    velocity[:2, rows] += _FLOW_WEIGHT * ((seen[:2] - position[:2, rows]) / frames)
    position[:, rows] = seen
