"""The geometry between the world in metres and the picture in pixels, for many bodies at once.

Pixel (0, 0) covers 0…1 on both axes, so its centre lies at 0.5; OpenCV puts it at 0, which `to_centres` allows for.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from hvt_scene.view.camera import Matrix

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
    # A tilted camera stretches one axis more than the other; one and a half covers what `Appearance` allows.
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
    """(2, 3) from OpenCV's sprite coordinates to its frame coordinates.

    Args:
        linear: (2, 2) metres in body axes to pixels.
        spot: (2,) pixel of the body's centre.
        shape: of the sprite's picture.
        grain: metres a sprite pixel on x and on y.
    """
    scaled = linear * np.array(grain)
    shift = spot - scaled @ np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2]) - 0.5
    return np.concatenate([scaled, shift[:, None]], axis=1)


def to_centres(pose: Matrix, *, m_per_px: float) -> Matrix:
    """The pose from OpenCV's coordinates of a ground picture to its coordinates of the frame, (3, 3)."""
    to_world = np.array([[m_per_px, 0, 0.5 * m_per_px], [0, m_per_px, 0.5 * m_per_px], [0, 0, 1]])
    return np.asarray(np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]]) @ pose @ to_world, np.float64)
