"""An elevation model as a file: a GeoTIFF of metres above mean sea level, of which a part is in memory at a time.

`Terrain` is the ground of one flight, which need not be flat.
"""

from __future__ import annotations

import logging
import math
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import rasterio
from rasterio import Affine
from rasterio._err import CPLE_BaseError  # GDAL's exceptions that rasterio does not translate
from rasterio.enums import Resampling
from rasterio.errors import RasterioError
from rasterio.transform import from_bounds
from rasterio.warp import reproject, transform, transform_bounds
from rasterio.windows import Window

from hvt_common.errors import UserError, absent
from hvt_common.geodesy import metres_per_degree, wrap_180
from hvt_common.runtime.failures import RetryPause
from hvt_common.values import Pose
from hvt_geo.camera import LEAST_DEPRESSION_DEG, Points, Rays

TILE_M: Final = 15_000.0
"""Half the side of the part in memory."""
_MOST_SIDE: Final = 3000
"""Cells on a side of it: a finer model is read more coarsely."""
_WGS_84: Final = "EPSG:4326"
_TURNS_DEG: Final = (0, 360, -360)
"""A model may say 190 degrees for -170, and the other way round."""

_ALONG: Final = 11
"""Points on a side by which an area is found in a file."""
_EDGE: Final = 2
"""Cells around it, between which elevation is."""
_LOWEST_M, _HIGHEST_M = -1000.0, 9000.0
"""No ground is beyond: models mark holes with -32768, -9999 and others, and do not always say so."""


class ModelError(Exception):
    """A model that cannot be read; the text says why."""


@dataclass(frozen=True, slots=True)
class _Area:
    # Degrees, WGS 84. East is the larger one: beyond 180 where the area holds the antimeridian.

    west_deg: float
    south_deg: float
    east_deg: float
    north_deg: float

    def turned(self, degrees: float) -> _Area:
        """The same with other numbers for its longitudes."""
        return _Area(self.west_deg + degrees, self.south_deg, self.east_deg + degrees, self.north_deg)

    def common(self, other: _Area) -> _Area | None:
        west, east = max(self.west_deg, other.west_deg), min(self.east_deg, other.east_deg)
        south, north = max(self.south_deg, other.south_deg), min(self.north_deg, other.north_deg)
        return _Area(west, south, east, north) if west < east and south < north else None


@dataclass(frozen=True, slots=True)
class Tile:
    """The part of the model in memory: (H, W) float32 metres, NaN for holes, row 0 in the north."""

    metres: npt.NDArray[np.float32]
    area: _Area

    @classmethod
    def empty(cls) -> Tile:
        return cls(np.full((1, 1), np.nan, np.float32), _Area(-180.0, -90.0, 180.0, 90.0))

    def at(self, latitude_deg: Points, longitude_deg: Points) -> npt.NDArray[np.float64]:
        """Elevation between the cells' centres; NaN outside. Arrays of any one shape, longitudes of any turn."""
        high, wide = self.metres.shape
        area = self.area
        middle_deg = (area.west_deg + area.east_deg) / 2
        east_deg = middle_deg + wrap_180(longitude_deg - middle_deg)
        x = (east_deg - area.west_deg) / (area.east_deg - area.west_deg) * wide - 0.5
        y = (area.north_deg - latitude_deg) / (area.north_deg - area.south_deg) * high - 0.5
        inside = (x >= -0.5) & (x <= wide - 0.5) & (y >= -0.5) & (y <= high - 0.5)
        left = np.clip(np.floor(x), 0, max(0, wide - 2)).astype(np.int64)
        top = np.clip(np.floor(y), 0, max(0, high - 2)).astype(np.int64)
        right, low = np.minimum(left + 1, wide - 1), np.minimum(top + 1, high - 1)
        across, down = np.clip(x - left, 0, 1), np.clip(y - top, 0, 1)
        upper = self.metres[top, left] * (1 - across) + self.metres[top, right] * across
        lower = self.metres[low, left] * (1 - across) + self.metres[low, right] * across
        return np.where(inside, upper * (1 - down) + lower * down, np.nan)

    def beside(self, pose: Pose, metres: Points) -> npt.NDArray[np.float64]:
        """Elevation at ``metres`` north and east of a pose, (…, 2 or 3)."""
        north_m, east_m = metres_per_degree(pose.latitude_deg)
        longitude_deg = pose.longitude_deg + metres[..., 1] / max(east_m, 1e-6)
        return self.at(pose.latitude_deg + metres[..., 0] / north_m, longitude_deg)


