"""Ground that is not flat, from an elevation model."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt

from hvt_common.geodesy import metres_per_degree, turned_deg
from hvt_common.runtime.failures import RetryPause
from hvt_common.values import Pose
from hvt_geo.camera import LEAST_DEPRESSION_DEG, Points, Rays
from hvt_geo.elevation import TILE_M, ElevationModel, ModelError, Tile

_log = logging.getLogger(__name__)

_REACH_M: Final = 10_000.0
"""The length to which a ray is followed."""
_STEPS: Final = 160
_FIRST_M: Final = 1.0


class Terrain:
    """The ground of one flight, with the part of the model that is in memory. Thread-safe.

    The camera's height above the sea is ``altitude_m``; of a pose that says only a height above the ground, that is
    taken to be above the ground below the first pose. Where the model has no ground below the camera the log says so
    once, with ``flight``, the name of whose it is. Where the model cannot be read, what is in memory counts, and it
    is read again after a pause. ``clock`` is nanoseconds without steps.
    """

    def __init__(
        self, model: ElevationModel, flight: str, *, clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._model = model
        self._flight = flight
        self._clock = clock
        self._lock = threading.Lock()
        self._retry = RetryPause()
        self._tile: Tile | None = None
        self._middle = (math.inf, math.inf)
        self._base_m: float | None = None
        """Elevation below the first pose that said only a height."""
        self._noted = False

    def usable(self, pose: Pose) -> bool:
        """Whether altitude or height is known, and the camera is above ground that the model has."""
        altitude_m, ground_m = self._levels_m(pose)
        return altitude_m is not None and altitude_m > ground_m

    def meet(self, pose: Pose, rays: Rays) -> Points:
        """As `Surface.meet`: the first point of each ray that is not above the ground, within 10 km.

        A camera below the ground, as one near to it may be by its errors, sees none.
        """
        (altitude_m, _), tile = self._levels_m(pose), self._tile_around(pose)
        if altitude_m is None:
            return np.full((len(rays), 2), np.nan)
        length = np.linalg.norm(rays, axis=1, keepdims=True)
        with np.errstate(invalid="ignore"):
            units = rays / length
        along = np.concatenate(([0.0], np.geomspace(_FIRST_M, _REACH_M, _STEPS)))
        north_m, east_m = metres_per_degree(pose.latitude_deg)
        places = units[:, None, :] * along[None, :, None]
        ground = tile.at(
            pose.latitude_deg + places[..., 0] / north_m,
            pose.longitude_deg + places[..., 1] / max(east_m, 1e-6),
        )
        above = altitude_m - places[..., 2] - ground
        below = above <= 0
        hit = below.argmax(axis=1)
        rows, last = np.arange(len(rays)), np.maximum(hit - 1, 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            before, after = above[rows, last], above[rows, hit]
            reach = along[last] + before / (before - after) * (along[hit] - along[last])
        # What lies in a hole of the model may be hidden by what is there, or not: nobody knows.
        seen = np.where(np.isnan(above), 1, 0).cumsum(axis=1)[rows, hit] == 0
        falls = units[:, 2] > math.sin(math.radians(LEAST_DEPRESSION_DEG))
        known = below.any(axis=1) & (hit > 0) & seen & falls & np.isfinite(reach)
        return np.where(known[:, None], units[:, :2] * reach[:, None], np.nan)

    def below_m(self, pose: Pose, metres: Points) -> npt.NDArray[np.float64]:
        """See `Surface.below_m`."""
        (altitude_m, _), tile = self._levels_m(pose), self._tile_around(pose)
        if altitude_m is None:
            return np.full(len(metres), np.nan)
        north_m, east_m = metres_per_degree(pose.latitude_deg)
        return altitude_m - tile.at(
            pose.latitude_deg + metres[:, 0] / north_m,
            pose.longitude_deg + metres[:, 1] / max(east_m, 1e-6),
        )

    def _levels_m(self, pose: Pose) -> tuple[float | None, float]:
        # Above the sea: the camera, None where nothing tells, and the ground below it, NaN where there is none.
        tile = self._tile_around(pose)
        ground_m = float(tile.at(np.array([pose.latitude_deg]), np.array([pose.longitude_deg]))[0])
        if math.isnan(ground_m):
            self._note(
                f"has no ground below {self._flight} at {pose.latitude_deg:.5f}, {pose.longitude_deg:.5f}: "
                "nothing is placed from there"
            )
        if pose.altitude_m is not None:
            return pose.altitude_m, ground_m
        if pose.height_m is None:
            return None, ground_m
        with self._lock:
            if self._base_m is None and not math.isnan(ground_m):
                self._base_m = ground_m
            return None if self._base_m is None else self._base_m + pose.height_m, ground_m

    def _tile_around(self, pose: Pose) -> Tile:
        failure = None
        with self._lock:
            north_m, east_m = metres_per_degree(pose.latitude_deg)
            east_deg = turned_deg(pose.longitude_deg - self._middle[1]) if self._tile else math.inf
            off_m = math.hypot((pose.latitude_deg - self._middle[0]) * north_m, east_deg * east_m)
            outside = self._tile is None or not off_m <= TILE_M - _REACH_M
            if outside and self._retry.due(self._clock()):
                middle = (pose.latitude_deg, pose.longitude_deg)
                try:
                    self._tile, self._middle = self._model.around(*middle), middle
                except ModelError as error:
                    failure = error
                    self._retry.failed(self._clock())
            tile = self._tile
        if failure is not None:
            nothing = "nothing" if tile is None else "nothing far from where it was"
            self._note(f"cannot be read, and {nothing} of {self._flight} is placed: {failure}")
        return tile or Tile.empty()

    def _note(self, what: str) -> None:
        # Say once why nothing is placed: who watches the map waits for it.
        with self._lock:
            if self._noted:
                return
            self._noted = True
        _log.warning("--terrain %s %s", self._model.path, what)
