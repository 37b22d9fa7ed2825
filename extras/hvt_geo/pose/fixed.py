"""A camera that stands still: ``fixed:LAT,LON,HEIGHT,AZIMUTH,TILT``."""

from __future__ import annotations

from dataclasses import replace

from hvt_common.errors import UserError
from hvt_common.values import Orientation, Pose
from hvt_geo.pose.angles import compass_deg

_ACCEPTED = (
    "give fixed:LAT,LON,HEIGHT,AZIMUTH,TILT: degrees, metres above the ground, degrees clockwise from north, degrees "
    "up from the horizon (-90 is straight down)"
)
_BOUNDS = (
    ("latitude", -90.0, 90.0),
    ("longitude", -180.0, 180.0),
    ("height", 0.0, 100_000.0),
    ("azimuth", -360.0, 360.0),
    ("tilt", -90.0, 90.0),
)


class FixedPose:
    """The same pose for every frame."""

    trouble = ""
    notes = ()

    def __init__(self, numbers: str, *, hfov_deg: float | None) -> None:
        parts = numbers.split(",")
        try:
            values = [float(one) for one in parts]
        except ValueError:
            values = []
        if len(values) != len(_BOUNDS):
            raise UserError(f"--pose fixed:{numbers:.200} is not five numbers: {_ACCEPTED}")
        for value, (name, low, high) in zip(values, _BOUNDS, strict=True):
            if not low <= value <= high:
                raise UserError(f"--pose fixed:{numbers:.200} has the {name} {value:g}: {_ACCEPTED}")
        latitude, longitude, height, azimuth, tilt = values
        self._pose = Pose(
            0,
            latitude,
            longitude,
            height_m=height,
            camera=Orientation(compass_deg(azimuth), tilt, 0.0),
            hfov_deg=hfov_deg,
        )

    def at(self, media_ns: int, *, capture_ns: int) -> Pose | None:  # noqa: ARG002 - at any time
        """The pose."""
        return replace(self._pose, capture_ns=capture_ns)

    def close(self) -> None:
        """Nothing is open."""
