"""The ground of one flight: places of boxes, and the footprint of a picture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hvt_common.geodesy import moved
from hvt_common.values import Boxes, Pose, View
from hvt_geo.camera import at_a_pole, ground_points, places_of_boxes
from hvt_geo.surface import FLAT_GROUND, Surface
from hvt_ground.events import Places
from hvt_ground.poses import Footprint


@dataclass(frozen=True, slots=True)
class SurfaceLocator:
    """A `Locator` on this surface."""

    surface: Surface = FLAT_GROUND

    def places(self, pose: Pose, boxes_base_px: Boxes, view: View) -> Places | None:
        """See `places_of_boxes`."""
        return places_of_boxes(pose, boxes_base_px, view=view, surface=self.surface)

    def footprint(self, pose: Pose, view: View) -> Footprint | None:
        """See `footprint`."""
        return footprint(pose, view, surface=self.surface)


def footprint(pose: Pose, view: View, *, surface: Surface = FLAT_GROUND) -> Footprint | None:
    """The footprint of a picture; None without height, direction or field of view, or with the centre in the sky."""
    if pose.camera is None or pose.hfov_deg is None or at_a_pole(pose) or not surface.usable(pose):
        return None
    (wide, high), (x, y) = view.base_size, view.offset_px
    base = np.array(((wide / 2, high / 2), (0, 0), (wide, 0), (wide, high), (0, high)), np.float64)
    metres = ground_points(pose, (base - (x, y)) / view.scale, size=view.source_size, surface=surface)
    below_m = float(surface.below_m(pose, metres[:1])[0])
    if not np.isfinite((*metres[0], below_m)).all():
        return None
    centre, *corners = (
        moved(pose.latitude_deg, pose.longitude_deg, north_m=north_m, east_m=east_m)
        for north_m, east_m in metres.tolist()
    )
    first, second, third, fourth = corners
    return Footprint(
        centre=centre,
        below_m=below_m,
        slant_m=math.hypot(*metres[0].tolist(), below_m),
        corners=(first, second, third, fourth) if np.isfinite(metres).all() else None,
    )
