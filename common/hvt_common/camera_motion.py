"""The camera's motion between two frames, and whether the second is of another scene, from the image alone."""

from collections import deque
from typing import Any, Final, cast

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.values import Image

_Thumbnail = npt.NDArray[np.float32]

_HALFWAY_PX: Final = (320, 180)
_THUMBNAIL_PX: Final = (32, 18)
_LEAST_ALIKE: Final = 0.3
"""Two pictures a third of a second apart that are less alike may be of two scenes. See `_alike`."""
_USUAL_TIMES: Final = 1.3
"""Multiple of the usual difference beyond noise, waves and steady motion."""
_EXPOSURE: Final = 16.0
"""The most levels by which the whole picture may become brighter or darker from one step to the next."""
_NEWEST: Final = 4
"""The usual difference is the largest of this many: a source that repeats pictures has differences of 0 between."""
_SCENE_LEVELS: Final = 4.0
"""Two scenes of less mean difference are a keyframe's sharper picture of the same water or fog."""


class SceneChange:
    """Takes one picture after the other, in order: a cut, another camera, a clip's next part. No clock of its own.

    Two pictures are compared as thumbnails. That they do not correlate is not enough: over water, snow and fog or at
    night a thumbnail holds little but noise, and that of two pictures never correlates; nor do pictures of a fast
    flight. So they must also differ by clearly more than the newest pictures of this scene did from each other.
    """

    def __init__(self) -> None:
        self._before: tuple[_Thumbnail, np.float32] | None = None
        """The last picture less its mean, and that."""
        self._usual: deque[float] = deque(maxlen=_NEWEST)
        """Differences of two pictures lately, levels."""

    def take(self, image: Image) -> bool:
        """Whether this picture, BGR or gray, has nothing to do with the one just before."""
        # Fractions of a level: rounded means of thousands of pixels would be a flat scene's only contrast.
        halfway = cv2.resize(image, _HALFWAY_PX, interpolation=cv2.INTER_AREA).astype(np.float32)
        thumbnail = cv2.resize(halfway, _THUMBNAIL_PX, interpolation=cv2.INTER_AREA)
        small = np.asarray(thumbnail, np.float32).ravel()
        level = small.mean()
        here, before = small - level, self._before
        self._before = here, level
        if before is None:
            return False
        there, brighter = before[0], float(level - before[1])
        difference = float(np.abs(here - there).mean()) + max(0.0, abs(brighter) - _EXPOSURE)
        usual = max(self._usual, default=None)
        self._usual.append(difference)
        if usual is None:
            return False
        new = difference > max(_SCENE_LEVELS, _USUAL_TIMES * usual)
        return new and _alike(here, there) < _LEAST_ALIKE


def _alike(here: _Thumbnail, there: _Thumbnail) -> float:
    # Correlation, less where one has far more contrast than the other: Lin's concordance, without means.
    energy = float(here @ here + there @ there)
    return 2 * float(here @ there) / energy if energy else 1.0


Affine = npt.NDArray[np.float64]
"""(2, 3) float64: ``current = affine[:, :2] @ previous + affine[:, 2]``, both in pixels of the full image."""

_Gray = npt.NDArray[np.uint8]
_Points = npt.NDArray[np.float32]

_WORKING_SIDE_PX: Final = 320
_MAX_CORNERS: Final = 250
_CORNER_QUALITY: Final = 0.01
_CORNER_DISTANCE_PX: Final = 7
_FLOW_WINDOW_PX: Final = 11
"""With 15, and OpenCV's 30 steps, it takes 2.5 times as long, and pictures lie no better on each other."""
_FLOW_LEVELS: Final = 3
_FLOW_UNTIL: Final = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.03)
_RANSAC_PX: Final = 1.0
# Fewer corners that agree than this, or a smaller share of them, is chance: objects, noise, an empty sky.
_LEAST_INLIERS: Final = 12
_LEAST_INLIER_SHARE: Final = 0.3
_STIR_PX: Final = 1.0
"""In the reduced picture: a smaller motion is taken as it is, and the camera stands."""
_BLOCKS: Final = (16, 9)
_BLOCK_LEVELS: Final = 2.0
_BLOCK_SHARE: Final = 0.85
"""A block speaks for the motion that leaves this share of the other's difference, and that is at least the levels."""
_LEAST_BLOCKS: Final = 3
"""So many stand in each half of the picture of a camera that stands."""
_BAR_LEVELS: Final = 12
"""A row or column within these is a bar at the border, not a part of the picture."""
_STANDING_BIAS: Final = 2.0
"""A camera that stood needs so many blocks for each that says it still does: it passes for one in traffic."""
# No camera zooms or rolls this far between two frames: such an estimate is wrong.
_SCALE_RANGE: Final = (0.5, 2.0)
_STILL_SHIFT: Final = 0.03
"""The most of `CameraMotion.shift`."""
_STILL_CHANGED: Final = 0.006
_CHANGED_LEVELS: Final = 16
_BLUR_PX: Final = 5
"""In the reduced picture; noise and the coding of a base stream are not motion."""


