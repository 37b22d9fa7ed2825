"""DJI's subtitles. Models differ in their layout, which words, ranges and units tell apart. Pure."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence

_FULL_FRAME_MM = 36.0
"""Width of the picture that 35 mm equivalent focal lengths are said for."""
_NUMBER = r"[+-]?\d++(?:[.,]\d++)?+(?:[eE][+-]?\d++)?+(?!\s?[°º]\s?\d)"
"""With a point, or with the comma that half of Europe writes; not the degrees alone of 47°06'01"."""
_TIMES = re.compile(r"(?<![\d:])(?:(\d{1,4}):)?(\d\d):(\d\d)[,.](\d{1,3})\s*-->")
_FEET, _METRES = r"(?:\s?(ft|feet)\b)?", 0.3048
_SIDE = r"(?i:([EWNS]|east|west|north|south))"
_DEG = r"deg(?:rees?+)?+"
_WORD = r"[^\W\d_]++(?!\w|[ \t]{0,4}(?:[:(=/]|[+-]?\d))"
"""But for the name of the next value, with a sign between or none."""
_BEHIND = rf"\s?(?:°|{_DEG})?\s?{_SIDE}\b(?!\s*:)"
_MORE = rf"[ \t°º]{{0,3}}+(?:{_DEG}\b[ \t]?)?+({_WORD})"
"""A word that may be a side in another language."""
_LATLON = r"(?i:l(?:at|ongt?)itude)\s{0,4}[:(]"
_NAMED = re.compile(
    rf"\b(?!{_LATLON}\s*[+-]?\d++(?:[ :]\d|[.,]\d++\.\d))"
    rf"([A-Za-z_]{{1,32}})\s{{0,4}}[:(]\s*({_NUMBER}){_FEET}"
    rf"(?:{_BEHIND}(?!(?<=[A-Za-z]{{2}})[ \t]+{_WORD})|{_MORE})?"
)
"""But for latitudes and longitudes of 47 06.1, 47:06:01 or 47.06.01, whose degrees alone are another place."""
_DEGREES = re.compile(rf"\b{_SIDE}\s*:?\s*({_NUMBER})|({_NUMBER})(?:{_BEHIND}|(?:\s?{_DEG}\b)?(?!\s+[\d+-]))")
"""Autel's GPS(E: 8.5, N: 47.1, 30.5m), or a letter or word behind the number, of one of both at least; or none."""
_SAYS_PLACE = re.compile(rf"\b(?:GPS\s*\(|{_LATLON})[^\],;)\n]{{0,40}}?\d")
"""A number where the first of a place stands, whether it is read or not."""
_GPS, _RTK = (re.compile(rf"\b{word}\s*\(([^()\n]{{1,80}})\)") for word in ("GPS", "RTK"))
_HEIGHT = re.compile(rf"(?<![\w.])H\s+({_NUMBER})(?:\s*m\b|{_FEET[3:-2]})")
_ANGLES = re.compile(r"\b([FG])\.PRY\s*\(([^()\n]{1,80})\)")
"""Pitch, roll and yaw of the aircraft (F) and of the gimbal (G): Phantom 4 and Mavic Mini, all in one line."""
_DJI = {
    "latitude": "latitude_deg",
    "longitude": "longitude_deg",
    "longtitude": "longitude_deg",
    "rel_alt": "height_m",
    "barometer": "height_m",
    "hb": "barometer_m",
    "abs_alt": "altitude_m",
    "gb_yaw": "camera_yaw_deg",
    "gb_pitch": "camera_pitch_deg",
    "gb_roll": "camera_roll_deg",
    "focal_len": "focal_mm",
    "altitude": "unclear_m",
    "dzoom_ratio": "zoom",
}
"""Names in the subtitles; ``longtitude`` is how some models spell it."""
_IN_PARTS = {"focal_len": (200, 10), "dzoom_ratio": (200, 10_000)}
"""A whole number beyond the first value counts parts, the second many to one: 240 is 24 mm, 480.00 is 480 mm."""
_NEGATIVE = {"latitude_deg": "S", "longitude_deg": "W"}
_MOST_LATITUDE = 90.0
_MOST_SATELLITES = 60


def subtitle_rows(text: str, note: Callable[[str], None]) -> Iterator[Mapping[str, float]]:
    """Rows of values as `hvt_geo.pose.files.COLUMNS` names them; ``note`` gets the guesses and their reasons."""
    times = list(_TIMES.finditer(text))  # whatever lines are empty: tools leave them out, or double them
    ends = (*(time.start() for time in times[1:]), len(text))
    blocks = [(time, text[time.end() : end]) for time, end in zip(times, ends, strict=False)]
    founds = [found[1] for _, body in blocks if (found := _found_place(body)) is not None]
    latitude_first = _latitude_first(founds, note)
    unplaced = unread = 0
    said: set[str] = set()
    for time, body in blocks:
        row = {"time_s": _seconds(time), **_values(body, latitude_first=latitude_first)}
        if row.pop("unclear_m", None) is not None and not {"height_m", "altitude_m"} & row.keys():
            said.add("its 'altitude' is left out: models mean different heights by it")
        if row.pop("zoom", 1.0) > 1:
            said.add("its digital zoom is not read: give a table with hfov_deg")
        place = row.get("latitude_deg"), row.get("longitude_deg")
        if None in place or not any(place):  # both are 0 before there is a fix
            is_said = None in place and _SAYS_PLACE.search(body) is not None
            unread += is_said
            unplaced += not is_said
            continue
        yield row
    for sentence in sorted(said):
        note(sentence)
    if unread:
        note(
            f"{unread} of its {len(blocks)} blocks have a place that is not understood: accepted are decimal "
            "degrees, N, S, E or W behind them"
        )
    if unplaced:
        note(f"{unplaced} of its {len(blocks)} blocks have no place, as before there is a fix")


