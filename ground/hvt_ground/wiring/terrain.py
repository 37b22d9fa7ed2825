"""The surface under the tracks of a flight."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from hvt_common.errors import needs_extra
from hvt_ground.geolocation.surface import FLAT_GROUND, Surface


def make_surfaces(terrain: Path | None) -> Callable[[str], Surface]:
    """The surface of one flight, by the edge's name.

    The file is looked at once, here: `UserError` where it is no elevation model. One that goes later ends no flight.
    """
    if terrain is None:
        return lambda _flight: FLAT_GROUND
    with needs_extra("'hvt[terrain]'"):
        from hvt_ground.geolocation.elevation import ElevationModel  # noqa: PLC0415 - who has none needs no GDAL
        from hvt_ground.geolocation.terrain import Terrain  # noqa: PLC0415 - as above
    return partial(Terrain, ElevationModel(terrain))
