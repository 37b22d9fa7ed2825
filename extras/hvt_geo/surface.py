"""The surface that rays meet: flat ground, or another one such as `terrain`."""

from __future__ import annotations

import math
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from hvt_common.values import Pose

Points = npt.NDArray[np.float64]
"""(N, 2): pixels, or metres north and east."""
Rays = npt.NDArray[np.float64]
"""(N, 3): north, east, down; of any length."""

LEAST_DEPRESSION_DEG: Final = 1.0
"""A ray nearer to the horizon meets nothing."""


class Surface(Protocol):
    """The ground."""

    def usable(self, pose: Pose) -> bool:
        """Whether the pose says how high above this surface the camera is."""
        ...

    def meet(self, pose: Pose, rays: Rays) -> Points:
        """Points where rays meet it, metres north and east of the camera, (N, 2); NaN where they do not."""
        ...

    def below_m(self, pose: Pose, metres: Points) -> npt.NDArray[np.float64]:
        """The ground's depth below the camera, (N,), so many metres north and east of it; NaN where not known."""
        ...


class FlatGround:
    """A plane ``height_m`` below the camera."""

    def usable(self, pose: Pose) -> bool:
        """Whether the height is known."""
        return pose.height_m is not None and pose.height_m > 0

    def meet(self, pose: Pose, rays: Rays) -> Points:
        """See `Surface.meet`."""
        assert pose.height_m is not None, "else it is not usable"
        falls = rays[:, 2] > np.linalg.norm(rays, axis=1) * math.sin(math.radians(LEAST_DEPRESSION_DEG))
        with np.errstate(divide="ignore", invalid="ignore"):
            metres = rays[:, :2] * (pose.height_m / rays[:, 2:])
        return np.where(falls[:, None], metres, np.nan)

    def below_m(self, pose: Pose, metres: Points) -> npt.NDArray[np.float64]:
        """See `Surface.below_m`."""
        assert pose.height_m is not None, "else it is not usable"
        return np.full(len(metres), pose.height_m)


FLAT_GROUND: Final = FlatGround()
