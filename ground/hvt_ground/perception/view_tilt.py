"""Whether the camera looks aslant, told by the vehicles themselves.

Seen from straight above they have one size wherever they are; seen aslant those higher up in the picture are farther
away, and smaller. The median slope over pairs (Theil 1950, Sen 1968) of the logarithm of their size over the height
in the picture is -.13 to .53 in eight views from above, .83 to 5.5 in twelve aslant (docs/embedded-models.md). What
kind of vehicle one is, no network here tells well aslant.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from hvt_common.values import Boxes

_ASLANT_FROM, _STEEP_BELOW = 0.75, 0.65
_MOST_BOXES, _LEAST_BOXES = 150, 12
_APART = 0.1
"""Of the height of the picture: nearer ones differ by their kinds. So far apart must their quartiles lie."""


class ViewTilt:
    """Of one video; for one thread."""

    def __init__(self) -> None:
        self._seen: npt.NDArray[np.float64] = np.empty((0, 2))
        """(N, 2) height in the picture, 0 to 1, and logarithm of the size, oldest first."""
        self.aslant = False
        """False also while too few vehicles were seen to tell."""

    def take(self, boxes_xyxy_px: Boxes, *, height_px: int) -> None:
        """Take the vehicles that were detected in the next picture."""
        boxes = boxes_xyxy_px.astype(np.float64)
        sides = np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0)
        new = np.column_stack(((boxes[:, 1] + boxes[:, 3]) / 2 / height_px, np.log(sides.prod(axis=1)) / 2))
        self._seen = np.concatenate((self._seen, new))[-_MOST_BOXES:]
        if len(self._seen) < _LEAST_BOXES:
            return
        low, high = np.percentile(self._seen[:, 0], (25, 75))
        if high - low <= _APART:
            return
        one, other = np.triu_indices(len(self._seen), 1)
        apart, larger = (self._seen[one] - self._seen[other]).T
        far = np.abs(apart) > _APART
        slope = float(np.median(larger[far] / apart[far]))
        self.aslant = slope >= (_STEEP_BELOW if self.aslant else _ASLANT_FROM)
