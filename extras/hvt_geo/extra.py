"""The settings of geolocation, and how the ground comes to place tracks."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from hvt_common.config import PATH, Group
from hvt_common.errors import needs_extra
from hvt_ground.config import GroundConfig
from hvt_ground.extras import Extra

if TYPE_CHECKING:  # ``--help`` is to load no numpy
    from hvt_ground.poses import Locator


@dataclass(frozen=True)
class GeoOptions(GroundConfig):
    """The settings of ``hvt-ground`` for it."""

    terrain: Path | None = Group("geolocation", rare=True).option(
        PATH, None, "place tracks on this elevation model, a GeoTIFF, in place of flat ground (docs/pose.md)"
    )


class GeoExtra(Extra[GeoOptions]):
    """Tracks stand on flat ground, or on ``--terrain``."""

    options = GeoOptions

    def reads(self, config: GeoOptions) -> Iterable[Path]:
        return [config.terrain] if config.terrain is not None else []

    def locators(self, terrain: Path | None) -> Callable[[str], Locator]:
        """One a flight.

        The file is looked at once, here: `UserError` where it is no elevation model. One that goes later ends no
        flight.
        """
        from hvt_geo.camera import SurfaceLocator  # noqa: PLC0415 - as above

        if terrain is None:
            return lambda _flight: SurfaceLocator()
        with needs_extra("'hvt[terrain]'"):
            from hvt_geo.elevation import ElevationModel, Terrain  # noqa: PLC0415 - who has none needs no GDAL
        model = ElevationModel(terrain)
        return lambda flight: SurfaceLocator(Terrain(model, flight))
