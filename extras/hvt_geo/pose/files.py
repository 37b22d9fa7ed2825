"""Poses from a file beside a clip: a table with names in its first line, DJI's subtitles, or a GPS track.

A file's time 0 is the clip's first frame: a table says ``time_s``, subtitles have their own times, and of UTC times
the earliest counts as 0. Rows that cannot be read are left out and counted, unless they are half of the file.
"""

from __future__ import annotations

import csv
import logging
import math
import re
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from itertools import dropwhile, pairwise
from pathlib import Path
from statistics import median
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from hvt_common.errors import UserError, telling
from hvt_common.files import decoded, read_bytes
from hvt_common.geodesy import wrap_180
from hvt_common.units import SECOND_NS
from hvt_common.values import Orientation, Pose
from hvt_edge.loop.pose import MOST_GAP_S, PoseTable
from hvt_geo.pose.angles import compass_deg
from hvt_geo.pose.subtitles import subtitle_rows

_log = logging.getLogger(__name__)

COLUMNS = (
    *("time_s", "utc", "latitude_deg", "longitude_deg", "height_m", "altitude_m"),
    *("camera_yaw_deg", "camera_pitch_deg", "camera_roll_deg", "yaw_deg", "pitch_deg", "roll_deg"),
    *("hfov_deg", "position_error_m", "height_error_m", "angle_error_deg"),
)
"""Columns of a table. One of the first two, latitude and longitude are needed; `Pose` and `Orientation` define each:
``camera_…`` is where the optical axis points, the plain angles are the platform's."""
_MOST_BYTES = 64_000_000
_BOUNDS: Mapping[str, tuple[float, float]] = {
    "latitude_deg": (-90, 90),
    "longitude_deg": (-180, 180),
    "height_m": (-1000, 100_000),
    "altitude_m": (-1000, 100_000),
    "hfov_deg": (0.1, 179.9),
    "position_error_m": (0.001, 100_000),
    "height_error_m": (0.001, 100_000),
    "angle_error_deg": (0.001, 180),
    "camera_pitch_deg": (-92, 92),
    "pitch_deg": (-90, 90),
}
"""So far a gimbal's pitch goes where it means straight down or up."""
_FAR = 1e6
_ANY_TIME = (-1e11, 1e11)
_LONGEST_PAUSE_S = 86_400.0
_M_A_DEGREE = 111_320.0
_MOST_SPEED, _MOST_M = 700.0, 1000.0
"""Metres a second, and metres of a receiver's error: a place further away is a fault."""
_POINTS = ("trkpt", "rtept", "wpt")
_BEFORE_HEAD = re.compile(r"\s*(?:#.*|sep=.)?\s*$")
"""Lines before the names: a comment, the word of a spreadsheet, or nothing."""
_NOWHERE = 0.001
"""Degrees around 0, 0: there a receiver without a fix says it is."""
_UNKNOWN_YAW = (655.35, 65535.0)
"""MAVLink senders write these for an unknown yaw, in degrees and in hundredths."""
_UNSAID = frozenset({"", "nan", "na", "n/a", "null", "none", "-", "--"})
"""How programs write that they have no value, in small letters."""
_DECIMAL_COMMA = re.compile(r"\s*[+-]?\d+,\d+\s*", re.ASCII)
_NO_TIME_OF_DAY = re.compile(r"\s*(?:[\d.]+|[\dw-]{7,10})\s*", re.ASCII | re.IGNORECASE)
"""Python takes a day alone (2026-W48-1) for its midnight, and some milliseconds since 1970 for a day of old."""
_Values = Mapping[str, float]


