"""Poses from a file beside a clip: a table with names in its first line, DJI's subtitles, or a GPS track.

A file's time 0 is the clip's first frame: a table says ``time_s``, subtitles have their own times, and of UTC times
the first one counts as 0.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree as ET

from hvt_common.errors import UserError
from hvt_common.units import SECOND_NS
from hvt_common.values import Orientation, Pose
from hvt_edge.pose.angles import compass_deg
from hvt_edge.pose.table import PoseTable

__all__ = ["COLUMNS", "read_poses"]

COLUMNS = (
    *("time_s", "utc", "latitude_deg", "longitude_deg", "height_m", "altitude_m"),
    *("camera_yaw_deg", "camera_pitch_deg", "camera_roll_deg", "yaw_deg", "pitch_deg", "roll_deg"),
    *("hfov_deg", "position_error_m", "height_error_m", "angle_error_deg"),
)
"""Of a table. One of the first two, latitude and longitude are needed; `Pose` and `Orientation` say what each means:
``camera_…`` is where the optical axis points, the plain angles are the platform's."""
_MOST_BYTES = 64_000_000
_FULL_FRAME_MM = 36.0
"""Width of the picture that 35 mm equivalent focal lengths are said for."""
_BOUNDS: Mapping[str, tuple[float, float]] = {
    "latitude_deg": (-90, 90),
    "longitude_deg": (-180, 180),
    "height_m": (-1000, 100_000),
    "altitude_m": (-1000, 100_000),
    "hfov_deg": (0.1, 179.9),
    "position_error_m": (0.001, 100_000),
    "height_error_m": (0.001, 100_000),
    "angle_error_deg": (0.001, 180),
    "camera_pitch_deg": (-90, 90),
    "pitch_deg": (-90, 90),
}
_FAR = 1e6
_OVERSHOT_DEG = 92.0
"""So far a gimbal's pitch goes in DJI's subtitles where it means straight down or up."""
_Values = Mapping[str, float]
_TIMES = re.compile(r"(?<!\d)(\d{1,4}):(\d\d):(\d\d)[,.](\d{1,3})\s*-->")
_NAMED = re.compile(r"\b([A-Za-z_]{1,32})\s{0,4}:\s*([+-]?\d+(?:\.\d+)?)")
_OLD_GPS = re.compile(r"GPS\s*\(\s*([+-]?[\d.]+)\s*,\s*([+-]?[\d.]+)\s*,")
"""GPS(longitude, latitude, satellites) of the first models."""
_DJI = {
    "latitude": "latitude_deg",
    "longitude": "longitude_deg",
    "longtitude": "longitude_deg",
    "rel_alt": "height_m",
    "barometer": "height_m",
    "abs_alt": "altitude_m",
    "gb_yaw": "camera_yaw_deg",
    "gb_pitch": "camera_pitch_deg",
    "gb_roll": "camera_roll_deg",
    "focal_len": "focal_mm",
}
"""Names in DJI's subtitles; ``longtitude`` is how some models spell it."""


def read_poses(path: Path, *, hfov_deg: float | None) -> PoseTable:
    """Read a file of poses; ``hfov_deg`` is for where it does not say the field of view.

    Raises `UserError` for a file that cannot be read, is none of the three kinds or has an impossible number.
    """
    readers: Mapping[str, Callable[[str, Path], Iterable[_Values]]] = {
        ".csv": _table_rows,
        ".srt": _subtitle_rows,
        ".gpx": _track_rows,
    }
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise UserError(f"pose file {path} is none of .csv, .srt (DJI) or .gpx")
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise UserError(f"pose file {path} is larger than {_MOST_BYTES // 10**6} MB")
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise UserError(f"pose file {path} cannot be read: {error.strerror}") from None
    try:
        poses = [_pose(row, path, number) for number, row in enumerate(reader(text, path), 1)]
    except csv.Error as error:
        raise UserError(
            f"pose file {path} is no table: {error}; accepted are lines of values between commas"
        ) from None
    if not poses:
        raise UserError(f"pose file {path} has no row with a time, a latitude and a longitude")
    poses = [one if one.hfov_deg is not None else replace(one, hfov_deg=hfov_deg) for one in poses]
    if any(first.capture_ns >= second.capture_ns for first, second in pairwise(poses)):
        raise UserError(f"pose file {path} has times that do not rise")
    return PoseTable(poses)


def _pose(row: _Values, path: Path, number: int) -> Pose:
    for name, value in row.items():
        low, high = _BOUNDS.get(name, (-_FAR, _FAR))
        if not low <= value <= high:
            raise UserError(
                f"pose file {path}, row {number}: {name} is {value:g}, accepted is {low:g} to {high:g}"
            )
    given = {
        name: value for name, value in row.items() if not name.endswith(("yaw_deg", "pitch_deg", "roll_deg"))
    }
    return Pose(
        capture_ns=round(given.pop("time_s") * SECOND_NS),
        camera=_orientation(row, "camera_"),
        platform=_orientation(row, ""),
        **given,
    )


