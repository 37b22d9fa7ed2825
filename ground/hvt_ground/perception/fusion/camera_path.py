"""The camera's motion over the last seconds: boxes are moved from one frame to another."""

from __future__ import annotations

from collections import deque

import numpy as np
import numpy.typing as npt

from hvt_common.camera_motion import Affine

_MOST_CACHED = 256

_Floats = npt.NDArray[np.float64]


class CameraPath:
    """The motion between decoded frames, and from it that between any two frames.

    Between two decoded frames the motion is spread evenly over the frames; after the newest it goes on as it was
    for ``ahead_frames`` and then stands; before the oldest it stands. ``frames`` motions are remembered.
    """

    def __init__(self, *, ahead_frames: int, frames: int = 90) -> None:
        self._ahead_frames = ahead_frames
        self._steps: deque[tuple[int, int, _Floats]] = deque(maxlen=frames)
        self._cached: dict[tuple[int, int], Affine] = {}
        """Results since the last picture: a hundred boxes need the same two frames."""

    def add(self, affine: Affine, *, start: int, end: int) -> None:
        """Take the (2, 3) map from the picture of frame ``start`` to that of ``end``, base pixels, end > start."""
        self._steps.append((start, end, np.vstack((affine, [0.0, 0.0, 1.0]))))
        self._cached.clear()

    def between(self, start: int, end: int) -> Affine:
        """The (2, 3) map from the base pixels of one frame to those of another, either of which may be the later."""
        affine = self._cached.get((start, end))
        if affine is None:
            affine = self._cached[start, end] = self._between(start, end)
            if len(self._cached) > _MOST_CACHED:
                self._cached.clear()
        return affine

    def _between(self, start: int, end: int) -> Affine:
        if start > end:
            return np.asarray(np.linalg.inv(_whole(self._between(end, start)))[:2], np.float64)
        whole = np.eye(3)
        for first, last, step in self._steps:
            shared = min(end, last) - max(start, first)
            if shared > 0:
                whole = _part(step, shared / (last - first)) @ whole
        if self._steps:
            first, last, step = self._steps[-1]
            frames = min(end - max(start, last), self._ahead_frames)
            if frames > 0:
                whole = np.linalg.matrix_power(_part(step, 1 / (last - first)), frames) @ whole
        return np.asarray(whole[:2], np.float64)

    def carry(self, boxes: _Floats, *, start: int, end: int) -> _Floats:
        """(N, 4) boxes of frame ``start``, base pixels, where they lie at frame ``end`` if only the camera moves.

        They stay upright: the centre is mapped, the sides grow by the mean scale.
        """
        if start == end or not self._steps or not len(boxes):
            return boxes
        affine = self.between(start, end)
        centres = (boxes[:, :2] + boxes[:, 2:]) / 2 @ affine[:, :2].T + affine[:, 2]
        halves = (boxes[:, 2:] - boxes[:, :2]) / 2 * np.sqrt(abs(np.linalg.det(affine[:, :2])))
        return np.concatenate((centres - halves, centres + halves), axis=1)


def _whole(affine: Affine) -> _Floats:
    return np.vstack((affine, [0.0, 0.0, 1.0]))


def _part(step: _Floats, share: float) -> _Floats:
    # A share of a small motion: linear in its distance from standing still.
    return step if share == 1 else np.eye(3) + (step - np.eye(3)) * share