class ElevationModel:
    """A file, opened anew for each tile. For any thread.

    Raises `UserError` where it is no model that can be used.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with _errors(), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a fault of a file is said in a sentence
                with rasterio.open(path) as file:
                    placed = file.crs is not None and not file.transform.is_identity
                    if placed:
                        _cell_in_the_middle(file)
        except ModelError as error:
            raise absent(path)(f"--terrain {path} is no elevation model that can be read: {error}") from None
        if not placed:
            raise UserError(f"--terrain {path} does not say where it lies: give a GeoTIFF with coordinates")

    def around(self, latitude_deg: float, longitude_deg: float) -> Tile:
        """The ground within `TILE_M` of a place; raises `ModelError`."""
        north_m, east_m = metres_per_degree(latitude_deg)
        high, wide = TILE_M / north_m, min(180.0, TILE_M / max(east_m, 1e-6))
        wanted = _Area(longitude_deg - wide, latitude_deg - high, longitude_deg + wide, latitude_deg + high)
        with _errors(), rasterio.open(self.path) as file:
            bounds = _bounds(file)
            found = {turn: wanted.common(bounds.turned(turn)) for turn in _TURNS_DEG}
            parts = {turn: part for turn, part in found.items() if part is not None}
            if not parts:
                return Tile.empty()
            area = _Area(
                min(one.west_deg for one in parts.values()),
                min(one.south_deg for one in parts.values()),
                max(one.east_deg for one in parts.values()),
                max(one.north_deg for one in parts.values()),
            )
            shape = _shape(file, area)
            metres = np.full(shape, np.nan, np.float32)
            for turn in parts:
                metres = np.where(np.isnan(metres), _read(file, area.turned(-turn), shape), metres)
        return Tile(metres, area)


@contextmanager
def _errors() -> Iterator[None]:
    try:
        yield
    except (RasterioError, CPLE_BaseError, ValueError) as error:
        raise ModelError(" ".join(str(error).split())[:200]) from None


def _bounds(file: Any) -> _Area:
    # The bounds of the whole file; longitudes in its own form.
    if file.crs.is_geographic:
        return _Area(*file.bounds)
    if not file.crs.is_projected:
        raise ModelError("it has neither degrees nor the coordinates of a map")
    west, south, east, north = transform_bounds(file.crs, _WGS_84, *file.bounds)
    if not all(math.isfinite(one) for one in (west, south, east, north)):
        raise ModelError(f"it lies nowhere on the earth, its coordinates are {tuple(file.bounds)}")
    return _Area(west, south, east + 360 if east < west else east, north)


def _cell_deg(file: Any, latitude_deg: float) -> tuple[float, float]:
    # The sides of a cell, degrees of longitude and latitude.
    across, down = (abs(one) * file.crs.units_factor[1] for one in file.res)
    if file.crs.is_geographic:
        return math.degrees(across), math.degrees(down)
    north_m, east_m = metres_per_degree(latitude_deg)
    return across / max(east_m, 1e-6), down / north_m


def _shape(file: Any, area: _Area) -> tuple[int, int]:
    across, down = _cell_deg(file, (area.south_deg + area.north_deg) / 2)
    cells = ((area.north_deg - area.south_deg) / down, (area.east_deg - area.west_deg) / across)
    rows, columns = (max(1, min(_MOST_SIDE, round(one))) for one in cells)
    return rows, columns


def _cell_in_the_middle(file: Any) -> None:
    # Read one, so that a model that cannot be read is refused before a flight.
    bounds = _bounds(file)
    latitude, longitude = ((bounds.south_deg + bounds.north_deg) / 2, (bounds.west_deg + bounds.east_deg) / 2)
    across, down = _cell_deg(file, latitude)
    cell = _Area(longitude, latitude, longitude + across, latitude + down)
    _read(file, cell, (1, 1))


def _read(file: Any, area: _Area, shape: tuple[int, int]) -> npt.NDArray[np.float32]:
    # NaN where there is none. A fine model is thinned out before it is warped: all of it takes most of a minute.
    found = np.full(shape, np.nan, np.float32)
    window = _window(file, area)
    if window is None:
        return found
    rows, columns = min(_MOST_SIDE, window.height), min(_MOST_SIDE, window.width)
    there = file.read(1, window=window, out_shape=(rows, columns), masked=True)
    metres = there.astype(np.float64).filled(np.nan)
    metres[(metres < _LOWEST_M) | (metres > _HIGHEST_M)] = np.nan
    thinned = Affine.scale(window.width / columns, window.height / rows)
    reproject(
        np.asarray(metres, np.float32),
        found,
        src_crs=file.crs,
        src_transform=file.window_transform(window) * thinned,
        src_nodata=np.nan,
        dst_crs=_WGS_84,
        dst_transform=from_bounds(area.west_deg, area.south_deg, area.east_deg, area.north_deg, *shape[::-1]),
        dst_nodata=np.nan,
        resampling=Resampling.bilinear,
    )
    return found


def _window(file: Any, area: _Area) -> Window | None:
    longitude, latitude = np.meshgrid(
        np.linspace(area.west_deg, area.east_deg, _ALONG), np.linspace(area.south_deg, area.north_deg, _ALONG)
    )
    x, y = (np.array(one) for one in transform(_WGS_84, file.crs, longitude.ravel(), latitude.ravel()))
    known = np.isfinite(x) & np.isfinite(y)
    if not known.any():
        return None
    column, row = ~file.transform * (x[known], y[known])
    left, right = (int(one) for one in np.clip((column.min() - _EDGE, column.max() + _EDGE), 0, file.width))
    top, low = (int(one) for one in np.clip((row.min() - _EDGE, row.max() + _EDGE), 0, file.height))
    return Window(left, top, right - left, low - top) if left < right and top < low else None


_log = logging.getLogger(__name__)

_REACH_M: Final = 10_000.0
"""The length to which a ray is followed."""
_STEPS: Final = 160
_FIRST_M: Final = 1.0


class Terrain:
    """The ground of one flight, with the part of the model that is in memory. Thread-safe.

    The camera's height above the sea is ``altitude_m``; of a pose that says only a height above the ground, that is
    taken to be above the ground below the first pose. Where the model has no ground below the camera the log says so
    once, with ``flight``, its name. Where the model cannot be read, the part in memory counts, and it
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
        places = units[:, None, :] * along[None, :, None]
        above = altitude_m - places[..., 2] - tile.beside(pose, places)
        below = above <= 0
        hit = below.argmax(axis=1)
        rows, last = np.arange(len(rays)), np.maximum(hit - 1, 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            before, after = above[rows, last], above[rows, hit]
            reach = along[last] + before / (before - after) * (along[hit] - along[last])
        # The ground in a hole of the model may hide a place behind it, or not: nobody knows.
        seen = np.where(np.isnan(above), 1, 0).cumsum(axis=1)[rows, hit] == 0
        falls = units[:, 2] > math.sin(math.radians(LEAST_DEPRESSION_DEG))
        known = below.any(axis=1) & (hit > 0) & seen & falls & np.isfinite(reach)
        return np.where(known[:, None], units[:, :2] * reach[:, None], np.nan)

    def below_m(self, pose: Pose, metres: Points) -> npt.NDArray[np.float64]:
        (altitude_m, _), tile = self._levels_m(pose), self._tile_around(pose)
        if altitude_m is None:
            return np.full(len(metres), np.nan)
        return altitude_m - tile.beside(pose, metres)

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
            east_deg = wrap_180(pose.longitude_deg - self._middle[1]) if self._tile else math.inf
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