def read_poses(path: Path, *, hfov_deg: float | None) -> PoseTable:
    """Read a file of poses; ``hfov_deg`` is for where it does not say the field of view.

    Raises `UserError` for a file that cannot be read, is none of the three kinds or has an impossible number.
    """
    notes: list[str] = []
    readers: Mapping[str, Callable[[str, Path], Iterable[_Values | UserError]]] = {
        ".csv": _table_rows,
        ".srt": lambda text, _: subtitle_rows(text, notes.append),
        ".gpx": _track_rows,
    }
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise UserError(f"pose file {path} is none of .csv, .srt (DJI) or .gpx")
    with telling(f"pose file {path} cannot be read (", "): give SRT, CSV or GPX"):
        text = _text(read_bytes(path, most=_MOST_BYTES))
    try:
        poses = _good(reader(text, path), path)
    except csv.Error as error:
        raise UserError(
            f"pose file {path} is no table: {error}; accepted are lines of values between commas"
        ) from None
    if not poses:
        lacks = f"pose file {path} has no row with a time, a latitude and a longitude"
        raise UserError("; ".join((lacks, *notes)))
    poses = [one if one.hfov_deg is not None else replace(one, hfov_deg=hfov_deg) for one in poses]
    poses = _together(_in_order(poses, path), path)
    apart_s = (
        median((two.capture_ns - one.capture_ns) / SECOND_NS for one, two in pairwise(poses))
        if poses[1:]
        else 0
    )
    if apart_s > MOST_GAP_S:
        notes.append(
            f"its poses are {apart_s:.4g} s apart, and beyond {MOST_GAP_S:g} s nothing is known between"
        )
    return PoseTable(poses, notes=tuple(notes))


def _text(content: bytes) -> str:
    # In the encoding of its byte order mark, else UTF-8; invalid bytes are replaced, for they are no numbers.
    try:
        text = decoded(content)
    except UnicodeDecodeError:
        text = content.decode("utf-8-sig", errors="replace")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _good(rows: Iterable[_Values | UserError], path: Path) -> list[Pose]:
    # Raises the first `UserError` where as many are wrong as right: it is another file than it seems.
    good: list[tuple[int, _Values]] = []
    wrong: list[UserError] = []
    for number, row in enumerate(rows, 1):
        try:
            if isinstance(row, UserError):
                raise row
            _check(row, path, number)
        except UserError as error:
            wrong.append(error)
        else:
            good.append((number, row))
    if wrong and len(wrong) >= len(good):
        raise wrong[0]
    if wrong:
        _log.warning("%d of %d rows are left out: %s", len(wrong), len(wrong) + len(good), wrong[0])
    # Where some count from the clip's first frame, nobody knows when of it others with UTC alone are.
    timed = [row for _, row in good if "time_s" in row] or [row for _, row in good]
    here = _of_one_time(timed, path)
    begin_s = min((row["utc_s"] for row in here if "utc_s" in row), default=0.0)
    placed = [row for row in here if max(abs(row["latitude_deg"]), abs(row["longitude_deg"])) >= _NOWHERE]
    if len(placed) < len(here):
        _say_left_out(path, here, placed, "rows are at 0, 0, as before there is a fix,")
    return [_pose(row, begin_s) for row in placed]


def _of_one_time(rows: list[_Values], path: Path) -> list[_Values]:
    # Without UTC times that are days from most: of a receiver before its fix, or with another count of weeks.
    times = sorted(row["utc_s"] for row in rows if "utc_s" in row)
    if not times:
        return rows
    runs: list[list[float]] = [[times[0]]]
    for one, two in pairwise(times):
        if two - one > _LONGEST_PAUSE_S:
            runs.append([])
        runs[-1].append(two)
    longest = max(runs, key=len)
    together = [row for row in rows if "utc_s" not in row or longest[0] <= row["utc_s"] <= longest[-1]]
    if len(together) < len(rows):
        begin = datetime.fromtimestamp(longest[0], UTC).isoformat(timespec="seconds")
        why = f"poses are more than a day from the others, which begin at {begin},"
        _say_left_out(path, rows, together, why)
    return together


def _in_order(poses: list[Pose], path: Path) -> list[Pose]:
    # Sort by time; of two of one time keep the first. `UserError` if no time rises.
    ordered = sorted(poses, key=lambda one: one.capture_ns)
    if ordered != poses:
        _log.warning("pose file %s is not in order of time: sorted", path)
    rising = [
        two
        for one, two in pairwise((None, *ordered))
        if two and (one is None or one.capture_ns < two.capture_ns)
    ]
    if len(rising) == 1 < len(poses):
        raise UserError(f"pose file {path} has times that do not rise")
    if len(rising) < len(poses):
        _say_left_out(path, poses, rising, "poses have the time of another,")
    return rising


