"""How the camera moved over the last seconds: boxes are carried from the tick that they were seen at to another."""

from __future__ import annotations

from collections import deque

import numpy as np
import numpy.typing as npt

from hvt_common.tracking.camera_motion import Affine

__all__ = ["CameraPath"]

_MOST_ASKED = 256

_Floats = npt.NDArray[np.float64]


class CameraPath:
    """The motion between decoded frames, and from it that between any two ticks.

    Between two decoded frames the motion is spread evenly over the ticks; after the newest it goes on as it was for
    ``ahead_ticks`` and then stands; before the oldest it stands.

    Args:
        ahead_ticks: for how long the last motion is believed to go on.
        frames: how many motions are remembered.
    """

    def __init__(self, *, ahead_ticks: int, frames: int = 90) -> None:
        self._ahead_ticks = ahead_ticks
        self._steps: deque[tuple[int, int, _Floats]] = deque(maxlen=frames)
        self._asked: dict[tuple[int, int], Affine] = {}
        """Since the last picture: a hundred boxes ask for the same two ticks."""

    def add(self, affine: Affine, *, start: int, end: int) -> None:
        """Take the (2, 3) map from the picture of frame ``start`` to that of ``end``, base pixels, end > start."""
        self._steps.append((start, end, np.vstack((affine, [0.0, 0.0, 1.0]))))
        self._asked.clear()

    def between(self, start: int, end: int) -> Affine:
        """The (2, 3) map from the base pixels of one tick to those of another, either of which may be the later."""
        affine = self._asked.get((start, end))
        if affine is None:
            affine = self._asked[start, end] = self._between(start, end)
            if len(self._asked) > _MOST_ASKED:
                self._asked.clear()
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
            ticks = min(end - max(start, last), self._ahead_ticks)
            if ticks > 0:
                whole = np.linalg.matrix_power(_part(step, 1 / (last - first)), ticks) @ whole
        return np.asarray(whole[:2], np.float64)

    def carry(self, boxes: _Floats, *, start: int, end: int) -> _Floats:
        """(N, 4) boxes in base pixels of tick ``start`` as they lie at tick ``end`` if nothing moves but the camera.

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
    """A share of a small motion: linear in its distance from standing still."""
    return step if share == 1 else np.eye(3) + (step - np.eye(3)) * share
