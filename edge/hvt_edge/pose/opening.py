"""One function opens every kind of pose source."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from hvt_common.errors import UserError, absent, needs_extra
from hvt_edge.pose.contract import PoseSource
from hvt_edge.pose.files import read_poses
from hvt_edge.pose.fixed import FixedPose

__all__ = ["PoseSource", "open_pose"]

_FILES = (".csv", ".srt", ".gpx", ".vtt")


def open_pose(spec: str, *, hfov_deg: float | None, clock: Callable[[], int]) -> PoseSource:
    """Open what ``--pose`` names; ``hfov_deg`` is for where it says no field of view.

    Raises `UserError` for what cannot be read, opened or understood.
    """
    kind, _, rest = spec.partition(":")
    if kind == "fixed":
        return FixedPose(rest, hfov_deg=hfov_deg)
    if kind == "mavlink":
        with needs_extra("'hvt[mavlink]'"):
            from hvt_edge.pose.mavlink import MavlinkPose  # noqa: PLC0415 - who has no autopilot needs no MAVLink
        return MavlinkPose(rest, hfov_deg=hfov_deg, clock=clock)
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