def _together(poses: list[Pose], path: Path) -> list[Pose]:
    # Without single places that nothing that flies can reach from those around them in its time.
    places = np.array([(one.latitude_deg, one.longitude_deg, one.capture_ns / SECOND_NS) for one in poses])
    good = np.zeros(len(poses), bool)
    for step in (1, 2):  # beside one that is wrong stands a good one
        north, east, passed_s = (places[step:] - places[:-step]).T
        wide = np.cos(np.radians(places[step:, 0]))
        metres = _M_A_DEGREE * np.hypot(north, wrap_180(east) * wide)
        near = metres <= _MOST_M + _MOST_SPEED * passed_s
        good[step:] |= near
        good[:-step] |= near
    near_others = [one for one, is_good in zip(poses, good.tolist(), strict=True) if is_good]
    if not len(poses) / 2 < len(near_others) < len(poses):
        return poses
    _say_left_out(path, poses, near_others, "places are far from those around them,")
    return near_others


def _say_left_out(path: Path, rows: Sequence[object], left: Sequence[object], why: str) -> None:
    left_out, sentence = len(rows) - len(left), "pose file %s: %d of %d %s and are left out"
    _log.warning(sentence, path, left_out, len(rows), why)


def _check(row: _Values, path: Path, number: int) -> None:
    for name, value in row.items():
        low, high = _BOUNDS.get(name, _ANY_TIME if name == "utc_s" else (-_FAR, _FAR))
        if not low <= value <= high:
            swapped = name == "latitude_deg" and abs(row.get("longitude_deg", value)) <= high
            hint = ": are latitude and longitude exchanged?" if swapped and abs(value) <= 180 else ""
            raise UserError(
                f"pose file {path}, row {number}: {name} is {value:g}, accepted is {low:g} to {high:g}{hint}"
            )


def _pose(row: _Values, begin_s: float) -> Pose:
    at_s = row["utc_s"] - begin_s if "utc_s" in row else row["time_s"]
    given = {
        name: value
        for name, value in row.items()
        if name not in ("time_s", "utc_s") and not name.endswith(("yaw_deg", "pitch_deg", "roll_deg"))
    }
    return Pose(
        capture_ns=round(at_s * SECOND_NS),
        camera=_orientation(row, "camera_"),
        platform=_orientation(row, ""),
        **given,
    )


def _orientation(row: _Values, prefix: str) -> Orientation | None:
    # None where it is not known which way it points, or how far down; a roll that nobody says is none.
    yaw, pitch = row.get(f"{prefix}yaw_deg"), row.get(f"{prefix}pitch_deg")
    if yaw is None or pitch is None or yaw in _UNKNOWN_YAW:
        return None
    return Orientation(compass_deg(yaw), max(-90.0, min(90.0, pitch)), row.get(f"{prefix}roll_deg", 0.0))


def _table_rows(text: str, path: Path) -> Iterator[_Values | UserError]:
    written = list(dropwhile(_BEFORE_HEAD.match, text.splitlines()))
    between = max(",;\t|", key=(written or [""])[0].count)
    lines = csv.DictReader(written, delimiter=between, skipinitialspace=between != "\t")
    names = [(name or "").strip().lower() for name in lines.fieldnames or ()]
    lines.fieldnames = names
    last = (names or [""])[-1]
    names = [name for name in names if name]  # row numbers and what follows a last comma have none
    if twice := [name for name in names if names.count(name) > 1]:
        raise UserError(f"pose file {path} has the column {twice[0]!r} twice")
    unknown = [name for name in names if name not in COLUMNS]
    if unknown:
        raise UserError(f"pose file {path} has the column {unknown[0]!r}; known are {', '.join(COLUMNS)}")
    missing = [name for name in ("latitude_deg", "longitude_deg") if name not in names]
    missing += [] if {"time_s", "utc"} & set(names) else ["time_s"]
    if missing:
        raise UserError(f"pose file {path} lacks the column {missing[0]}")
    for number, line in enumerate(lines, 1):
        where = f"pose file {path}, row {number}"
        # csv keeps the rest there: a comma at the end, or a word, moves no value.
        surplus = line.get(None, ())
        if surplus and (len(surplus) > 1 or not line[last].strip() or surplus[0].strip(" +-")[:1].isdigit()):
            yield UserError(
                f"{where} has more values than there are columns: is a decimal comma one of them?"
            )
            continue
        try:
            row = _table_row({name: line.get(name) for name in names}, where)
        except UserError as error:
            yield error
            continue
        if {"latitude_deg", "longitude_deg"} <= row.keys() and {"time_s", "utc_s"} & row.keys():
            yield row


def _table_row(line: Mapping[str, str | None], where: str) -> _Values:
    stripped = {name: (value or "").strip() for name, value in line.items()}
    said = {name: value for name, value in stripped.items() if value.lower() not in _UNSAID}
    utc = said.pop("utc", None)
    row = {name: _number(value, f"{where}: {name}") for name, value in said.items()}
    if utc is not None and "time_s" not in row:
        row["utc_s"] = _utc_s(utc, where)
    return row


