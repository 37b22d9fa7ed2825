"""Ground that is not flat, from an elevation model: a GeoTIFF of metres above mean sea level."""

from __future__ import annotations

import math
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import rasterio
import rasterio.errors
from rasterio.vrt import WarpedVRT
from rasterio.windows import from_bounds

from hvt_common.errors import UserError
from hvt_common.geodesy import metres_per_degree, moved
from hvt_common.values import Pose
from hvt_ground.geolocation.surface import LEAST_DEPRESSION_DEG, Points, Rays

__all__ = ["Terrain"]

_REACH_M: Final = 10_000.0
"""As far as a ray is followed."""
_TILE_M: Final = 15_000.0
"""Half the side of what is in memory at a time."""
_MOST_SIDE: Final = 3000
"""Cells on a side of it: a finer model is read more coarsely."""
_STEPS: Final = 160
_FIRST_M: Final = 1.0


@contextmanager
def _without_warnings() -> Iterator[None]:
    """What is wrong with a file is said in a sentence."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@dataclass(frozen=True, slots=True)
class _Tile:
    """What is in memory: (H, W) float32 metres, NaN where the model has none, row 0 in the north."""

    metres: npt.NDArray[np.float32]
    north_deg: float
    west_deg: float
    south_deg: float
    east_deg: float

    def at(self, latitude_deg: Points, longitude_deg: Points) -> npt.NDArray[np.float64]:
        """Elevation between the cells' centres; NaN outside. Arrays of any one shape."""
        high, wide = self.metres.shape
        x = (longitude_deg - self.west_deg) / (self.east_deg - self.west_deg) * wide - 0.5
        y = (self.north_deg - latitude_deg) / (self.north_deg - self.south_deg) * high - 0.5
        inside = (x >= -0.5) & (x <= wide - 0.5) & (y >= -0.5) & (y <= high - 0.5)
        left = np.clip(np.floor(x), 0, max(0, wide - 2)).astype(np.int64)
        top = np.clip(np.floor(y), 0, max(0, high - 2)).astype(np.int64)
        right, low = np.minimum(left + 1, wide - 1), np.minimum(top + 1, high - 1)
        across, down = np.clip(x - left, 0, 1), np.clip(y - top, 0, 1)
        upper = self.metres[top, left] * (1 - across) + self.metres[top, right] * across
        lower = self.metres[low, left] * (1 - across) + self.metres[low, right] * across
        return np.where(inside, upper * (1 - down) + lower * down, np.nan)


class Terrain:
    """An elevation model. Thread-safe. Raises `UserError` where the file is none that can be used.

    The camera's height above the sea is ``altitude_m``; of a pose that says only a height above the ground, that is
    taken to be above the ground below the first pose.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._tile: _Tile | None = None
        self._middle = (math.inf, math.inf)
        self._base_m: float | None = None
        """Elevation below the first pose that said only a height."""
        try:
            with _without_warnings(), rasterio.open(path) as file:
                if file.crs is None:
                    raise UserError(
                        f"--terrain {path} does not say where it lies: give a GeoTIFF with coordinates"
                    )
        except rasterio.errors.RasterioError as error:
            raise UserError(f"--terrain {path} is no elevation model that can be read: {error}") from None

    def usable(self, pose: Pose) -> bool:
        """Whether altitude or height is known, and the model has the ground below."""
        return self._altitude_m(pose) is not None

    def meet(self, pose: Pose, rays: Rays) -> Points:
        """As `Surface.meet`: the first point of each ray that is not above the ground, within 10 km."""
        altitude_m, tile = self._altitude_m(pose), self._tile_around(pose)
        assert altitude_m is not None, "else it is not usable"
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
        """As `Surface.below_m`."""
        altitude_m, tile = self._altitude_m(pose), self._tile_around(pose)
        assert altitude_m is not None, "else it is not usable"
        north_m, east_m = metres_per_degree(pose.latitude_deg)
        return altitude_m - tile.at(
            pose.latitude_deg + metres[:, 0] / north_m,
            pose.longitude_deg + metres[:, 1] / max(east_m, 1e-6),
        )

    def _altitude_m(self, pose: Pose) -> float | None:
        below_m = float(
            self._tile_around(pose).at(np.array([pose.latitude_deg]), np.array([pose.longitude_deg]))[0]
        )
        if pose.altitude_m is not None:
            return pose.altitude_m if math.isnan(below_m) or pose.altitude_m > below_m else None
        if pose.height_m is None:
            return None
        with self._lock:
            if self._base_m is None and not math.isnan(below_m):
                self._base_m = below_m
            return None if self._base_m is None else self._base_m + pose.height_m

    def _tile_around(self, pose: Pose) -> _Tile:
        with self._lock:
            north_m, east_m = metres_per_degree(pose.latitude_deg)
            off_m = math.hypot(
                (pose.latitude_deg - self._middle[0]) * north_m,
                (pose.longitude_deg - self._middle[1]) * east_m,
            )
            if self._tile is None or not off_m <= _TILE_M - _REACH_M:
                self._tile = self._read(pose.latitude_deg, pose.longitude_deg)
                self._middle = (pose.latitude_deg, pose.longitude_deg)
            return self._tile

    def _read(self, latitude_deg: float, longitude_deg: float) -> _Tile:
        north, east = moved(latitude_deg, longitude_deg, north_m=_TILE_M, east_m=_TILE_M)
        south, west = moved(latitude_deg, longitude_deg, north_m=-_TILE_M, east_m=-_TILE_M)
        nothing = _Tile(np.full((1, 1), np.nan, np.float32), north, west, south, east)
        try:
            with rasterio.open(self._path) as file, WarpedVRT(file, crs="EPSG:4326") as flat:
                north, south = min(north, flat.bounds.top), max(south, flat.bounds.bottom)
                east, west = min(east, flat.bounds.right), max(west, flat.bounds.left)
                if north <= south or east <= west:
                    return nothing
                window = from_bounds(west, south, east, north, flat.transform)
                shape = tuple(max(1, min(_MOST_SIDE, round(one))) for one in (window.height, window.width))
                metres = flat.read(1, window=window, out_shape=shape, masked=True)
        except (rasterio.errors.RasterioError, ValueError):
            return nothing
        values = np.asarray(metres.astype(np.float32).filled(np.nan), np.float32)
        return _Tile(values, north, west, south, east)
