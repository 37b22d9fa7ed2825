"""The pose sources of this extra, behind the entry points of ``hvt.poses``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from hvt_common.errors import UserError, absent, needs_extra
from hvt_edge.loop.pose import PoseSource
from hvt_geo.pose.files import read_poses
from hvt_geo.pose.fixed import FixedPose

_FILES = (".csv", ".srt", ".gpx", ".vtt")


def open_fixed(spec: str, *, hfov_deg: float | None, clock: Callable[[], int]) -> PoseSource:  # noqa: ARG001 - for all
    """``fixed:LAT,LON,HEIGHT,AZIMUTH,TILT``."""
    return FixedPose(spec.partition(":")[2], hfov_deg=hfov_deg)


def open_mavlink(spec: str, *, hfov_deg: float | None, clock: Callable[[], int]) -> PoseSource:
    """``mavlink:udpin:HOST:PORT`` and others."""
    with needs_extra("'hvt[mavlink]'"):
        from hvt_geo.pose.mavlink import MavlinkPose  # noqa: PLC0415 - who has no autopilot needs no MAVLink
    return MavlinkPose(spec.partition(":")[2], hfov_deg=hfov_deg, clock=clock)


def open_file(spec: str, *, hfov_deg: float | None, clock: Callable[[], int]) -> PoseSource:  # noqa: ARG001 - for all
    """A file beside the clip."""
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