def _orientation(row: _Values, prefix: str) -> Orientation | None:
    """None where it is not known which way it points, or how far down; a roll that nobody says is none."""
    yaw, pitch = row.get(f"{prefix}yaw_deg"), row.get(f"{prefix}pitch_deg")
    if yaw is None or pitch is None:
        return None
    return Orientation(compass_deg(yaw), pitch, row.get(f"{prefix}roll_deg", 0.0))


def _table_rows(text: str, path: Path) -> Iterable[_Values]:
    lines = csv.DictReader(text.splitlines())
    names = [(name or "").strip() for name in lines.fieldnames or ()]
    lines.fieldnames = names
    unknown = [name for name in names if name not in COLUMNS]
    if unknown:
        raise UserError(f"pose file {path} has the column {unknown[0]!r}; known are {', '.join(COLUMNS)}")
    missing = [name for name in ("latitude_deg", "longitude_deg") if name not in names]
    missing += [] if {"time_s", "utc"} & set(names) else ["time_s"]
    if missing:
        raise UserError(f"pose file {path} lacks the column {missing[0]}")
    begin_s: float | None = None
    for number, line in enumerate(lines, 1):
        where = f"pose file {path}, row {number}"
        said = {
            name: value.strip() for name, value in line.items() if name in names and (value or "").strip()
        }
        utc = said.pop("utc", None)
        row = {name: _number(value, f"{where}: {name}") for name, value in said.items()}
        if utc is not None and "time_s" not in row:
            at_s = _utc_s(utc, where)
            begin_s = at_s if begin_s is None else begin_s
            row["time_s"] = at_s - begin_s
        if {"time_s", "latitude_deg", "longitude_deg"} <= row.keys():
            yield row


def _subtitle_rows(text: str, path: Path) -> Iterable[_Values]:
    for block in re.split(r"\r?\n\s*\r?\n", text):
        time = _TIMES.search(block)
        if time is None:
            continue
        hours, minutes, seconds, rest = time.groups()
        row = {"time_s": 3600 * int(hours) + 60 * int(minutes) + int(seconds) + int(rest) / 10 ** len(rest)}
        old = _OLD_GPS.search(block)
        if old is not None:
            row |= {
                "longitude_deg": _number(old[1], f"pose file {path}: GPS"),
                "latitude_deg": _number(old[2], f"pose file {path}: GPS"),
            }
        for name, value in _NAMED.findall(block[time.end() :]):
            if name.lower() in _DJI:
                row[_DJI[name.lower()]] = float(value)
        focal_mm = row.pop("focal_mm", 0.0)
        if focal_mm >= 1:
            focal_mm = focal_mm / 10 if focal_mm > 200 else focal_mm  # some models write tenths: 240 is 24 mm
            row["hfov_deg"] = math.degrees(2 * math.atan(_FULL_FRAME_MM / 2 / focal_mm))
        pitch = row.get("camera_pitch_deg", 0.0)
        if 90 < abs(pitch) <= _OVERSHOT_DEG:
            row["camera_pitch_deg"] = math.copysign(90.0, pitch)
        place = row.get("latitude_deg"), row.get("longitude_deg")
        if None not in place and any(place):  # both are 0 before there is a fix
            yield row


def _track_rows(text: str, path: Path) -> Iterable[_Values]:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise UserError(f"pose file {path} declares a document type, which no GPS track has")
    try:
        root = ET.fromstring(text)  # noqa: S314 - the user's own file, and it declares nothing
    except ET.ParseError as error:
        raise UserError(f"pose file {path} is no GPX: {error}") from None
    begin_s: float | None = None
    for number, point in enumerate(root.findall(".//{*}trkpt"), 1):
        where = f"pose file {path}, point {number}"
        time = point.findtext("{*}time")
        if time is None:
            continue
        at_s = _utc_s(time, where)
        begin_s = at_s if begin_s is None else begin_s
        row = {
            "time_s": at_s - begin_s,
            "latitude_deg": _number(point.get("lat", ""), f"{where}: lat"),
            "longitude_deg": _number(point.get("lon", ""), f"{where}: lon"),
        }
        elevation = point.findtext("{*}ele")
        if elevation is not None:
            row["altitude_m"] = _number(elevation, f"{where}: ele")
        yield row


def _number(text: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UserError(f"{where} is {text!r:.40}, not a number")
    return value


def _utc_s(text: str, where: str) -> float:
    try:
        time = datetime.fromisoformat(text.strip())
    except ValueError:
        raise UserError(
            f"{where}: the time {text!r:.40} is not ISO 8601, such as 2026-11-23T10:00:00Z"
        ) from None
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
