"""The constant-velocity Kalman filter of ByteTrack, for all tracks of a frame at once.

Model and noise weights are those of DeepSORT and ByteTrack (Wojke et al., ICIP 2017; Zhang et al., ECCV 2022):
the state is centre x, centre y, aspect ratio a = width / height, height h, and their velocities in one frame.

In this model each coordinate is coupled with its own velocity only: the transition adds velocity to position,
and initial, process and measurement noise are all diagonal. The 8x8 covariance therefore keeps zeros everywhere
but in four 2x2 blocks, exactly and for ever, and a track is held as 5x4 numbers without any 8x8 product:

    POSITION   x   y   a   h     pixels, a without unit
    VELOCITY   …                 per frame
    VAR_P      …                 variance of the position
    COV_PV     …                 covariance of position and velocity
    VAR_V      …                 variance of the velocity

``States`` is (5, 4, N) float64 in that order, one column a track: numpy then goes through all tracks in one run.
x, y and h share one noise (a multiple of h), so their three variances are always equal: position uncertainty is a
circle, which rotating the image leaves as it is.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.float64]

States = npt.NDArray[np.float64]
"""(5, 4, N) float64: position, velocity and the three parts of each coordinate's 2x2 covariance."""

POSITION, VELOCITY, VAR_P, COV_PV, VAR_V = range(5)

_POSITION_WEIGHT = 1 / 20
_VELOCITY_WEIGHT = 1 / 160

# Variances are (weight * h)^2 for x, y, h and a constant for the aspect ratio: _BY_HEIGHT * h^2 + _FIXED.
_LENGTHS = np.array([1.0, 1.0, 0.0, 1.0])[:, None]
_ASPECT = 1 - _LENGTHS
_INITIAL_BY_HEIGHT = np.multiply.outer(
    [(2 * _POSITION_WEIGHT) ** 2, 0, (10 * _VELOCITY_WEIGHT) ** 2], _LENGTHS
)
_INITIAL_FIXED = np.multiply.outer([1e-2**2, 0, 1e-5**2], _ASPECT)
_PROCESS_BY_HEIGHT = np.multiply.outer([_POSITION_WEIGHT**2, 0, _VELOCITY_WEIGHT**2], _LENGTHS)
_PROCESS_FIXED = np.multiply.outer([1e-2**2, 0, 1e-5**2], _ASPECT)
_MEASURED_BY_HEIGHT = _POSITION_WEIGHT**2 * _LENGTHS
_MEASURED_ASPECT = 1e-1**2

_SIZE_DECAY = 0.5
_MOST_SIZE_STEP = 0.1
"""Between detections the velocity of a box's sides halves with each frame, and is at most this share of them."""


def measure(boxes: _Floats) -> _Floats:
    """Centre x, centre y, aspect ratio, height of boxes with a height above zero; both (4, N) float64."""
    size = boxes[2:] - boxes[:2]
    return np.concatenate((boxes[:2] + size / 2, size[:1] / size[1:], size[1:]))


def boxes_of(states: States) -> _Floats:
    """The (4, N) float64 boxes x1 y1 x2 y2 in pixels that the positions mean; never inside out."""
    # Only a long prediction of a shrinking box can take height (or aspect ratio) below zero.
    half = np.maximum(states[POSITION, 2:], 0)
    half[0] *= half[1]
    half *= 0.5
    boxes: _Floats = np.empty_like(states[POSITION])
    np.subtract(states[POSITION, :2], half, out=boxes[:2])
    np.add(states[POSITION, :2], half, out=boxes[2:])
    return boxes


def initiate(measured: _Floats) -> States:
    """States of new tracks from (4, N) measurements (x, y, a, h), at rest and with wide velocity variance."""
    states = np.zeros((5, *measured.shape))
    states[POSITION] = measured
    states[VAR_P:] = _INITIAL_BY_HEIGHT * np.square(measured[3]) + _INITIAL_FIXED
    return states


def predict(states: States) -> None:
    """Step all states by one frame, in place."""
    position, velocity, var_p, cov_pv, var_v = states
    noise = _PROCESS_BY_HEIGHT * np.square(position[3])
    noise += _PROCESS_FIXED
    position += velocity
    var_p += cov_pv
    cov_pv += var_v
    var_p += cov_pv  # in all 2 * cov_pv + var_v
    states[VAR_P:] += noise


def coast(states: States) -> None:
    """Step by one frame without detection, in place: a box that grew or shrank on and on would soon fit nothing."""
    limit = _MOST_SIZE_STEP * np.abs(states[POSITION, 2:])
    sizes = states[VELOCITY, 2:]
    np.clip(_SIZE_DECAY * sizes, -limit, limit, out=sizes)
    predict(states)


def correct(states: States, measured: _Floats, *, gap: int = 1) -> None:
    """Take in one measurement (x, y, a, h) a state, in place; ``measured`` is (4, N) in the order of ``states``.

    ``gap`` is the number of frames since the measurement before. The authors' noise of the aspect ratio averages it
    over some ten measurements, one a frame; where those are rare, a car that drives into the picture would keep the
    shape of its bonnet for seconds. So a measurement counts for the more, the longer nothing was measured.
    """
    innovation_var = states[VAR_P] + _MEASURED_BY_HEIGHT * np.square(states[POSITION, 3])
    innovation_var[2] += _MEASURED_ASPECT / gap**2
    gain = states[VAR_P:VAR_V] / innovation_var
    states[:VAR_P] += gain * (measured - states[POSITION])
    states[VAR_V] -= gain[1] * states[COV_PV]
    states[VAR_P:VAR_V] -= gain * states[VAR_P]


def warp(states: States, affine: _Floats) -> None:
    """Move all states along with the camera, in place.

    ``affine`` is (2, 3), previous to current frame in pixels. As in BoT-SORT (Aharon et al., 2022, section 3.2) its
    linear part turns position and velocity, and its translation moves the position. BoT-SORT turns width and
    height too; here the box stays upright, the height scales with the linear part, and the aspect ratio stays.
    x and y have equal variance and no covariance, so a rotation leaves their covariance unchanged and a scale
    multiplies it by its square: for a similarity this is exact, for a general affine map its mean scale is used.
    """
    linear = affine[:, :2]
    scale = float(np.sqrt(abs(np.linalg.det(linear))))
    states[:VAR_P, :2] = linear @ states[:VAR_P, :2]
    states[POSITION, :2] += affine[:, 2:]
    states[:VAR_P, 3] *= scale
    states[VAR_P:] *= np.where(_LENGTHS > 0, scale**2, 1.0)