class CameraMotion:
    """Estimates the camera's motion from frame to frame on a downscaled gray image.

    ``scale`` in 0…1 is the size of that image relative to the frame: smaller is faster and less precise. None brings
    the longer side to 320 pixels, which a tracker needs no more than: 0.1 of them is the median error.
    """

    def __init__(self, *, scale: float | None = 0.5) -> None:
        self._scale = scale
        self._previous: _Gray | None = None
        self.gray: _Gray | None = None
        """The newest image, in half where it is large."""
        self.reset()

    def mark(self) -> None:
        """`still` compares with the newest image from now on."""
        self._marked, self._since = self._previous, np.eye(3)

    def still(self) -> bool:
        """Whether the newest image shows the same as the marked one, but for a small motion of the camera. 0.2 ms."""
        then, now = self._marked, self._previous
        if then is None or now is None or then.shape != now.shape or self.shift() > _STILL_SHIFT:
            return False
        moved = cv2.warpAffine(then, self._since[:2], now.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
        blurred = (cv2.blur(one, (_BLUR_PX, _BLUR_PX)) for one in (moved, now))
        changed = int(np.count_nonzero(cv2.absdiff(*blurred) > _CHANGED_LEVELS))
        return changed <= _STILL_CHANGED * now.size

    def shift(self) -> float:
        """The shift from the marked image to the newest, as a share of the sides: how much came into view."""
        if self._previous is None:
            return 0.0
        height, width = self._previous.shape
        return float((_ways(self._since[:2], self._previous) / (width, height)).sum())

    def step(self, image: Image) -> Affine:
        """The map from the image of the last call to this one, (2, 3) float64 in pixels of the full image.

        Images are BGR or gray. The identity at the first call, after a change of size, and where no motion is found.
        """
        full_size = (image.shape[1], image.shape[0])
        scale = min(1.0, _WORKING_SIDE_PX / max(full_size)) if self._scale is None else self._scale
        small_size = (max(1, round(full_size[0] * scale)), max(1, round(full_size[1] * scale)))
        if 2 * scale <= 1:  # first to a half: a third of the time of all at once
            half = max(1, full_size[0] // 2), max(1, full_size[1] // 2)
            image = np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), np.uint8)
        gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        self.gray = np.asarray(gray, np.uint8)
        current = np.asarray(cv2.resize(gray, small_size, interpolation=cv2.INTER_AREA), np.uint8)
        previous, self._previous = self._previous, current
        other = self._scene.take(current)
        self.new_scene = False
        if previous is None or previous.shape != current.shape:
            return np.eye(2, 3)
        estimate = _by_flow(previous, current)
        self.new_scene = other and estimate is None
        if estimate is None or not _plausible(estimate):
            return np.eye(2, 3)
        if _ways(estimate, current).max() <= _STIR_PX:
            self._stands = True
        else:
            self._stands = _stands(previous, current, estimate, stood=self._stands)
            if self._stands:
                return np.eye(2, 3)
        self._since = np.vstack((estimate, [0.0, 0.0, 1.0])) @ self._since
        return _at_full_size(estimate, full_size=full_size, small_size=small_size)

    def reset(self) -> None:
        """Forget the last image: the next call gives the identity."""
        self._previous = None
        self._scene = SceneChange()
        self._stands = False
        self.new_scene = False
        """Whether the newest image shows another scene than the one before."""
        self.mark()


