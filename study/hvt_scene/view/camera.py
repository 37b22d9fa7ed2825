"""Where the camera is: world metres to source pixels at a moment."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hvt_scene.appearance import Appearance

_FOCAL_WIDTHS = 1.2
"""Focal length, picture widths."""

Matrix = npt.NDArray[np.float64]
"""(3, 3) homography or affine map of homogeneous points."""


def _ease(share: float) -> float:
    """0…1 to 0…1 without a jerk at either end (smoothstep)."""
    return share * share * (3 - 2 * share)


@dataclass(frozen=True, slots=True)
class CameraPlace:
    """Where a camera is and points: x to the east, y to the south; angles as those of aircraft."""

    x_m: float
    y_m: float
    height_m: float
    yaw_deg: float
    pitch_deg: float
    hfov_deg: float


@dataclass(frozen=True, slots=True)
class Camera:
    """A slow flight from ``start_m`` to ``end_m``: pan, zoom, roll, tilt and shake, continuous in time."""

    size: tuple[int, int]
    appearance: Appearance
    duration_s: float
    start_m: tuple[float, float]
    end_m: tuple[float, float]
    phases: tuple[float, float, float, float]

    def pose(self, t_s: float) -> Matrix:
        """World metres to source pixels, (3, 3); pixel (0, 0) covers 0…1, so its centre maps from 0.5."""
        share = min(1.0, max(0.0, t_s / self.duration_s))
        eased = _ease(share)
        wide, high = self.size
        centre = [a + (b - a) * eased for a, b in zip(self.start_m, self.end_m, strict=True)]
        roll = math.radians(
            self.appearance.roll_deg[0] + (self.appearance.roll_deg[1] - self.appearance.roll_deg[0]) * eased
        )
        shake = self._shake(t_s)
        roll += 0.0006 * self.appearance.shake_px * math.sin(1.9 * t_s + self.phases[3])
        scale = wide / self._width_m(share)
        cosine, sine = scale * math.cos(roll), scale * math.sin(roll)
        plane = np.array(
            [
                [cosine, -sine, -cosine * centre[0] + sine * centre[1]],
                [sine, cosine, -sine * centre[0] - cosine * centre[1]],
                [0, 0, 1],
            ]
        )
        shift = np.array([[1, 0, wide / 2 + shake[0]], [0, 1, high / 2 + shake[1]], [0, 0, 1.0]])
        return np.asarray(shift @ self._tilt() @ plane, np.float64)

    def place(self, t_s: float) -> CameraPlace:
        """Where the pinhole stands that `pose` is of, but for its shake, which is of the picture."""
        share = min(1.0, max(0.0, t_s / self.duration_s))
        eased = _ease(share)
        centre = [a + (b - a) * eased for a, b in zip(self.start_m, self.end_m, strict=True)]
        roll_deg = (
            self.appearance.roll_deg[0] + (self.appearance.roll_deg[1] - self.appearance.roll_deg[0]) * eased
        )
        turn, tilt = math.radians(roll_deg), math.radians(self.appearance.tilt_deg)
        range_m = _FOCAL_WIDTHS * self._width_m(share)  # along the optical axis
        back_m = range_m * math.sin(tilt)
        return CameraPlace(
            x_m=centre[0] + back_m * math.sin(turn),
            y_m=centre[1] + back_m * math.cos(turn),
            height_m=range_m * math.cos(tilt),
            yaw_deg=-roll_deg % 360,
            pitch_deg=self.appearance.tilt_deg - 90,
            hfov_deg=math.degrees(2 * math.atan(0.5 / _FOCAL_WIDTHS)),
        )

    def _width_m(self, share: float) -> float:
        first, middle, last = self.appearance.width_m
        if share < 0.5:
            return first + (middle - first) * _ease(share * 2)
        return middle + (last - middle) * _ease(share * 2 - 1)

    def _tilt(self) -> Matrix:
        """A pinhole turned about the picture's horizontal axis."""
        angle, focal = math.radians(self.appearance.tilt_deg), _FOCAL_WIDTHS * self.size[0]
        return np.array([[1, 0, 0], [0, math.cos(angle), 0], [0, -math.sin(angle) / focal, 1]])

    def _shake(self, t_s: float) -> tuple[float, float]:
        gain = self.appearance.shake_px * self.size[0] / 1920
        first, second, third, _ = self.phases
        x = math.sin(2.3 * t_s + first) + 0.35 * math.sin(7.1 * t_s + second)
        y = math.sin(1.7 * t_s + third) + 0.35 * math.sin(6.3 * t_s + first)
        return (gain * x, gain * y)
