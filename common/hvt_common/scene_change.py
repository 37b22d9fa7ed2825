"""Whether a picture is of another scene than the one a moment before: a cut, another camera, a clip's next part.

Two pictures are compared as thumbnails. That they do not correlate is not enough: over water, snow and fog or at
night a thumbnail holds little but noise, and that of two pictures never correlates; nor do pictures of a fast
flight. So they must also differ by clearly more than the newest pictures of this scene did from each other.
"""

from __future__ import annotations

from collections import deque
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.units import SECOND_NS
from hvt_common.values import Image

_Thumbnail = npt.NDArray[np.float32]

_HALFWAY_PX: Final = (320, 180)
_THUMBNAIL_PX: Final = (32, 18)
_LEAST_ALIKE: Final = 0.3
"""Two pictures a third of a second apart that are less alike may be of two scenes. See `_alike`."""
_USUAL_TIMES: Final = 1.3
"""Multiple of the usual difference beyond noise, waves and steady motion."""
_EXPOSURE: Final = 16.0
"""Levels. By so much the whole picture may become brighter or darker from one step to the next."""
_NEWEST: Final = 4
"""So many differences tell what is usual: of a source that repeats pictures some are none."""
_LONGEST_NS: Final = SECOND_NS
"""After this time a moving camera may show other ground."""


class SceneChange:
    """Takes one picture after the other, in order. No clock of its own.

    ``least_difference`` is in levels, mean over the thumbnail: the default is the rounding of 8 bits in a picture
    without noise, and some more.
    """

    def __init__(self, *, least_difference: float = 0.15) -> None:
        self._least_difference = least_difference
        self._before: tuple[int, _Thumbnail] | None = None
        self._usual: deque[float] = deque(maxlen=_NEWEST)
        """Differences of two pictures lately, levels."""

    def take(self, image: Image, *, capture_ns: int) -> bool:
        """Whether this picture, BGR or gray, has nothing to do with the one just before."""
        small = _thumbnail(image)
        before, self._before = self._before, (capture_ns, small)
        if before is None or capture_ns - before[0] > _LONGEST_NS:
            return False
        brighter = float(small.mean() - before[1].mean())
        here, there = small - small.mean(), before[1] - before[1].mean()
        difference = float(np.abs(here - there).mean()) + max(0.0, abs(brighter) - _EXPOSURE)
        usual = max(self._usual, default=None)
        self._usual.append(difference)
        if usual is None:
            return False
        new = difference > max(self._least_difference, _USUAL_TIMES * usual)
        return new and _alike(here, there) < _LEAST_ALIKE


def _alike(here: _Thumbnail, there: _Thumbnail) -> float:
    # Correlation, less where one has far more contrast than the other: Lin's concordance, without means.
    energy = float(here @ here + there @ there)
    return 2 * float(here @ there) / energy if energy else 1.0


def _thumbnail(image: Image) -> _Thumbnail:
    # Fractions of a level: rounded means of thousands of pixels would be a flat scene's only contrast.
    halfway = cv2.resize(image, _HALFWAY_PX, interpolation=cv2.INTER_AREA).astype(np.float32)
    return np.asarray(cv2.resize(halfway, _THUMBNAIL_PX, interpolation=cv2.INTER_AREA), np.float32).ravel()