def _values(body: str, *, latitude_first: bool) -> dict[str, float]:
    row = _place(body, latitude_first=latitude_first)
    if (height := _HEIGHT.search(body)) is not None:
        row["height_m"] = _value(height[1], feet=height[2])
    for whose, angles in _ANGLES.findall(body):
        values = [_value(one[0]) for part in _parts(angles) if (one := re.match(_NUMBER, part)) is not None]
        prefix = "camera_" if whose == "G" else ""
        if len(values) == 3:
            angle_names = (f"{prefix}pitch_deg", f"{prefix}roll_deg", f"{prefix}yaw_deg")
            row |= dict(zip(angle_names, values, strict=True))
    for name, said, feet, letter, more in _NAMED.findall(body):
        column = _DJI.get(name.lower(), "")
        if column and not (more and column in _NEGATIVE):  # of 33.25 Süd, and of 8.5 West wind
            least, parts = _IN_PARTS.get(name.lower(), (0, 1))
            value = _value(said, feet=feet)
            value = value / parts if said.isdecimal() and value > least else value
            row[column] = -abs(value) if letter[:1].upper() == _NEGATIVE.get(column) else value
    if (barometer_m := row.pop("barometer_m", None)) is not None:
        row.setdefault("height_m", barometer_m)
    focal_mm = row.pop("focal_mm", 0.0)
    if focal_mm >= 1:
        row["hfov_deg"] = math.degrees(2 * math.atan(_FULL_FRAME_MM / 2 / focal_mm))
    return row


def _place(body: str, *, latitude_first: bool) -> dict[str, float]:
    found = _found_place(body)
    if found is None or (degrees := _degrees(found[1])) is None:
        return {}
    said, first, second = degrees
    names = ("latitude_deg", "longitude_deg")
    names = names if (latitude_first if said is None else said) else names[::-1]
    return dict(zip(names, (first, second), strict=True))


def _found_place(body: str) -> re.Match[str] | None:
    return _GPS.search(body) or _RTK.search(body)  # beside GPS(…), RTK(…) may be its state


def _degrees(text: str) -> tuple[bool | None, float, float] | None:
    # (whether the letters say that the latitude is first, both numbers); None where more, or less, is in their place.
    place = "; ".join(_parts(text)[:2])
    found = _DEGREES.findall(place)
    sides = [(before or behind)[:1].upper() for before, _, _, behind in found]
    kinds = {(side in "NS") == (index == 0) for index, side in enumerate(sides) if side}
    if len(found) != 2 or len(kinds) > 1 or re.search(r"\w", _DEGREES.sub("", place)):
        return None
    first, second = (
        -abs(value) if side in ("W", "S") else value  # some write the sign as well
        for side, value in zip(sides, (_value(one or two) for _, one, two, _ in found), strict=True)
    )
    return next(iter(kinds), None), first, second


def _latitude_first(founds: Sequence[str], note: Callable[[str], None]) -> bool:
    """Which of the first two numbers of GPS(…) is the latitude; the third is its height, or a count of satellites.

    | numbers | first is |
    |---|---|
    | a first number beyond 90 | the longitude |
    | a second number beyond 90 | the latitude |
    | a third with a unit, a fraction, or beyond 60: a height | the latitude (enterprise models, goggles) |
    | else | the longitude (Phantom, Mavic); it is said that this is a guess |
    """
    places = [
        (*degrees[1:], (*_parts(one), "", "")[2])
        for one in founds
        if (degrees := _degrees(one)) is not None and degrees[0] is None
    ]
    if not places:
        return False
    if any(abs(first) > _MOST_LATITUDE for first, _, _ in places):
        return False
    if any(abs(second) > _MOST_LATITUDE for _, second, _ in places):
        return True
    if any(_is_height(third) for _, _, third in places):
        note("its GPS(…) is taken for latitude, longitude, height, because the third number is a height")
        return True
    note("its GPS(…) is taken for longitude, latitude, satellites, as most models write: look at the map")
    return False


def _is_height(text: str) -> bool:
    count = re.sub(r"(?i)\W*sat[a-z]*\W*", "", text)
    return re.match(_NUMBER, text) is not None and not (count.isdecimal() and int(count) <= _MOST_SATELLITES)


def _parts(text: str) -> list[str]:
    # Between commas, with decimal points or decimal commas.
    parts = re.split(r"\s*(?:,\s+|;)\s*", text.strip())
    if len(parts) < 2 and "." not in text:
        parts = text.strip().split(",")
        if len(parts) >= 4:
            parts = [f"{parts[0]}.{parts[1]}", f"{parts[2]}.{parts[3]}", ".".join(parts[4:])]
    return [one for part in parts for one in (part.split(",") if "." in part else [part])]


def _value(text: str, *, feet: str | None = None) -> float:
    return float(text.replace(",", ".")) * (_METRES if feet else 1.0)


def _seconds(time: re.Match[str]) -> float:
    hours, minutes, seconds, rest = time.groups(default="0")
    return 3600 * int(hours) + 60 * int(minutes) + int(seconds) + float(f"0.{rest}")
