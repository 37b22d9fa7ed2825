"""Tracks from one frame to the next: by their velocity, the camera's motion, and the optical flow inside them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from hvt_common.camera_motion import Affine, CameraMotion
from hvt_common.tracking import kalman
from hvt_common.tracking.flow import BoxFlow, Gray, box_flow
from hvt_common.tracking.track_table import TRACKED, UNCONFIRMED, TrackTable
from hvt_common.values import Image

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
