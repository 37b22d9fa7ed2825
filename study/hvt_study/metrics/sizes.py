"""Small, medium and large objects.

The limits are COCO's, 32 and 96 pixels squared (Lin et al. 2014, https://cocodataset.org/#detection-eval), in
*source* pixels and not scaled: they mean the same object for every method, whatever its base size. Pictures of drones
are larger than COCO's, so that "small" is a smaller share of the frame here. The pilot's "small" is another one, a
share of the frame: see `proxy`.
"""

from __future__ import annotations

from typing import Final, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

__all__ = ["LARGEST_PX2", "LIMITS_PX2", "SIZES", "Size", "of_size"]

Size: TypeAlias = Literal["small", "medium", "large"]

SIZES: Final[tuple[Size, ...]] = ("small", "medium", "large")
LIMITS_PX2: Final = (32.0**2, 96.0**2)
LARGEST_PX2: Final = 1e10


def of_size(
    size: Size, areas_px2: npt.NDArray[np.float64], *, limits_px2: tuple[float, float] = LIMITS_PX2
) -> npt.NDArray[np.bool_]:
    """Which of (N,) areas are of this size; a limit belongs to the larger one."""
    return np.asarray(np.digitize(areas_px2, limits_px2) == SIZES.index(size))
