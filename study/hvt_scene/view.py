"""From the world to pixels: the camera on its way, projection of many bodies at once, and layers laid over the frame.

Pixel (0, 0) covers 0…1 on both axes, so its centre lies at 0.5; OpenCV puts it at 0, which `to_centres` allows for.
A frame has four channels while it is built: OpenCV warps those fastest.
"""

import math
from dataclasses import dataclass

import cv2
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
        share, centre, roll_deg = self._on_its_way(t_s)
        wide, high = self.size
        shake = self._shake(t_s)
        roll = math.radians(roll_deg) + 0.0006 * self.appearance.shake_px * math.sin(
            1.9 * t_s + self.phases[3]
        )
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
        share, centre, roll_deg = self._on_its_way(t_s)
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

    def _on_its_way(self, t_s: float) -> tuple[float, list[float], float]:
        share = min(1.0, max(0.0, t_s / self.duration_s))
        eased = _ease(share)
        first, last = self.appearance.roll_deg
        centre = [a + (b - a) * eased for a, b in zip(self.start_m, self.end_m, strict=True)]
        return share, centre, first + (last - first) * eased

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


Floats = npt.NDArray[np.float64]


def tangents(pose: Matrix, places: Floats) -> Floats:
    """The pose near each place, (N, 2, 3): metres from the place to source pixels. ``places`` is (N, ≥2) x, y."""
    points = np.concatenate([places[:, :2], np.ones((len(places), 1))], axis=1) @ pose.T
    depth = points[:, 2, None]
    spots = points[:, :2] / depth
    linear = (pose[:2, :2] - spots[:, :, None] * pose[2, :2]) / depth[:, :, None]
    return np.concatenate([linear, spots[:, :, None]], axis=2)


def turns(places: Floats) -> Floats:
    """(N, 2, 2) rotations from body to world axes. ``places`` is (N, 4) x, y, cos, sin."""
    cosine, sine = places[:, 2], places[:, 3]
    return np.stack([np.stack([cosine, -sine], 1), np.stack([sine, cosine], 1)], 1)


def project(points_m: Floats, local: Floats) -> Floats:
    """(N, M, 2) points in metres about each place, by (N, 2, 3) maps, to (N, M, 2) pixels."""
    return np.asarray(points_m @ local[:, :, :2].transpose(0, 2, 1) + local[:, None, :, 2], np.float64)


def near_frame(local: Floats, reach_m: Floats, *, size: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """(N,) whether a thing that reaches so far from its place may touch the frame."""
    grain = np.sqrt(np.abs(np.linalg.det(local[:, :, :2])))
    # A tilted camera stretches one axis more than the other; one and a half covers all tilts of `Appearance`.
    margin = (1.5 * reach_m * grain)[:, None]
    spots = local[:, :, 2]
    return np.asarray(((spots > -margin) & (spots < np.array(size) + margin)).all(1), np.bool_)


def bounds(pixels: Floats, *, size: tuple[int, int], margin_px: int) -> npt.NDArray[np.int64]:
    """(N, 4) x0 y0 x1 y1 whole pixels that (N, M, 2) points touch, with a margin, clipped to the frame."""
    low = np.floor(pixels.min(1)).astype(np.int64) - margin_px
    high = np.ceil(pixels.max(1)).astype(np.int64) + margin_px
    limit = np.array(size)
    return np.concatenate([np.clip(low, 0, limit), np.clip(high, 0, limit)], axis=1)


def sprite_matrix(
    linear: Floats, spot: Floats, *, shape: tuple[int, ...], grain: tuple[float, float]
) -> Matrix:
    """(2, 3) from OpenCV's coordinates of a sprite of ``shape`` to its coordinates of the frame.

    ``linear`` (2, 2) takes metres in body axes to pixels, ``spot`` (2,) is the pixel of the body's centre, and
    ``grain`` metres a sprite pixel on x and on y.
    """
    scaled = linear * np.array(grain)
    shift = spot - scaled @ np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2]) - 0.5
    return np.concatenate([scaled, shift[:, None]], axis=1)


def to_centres(pose: Matrix, *, m_per_px: float) -> Matrix:
    """The pose from OpenCV's coordinates of a ground picture to its coordinates of the frame, (3, 3)."""
    to_world = np.array([[m_per_px, 0, 0.5 * m_per_px], [0, m_per_px, 0.5 * m_per_px], [0, 0, 1]])
    return np.asarray(np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]]) @ pose @ to_world, np.float64)


Bgra = npt.NDArray[np.uint8]
"""(h, w, 4) uint8, premultiplied by alpha; in a frame the fourth channel means nothing."""

_SHIFT = 4


def darken(frame: Bgra, shadows_px: Floats, *, strength: float) -> None:
    """Take ``strength`` (0…1) of the light inside the hulls of (N, M, 2) points, once even where they overlap."""
    high, wide = frame.shape[:2]
    mask = np.full((high, wide), 255, np.uint8)
    left_over = 255 * (1 - strength)
    fixed = np.round((shadows_px - 0.5) * (1 << _SHIFT)).astype(np.int32)
    for points in fixed:
        cv2.fillConvexPoly(mask, cv2.convexHull(points), left_over, cv2.LINE_AA, _SHIFT)
    for x0, y0, x1, y1 in bounds(shadows_px, size=(wide, high), margin_px=1).tolist():
        if x1 > x0 and y1 > y0:
            light = mask[y0:y1, x0:x1]
            region = frame[y0:y1, x0:x1]
            region[:] = cv2.multiply(region, cv2.cvtColor(light, cv2.COLOR_GRAY2BGRA), scale=1 / 255)
            light[:] = 255  # a neighbour's overlapping region must not darken it again


def blend(frame: Bgra, box: list[int], picture: Bgra, *, matrix: Matrix, gain: float) -> None:
    """Warp a picture into the box x0 y0 x1 y1 of the frame, over the pixels there; ``gain`` lights its colours."""
    x0, y0, x1, y1 = box
    if x1 <= x0 or y1 <= y0:
        return
    shifted = matrix.copy()
    shifted[:, 2] -= (x0, y0)
    layer = cv2.warpAffine(picture, shifted, (x1 - x0, y1 - y0), flags=cv2.INTER_LINEAR)
    through = cv2.cvtColor(cv2.bitwise_not(cv2.extractChannel(layer, 3)), cv2.COLOR_GRAY2BGRA)
    if abs(gain - 1) > 0.02:
        layer = cv2.convertScaleAbs(layer, alpha=gain)
    region = frame[y0:y1, x0:x1]
    region[:] = cv2.add(cv2.multiply(region, through, scale=1 / 255), layer)
