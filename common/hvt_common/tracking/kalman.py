"""The constant-velocity Kalman filter of ByteTrack, for all tracks of a frame at once.

Model and noise weights are those of DeepSORT and ByteTrack (Wojke et al., ICIP 2017; Zhang et al., ECCV 2022):
the state is centre x, centre y, aspect ratio a = width / height, height h, and their velocities in one frame.

In this model each coordinate is coupled with its own velocity only: the transition adds velocity to position,
and initial, process and measurement noise are all diagonal. The 8x8 covariance therefore keeps zeros everywhere
but in four 2x2 blocks, exactly and for ever, and a track is held as one (5, 4) array without any 8x8 product:

    POSITION   x   y   a   h     pixels, a without unit
    VELOCITY   …                 per frame
    VAR_P      …                 variance of the position
    COV_PV     …                 covariance of position and velocity
    VAR_V      …                 variance of the velocity

``States`` is (N, 5, 4) float64 in that order. x, y and h share one noise (a multiple of h), so their three columns
of variances are always equal: position uncertainty is a circle, which rotating the image leaves as it is.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

States = npt.NDArray[np.float64]
"""(N, 5, 4) float64: position, velocity and the three parts of each coordinate's 2x2 covariance."""

POSITION, VELOCITY, VAR_P, COV_PV, VAR_V = range(5)

_POSITION_WEIGHT = 1 / 20
_VELOCITY_WEIGHT = 1 / 160

# Variances are (weight * h)^2 for x, y, h and a constant for the aspect ratio: _BY_HEIGHT * h^2 + _FIXED.
_LENGTHS = np.array([1.0, 1.0, 0.0, 1.0])
_ASPECT = np.array([0.0, 0.0, 1.0, 0.0])
_INITIAL_BY_HEIGHT = np.outer([(2 * _POSITION_WEIGHT) ** 2, 0, (10 * _VELOCITY_WEIGHT) ** 2], _LENGTHS)
_INITIAL_FIXED = np.outer([1e-2**2, 0, 1e-5**2], _ASPECT)
_PROCESS_BY_HEIGHT = np.outer([_POSITION_WEIGHT**2, 0, _VELOCITY_WEIGHT**2], _LENGTHS)
_PROCESS_FIXED = np.outer([1e-2**2, 0, 1e-5**2], _ASPECT)
_MEASURED_BY_HEIGHT = _POSITION_WEIGHT**2 * _LENGTHS
_MEASURED_FIXED = 1e-1**2 * _ASPECT


def measure(boxes_xyxy_px: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Centre x, centre y, aspect ratio, height of (N, 4) boxes with a height above zero; (N, 4) float64."""
    measured = np.empty_like(boxes_xyxy_px)
    size = boxes_xyxy_px[:, 2:] - boxes_xyxy_px[:, :2]
    measured[:, :2] = boxes_xyxy_px[:, :2] + size / 2
    measured[:, 2] = size[:, 0] / size[:, 1]
    measured[:, 3] = size[:, 1]
    return measured


def boxes_of(states: States) -> npt.NDArray[np.float64]:
    """The (N, 4) float64 boxes x1 y1 x2 y2 in pixels that the positions mean; never inside out."""
    position = states[:, POSITION]
    # Only a long prediction of a shrinking box can take height (or aspect ratio) below zero.
    half = np.maximum(position[:, 2:], 0)
    half[:, 0] *= half[:, 1]
    half *= 0.5
    centre = position[:, :2]
    return np.concatenate((centre - half, centre + half), axis=1)


def initiate(measured: npt.NDArray[np.float64]) -> States:
    """States of new tracks from (N, 4) measurements (x, y, a, h), at rest and with wide velocity variance."""
    states = np.zeros((len(measured), 5, 4))
    states[:, POSITION] = measured
    height_squared = np.square(measured[:, 3])[:, None, None]
    states[:, VAR_P:] = _INITIAL_BY_HEIGHT * height_squared + _INITIAL_FIXED
    return states


def predict(states: States) -> None:
    """Step all states by one frame, in place."""
    position, velocity, var_p, cov_pv, var_v = (states[:, part] for part in range(5))
    noise = _PROCESS_BY_HEIGHT * np.square(position[:, 3])[:, None, None]
    noise += _PROCESS_FIXED
    position += velocity
    var_p += cov_pv
    cov_pv += var_v
    var_p += cov_pv  # in all 2 * cov_pv + var_v
    states[:, VAR_P:] += noise


def correct(states: States, measured: npt.NDArray[np.float64], *, gap: int = 1) -> None:
    """Take in one measurement (x, y, a, h) a state, in place; ``measured`` is (N, 4) in the order of ``states``.

    ``gap`` is the number of frames since the measurement before. The authors' noise of the aspect ratio averages it
    over some ten measurements, one a frame; where those are rare, what drives into the picture would keep the shape
    of its bonnet for seconds. So a measurement counts for the more, the longer nothing was measured.
    """
    height_squared = np.square(states[:, POSITION, 3])[:, None]
    measured_var = _MEASURED_BY_HEIGHT * height_squared + _MEASURED_FIXED / gap**2
    innovation_var = states[:, VAR_P] + measured_var
    gain = states[:, VAR_P:VAR_V] / innovation_var[:, None]
    states[:, :VAR_P] += gain * (measured - states[:, POSITION])[:, None]
    states[:, VAR_V] -= gain[:, 1] * states[:, COV_PV]
    states[:, VAR_P:VAR_V] -= gain * states[:, VAR_P, None]


def warp(states: States, affine: npt.NDArray[np.float64]) -> None:
    """Move all states along with the camera, in place.

    ``affine`` is (2, 3), previous to current frame in pixels. As in BoT-SORT (Aharon et al., 2022, section 3.2) its
    linear part turns position and velocity, and its translation moves the position. BoT-SORT turns width and
    height too; here the box stays upright, the height scales with the linear part, and the aspect ratio stays.
    x and y have equal variance and no covariance, so a rotation leaves their covariance unchanged and a scale
    multiplies it by its square: for a similarity this is exact, for a general affine map its mean scale is used.
    """
    linear = affine[:, :2]
    scale = float(np.sqrt(abs(np.linalg.det(linear))))
    states[:, :VAR_P, :2] = states[:, :VAR_P, :2] @ linear.T
    states[:, POSITION, :2] += affine[:, 2]
    states[:, :VAR_P, 3] *= scale
    states[:, VAR_P:] *= np.where(_LENGTHS > 0, scale**2, 1.0)
