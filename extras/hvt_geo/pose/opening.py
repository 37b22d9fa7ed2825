"""The pose sources of this extra, behind the entry points of ``hvt.poses``, and the camera that stands still."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from hvt_common.errors import UserError, absent, needs_extra
from hvt_common.values import Orientation, Pose
from hvt_edge.loop.pose import PoseSource
from hvt_geo.pose.angles import compass_deg
from hvt_geo.pose.files import read_poses

_FILES = (".csv", ".srt", ".gpx")


def open_fixed(spec: str, *, hfov_deg: float | None, clock: Callable[[], int]) -> PoseSource:  # noqa: ARG001 - for all
    """``fixed:LAT,LON,HEIGHT,AZIMUTH,TILT``."""
    return FixedPose(spec.partition(":")[2], hfov_deg=hfov_deg)


def open_mavlink(spec: str, *, hfov_deg: float | None, clock: Callable[[], int]) -> PoseSource:
    """``mavlink:udpin:HOST:PORT`` and others."""
    with needs_extra("'hvt[mavlink]'"):
        from hvt_geo.pose.mavlink import MavlinkPose  # noqa: PLC0415 - who has no autopilot needs no MAVLink
    return MavlinkPose(spec.partition(":")[2], hfov_deg=hfov_deg, clock=clock)


def open_file(spec: str, *, hfov_deg: float | None, clock: Callable[[], int]) -> PoseSource:  # noqa: ARG001 - for all
    try:
        found, reason = Path(spec).is_file(), ""
    except OSError as error:  # a name that is too long, or a folder that others may not read
        found, reason = False, f" ({error.strerror})"
    if not found:
        is_file = Path(spec).suffix.lower() in _FILES  # else it is a word mistyped
        refusal = absent(Path(spec)) if is_file else UserError
        raise refusal(
            f"--pose {spec:.200} is no file{reason}; accepted is FILE.csv, FILE.srt (DJI), FILE.gpx, "
            "fixed:LAT,LON,HEIGHT,AZIMUTH,TILT, mavlink:udpin:HOST:PORT, or demo with --source demo"
        )
    return read_poses(Path(spec), hfov_deg=hfov_deg)


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
        return replace(self._pose, capture_ns=capture_ns)

    def close(self) -> None:
        """Nothing is open."""