def _by_flow(previous: _Gray, current: _Gray) -> Affine | None:
    # OpenCV's own types do not say that there may be no corner at all.
    corners = cast(
        "_Points | None",
        cv2.goodFeaturesToTrack(previous, _MAX_CORNERS, _CORNER_QUALITY, _CORNER_DISTANCE_PX),
    )
    if corners is None or len(corners) < _LEAST_INLIERS:
        return None
    how: dict[str, Any] = {
        "winSize": (_FLOW_WINDOW_PX,) * 2,
        "maxLevel": _FLOW_LEVELS,
        "criteria": _FLOW_UNTIL,
    }
    moved, found, _ = cv2.calcOpticalFlowPyrLK(previous, current, corners, np.empty_like(corners), **how)
    tracked = found.ravel() == 1
    if np.count_nonzero(tracked) < _LEAST_INLIERS:
        return None
    affine, inliers = cast(
        "tuple[Affine | None, _Gray]",
        cv2.estimateAffinePartial2D(
            corners[tracked], moved[tracked], method=cv2.RANSAC, ransacReprojThreshold=_RANSAC_PX
        ),
    )
    if affine is None:
        return None
    agreeing = np.count_nonzero(inliers)
    if agreeing < max(_LEAST_INLIERS, _LEAST_INLIER_SHARE * np.count_nonzero(tracked)):
        return None
    return np.asarray(affine, np.float64)


def _ways(affine: Affine, image: _Gray) -> npt.NDArray[np.float64]:
    # (2,) the longest ways of the image's corners along x and y.
    height, width = image.shape
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], np.float64)
    return np.asarray(np.abs(corners @ affine.T - corners[:, :2]).max(axis=0), np.float64)


def _stands(previous: _Gray, current: _Gray, estimate: Affine, *, stood: bool) -> bool:
    # A car that passes a camera on a plain road has most of the corners, and the estimate is its motion. The ground
    # has the larger area: each block of the picture speaks for the estimate or for a camera that stands. Bars, a
    # bonnet or a skid stand before a camera that flies, but not in each half of its picture.
    moved = cv2.warpAffine(previous, estimate, current.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    part = _between_bars(current)
    by_motion, at_rest = (
        cv2.resize(cv2.absdiff(one, current)[part].astype(np.float32), _BLOCKS, interpolation=cv2.INTER_AREA)
        for one in (moved, previous)
    )
    moves = np.count_nonzero((by_motion < _BLOCK_SHARE * at_rest) & (at_rest > _BLOCK_LEVELS))
    stands = (at_rest < _BLOCK_SHARE * by_motion) & (by_motion > _BLOCK_LEVELS)
    wide, high = _BLOCKS[0] // 2, _BLOCKS[1] // 2
    halves = stands[:, :wide], stands[:, wide:], stands[: high + 1], stands[high:]
    if min(map(np.count_nonzero, halves)) < _LEAST_BLOCKS:
        return False
    return bool((_STANDING_BIAS if stood else 1.0) * np.count_nonzero(stands) > moves)


def _between_bars(image: _Gray) -> tuple[slice, slice]:
    # The picture without the plain rows and columns at its border, and those beside them that coding blurs.
    found = []
    for axis in (1, 0):
        lines = np.flatnonzero(np.ptp(image, axis=axis) > _BAR_LEVELS)
        size = image.shape[1 - axis]
        low, high = (int(lines[0]), int(lines[-1]) + 1) if len(lines) else (0, size)
        found.append(slice(low + _BLUR_PX // 2 * bool(low), high - _BLUR_PX // 2 * (high < size)))
    return found[0], found[1]


def _plausible(affine: Affine) -> bool:
    # Of a similarity, which is never mirrored.
    scale = float(np.hypot(affine[0, 0], affine[1, 0]))
    return bool(np.isfinite(affine).all()) and _SCALE_RANGE[0] <= scale <= _SCALE_RANGE[1]


def _at_full_size(affine: Affine, *, full_size: tuple[int, int], small_size: tuple[int, int]) -> Affine:
    # The same motion between full images, whose pixel centres map as ``small = full * k + (k - 1) / 2``.
    ratio = np.array(small_size, np.float64) / np.array(full_size, np.float64)
    offset = (ratio - 1) / 2
    linear = affine[:, :2] * ratio / ratio[:, None]
    return np.column_stack((linear, (affine[:, :2] @ offset + affine[:, 2] - offset) / ratio))