def _points(text: str, path: Path) -> tuple[list[ET.Element], list[ET.Element]]:
    # Of a track, else of a route, else waypoints; of a file that breaks off those that are whole. And whole segments.
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise UserError(f"pose file {path} declares a document type, which no GPS track has")
    points: dict[str, list[ET.Element]] = {}
    parser: Any = ET.XMLPullParser()  # the user's own file, and it declares nothing
    broken = ""
    try:
        parser.feed(text)
        parser.close()
    except ET.ParseError as error:
        broken = str(error)
    with suppress(ET.ParseError):
        for _, element in parser.read_events():
            points.setdefault(element.tag.rpartition("}")[2], []).append(element)
    found = next((points[kind] for kind in _POINTS if kind in points), [])
    if broken and not found:
        raise UserError(f"pose file {path} is no GPX: {broken}")
    if broken:
        _log.warning("pose file %s breaks off after %d points: %s", path, len(found), broken)
    return found, points.get("trkseg", [])


def _track_rows(text: str, path: Path) -> Iterator[_Values | UserError]:
    untimed = 0
    points, tracks = _points(text, path)
    number_of = {point: number for number, track in enumerate(tracks) for point in track.iterfind("{*}trkpt")}
    placed: dict[int, set[tuple[float, ...]]] = {}
    rows: list[tuple[int, _Values | UserError]] = []
    for number, point in enumerate(points, 1):
        where = f"pose file {path}, point {number}"
        time = point.findtext("{*}time")
        if time is None:
            untimed += 1
            continue
        segment = number_of.get(point, len(tracks))
        try:
            row = {
                "utc_s": _utc_s(time, where),
                "latitude_deg": _number(point.get("lat", ""), f"{where}: lat"),
                "longitude_deg": _number(point.get("lon", ""), f"{where}: lon"),
            }
            elevation = (point.findtext("{*}ele") or "").strip()
            if elevation.lower() not in _UNSAID:
                row["altitude_m"] = _number(elevation, f"{where}: ele")
        except UserError as error:
            rows.append((segment, error))
            continue
        placed.setdefault(segment, set()).add((row["utc_s"], row["latitude_deg"], row["longitude_deg"]))
        rows.append((segment, row))
    # Not the copy of a part of another, nor a short one; the middle half: before a fix receivers say any time.
    least = max(2, max(map(len, placed.values()), default=0) / 10)
    long = {frozenset(one) for one in placed.values() if len(one) >= least}
    with_point: defaultdict[tuple[float, ...], list[frozenset[tuple[float, ...]]]] = defaultdict(list)
    for one in long:
        for place in one:
            with_point[place].append(one)
    beside = {one: min((with_point[place] for place in one), key=len) for one in long}
    ordered = [sorted(one) for one in long if not any(one < other for other in beside[one])]
    spans = sorted((one[len(one) // 4][0], one[-1 - len(one) // 4][0]) for one in ordered)
    if any(first[1] > second[0] for first, second in pairwise(spans)):
        raise UserError(
            f"pose file {path} has {len(spans)} tracks or segments of the same time: keep the camera's alone"
        )
    strays = {
        number
        for number, one in placed.items()
        if len(one) < least
        and (before := bisect_left(spans, (min(one)[0],)))
        and max(one)[0] < spans[before - 1][1]
    }
    stray = UserError(f"pose file {path} has short segments within the time of longer ones: {len(strays)}")
    for segment, read in rows:
        yield stray if segment in strays else read
    if untimed:
        _log.warning("pose file %s: %d points have no time, and are left out", path, untimed)


def _number(text: str, where: str) -> float:
    try:
        # A comma between two numbers is that of half of Europe: columns are apart already.
        value = float(text.replace(",", ".") if _DECIMAL_COMMA.fullmatch(text) else text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UserError(f"{where} is {text!r:.40}, not a number")
    return value


def _utc_s(text: str, where: str) -> float:
    try:
        time = datetime.fromisoformat(
            ("" if _NO_TIME_OF_DAY.fullmatch(text) else text).strip().upper().replace(" UTC", "Z")
        )
    except ValueError:
        raise UserError(
            f"{where}: the time {text!r:.40} is not ISO 8601, such as 2026-11-23T10:00:00Z"
        ) from None
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
