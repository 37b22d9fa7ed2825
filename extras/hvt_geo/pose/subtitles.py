"""DJI's subtitles. Models differ in their layout, which words, ranges and units tell apart. Pure."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence

_FULL_FRAME_MM = 36.0
"""Width of the picture that 35 mm equivalent focal lengths are said for."""
_NUMBER = r"[+-]?(?:\d++[.,]\d++|\d++(?! \d))(?:[eE][+-]?\d++)?+(?!\s?[°º]\s?\d|\.\d)"
"""With a point, or with the comma that half of Europe writes; not the degrees alone of 47°06, 47 06.1, 47.06.01."""
_TIMES = re.compile(r"(?<![\d:])(?:(\d{1,4}):)?(\d\d):(\d\d)[,.](\d{1,3})\s*-->")
_FEET, _METRES = r"(?:\s?(ft|feet)\b)?", 0.3048
_SIDE = r"(?i:([EWNS]|east|west|north|south))"
_BEHIND = rf"\s?°?\s?{_SIDE}\b(?!\s*:)"
_NAMED = re.compile(rf"\b([A-Za-z_]{{1,32}})\s{{0,4}}[:(]\s*({_NUMBER}){_FEET}(?:{_BEHIND})?")
_HEMISPHERES = re.compile(rf"\b{_SIDE}\s*:?\s*({_NUMBER})|({_NUMBER}){_BEHIND}")
"""Autel's GPS(E: 8.5, N: 47.1, 30.5m), or a letter or word behind the number, of one of both at least."""
_UNREAD = re.compile(
    r"\d\s+\d|(?<![^\W\d_])(?!(?i:[ewnsm]|east|west|north|south|ft|feet|sats?)(?![^\W\d_]))[^\W\d_]"
)
"""Degrees and minutes, or a word that is no unit and no side: such a place is not read."""
_GPS = re.compile(r"\bGPS\s*\(([^()\n]{1,80})\)")
_HEIGHT = re.compile(rf"(?<![\w.])H\s+({_NUMBER})(?:\s*m\b|{_FEET[3:-2]})")
_ANGLES = re.compile(r"\b([FG])\.PRY\s*\(([^()\n]{1,80})\)")
"""Pitch, roll and yaw of the aircraft (F) and of the gimbal (G): Phantom 4 and Mavic Mini, all in one line."""
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
    founds = [found[1] for _, body in blocks if (found := _GPS.search(body)) is not None]
    places = [_numbers(found) for found in founds if not _HEMISPHERES.search(found)]
    latitude_first = _latitude_first([one for one in places if len(one) >= 2], note)
    unplaced = 0
    said: set[str] = set()
    for time, body in blocks:
        row = {"time_s": _seconds(time), **_values(body, latitude_first=latitude_first)}
        if row.pop("unclear_m", None) is not None and not {"height_m", "altitude_m"} & row.keys():
            said.add("its 'altitude' is left out: models mean different heights by it")
        if row.pop("zoom", 1.0) > 1:
            said.add("its digital zoom is not read: give a table with hfov_deg")
        place = row.get("latitude_deg"), row.get("longitude_deg")
        if None in place or not any(place):  # both are 0 before there is a fix
            unplaced += 1
            continue
        yield row
    for sentence in sorted(said):
        note(sentence)
    if unplaced:
        note(f"{unplaced} of its {len(blocks)} blocks have no place, as before there is a fix")


def _values(body: str, *, latitude_first: bool) -> dict[str, float]:
    row = _place(body, latitude_first=latitude_first)
    if (height := _HEIGHT.search(body)) is not None:
        row["height_m"] = _value(height[1], feet=height[2])
    for whose, angles in _ANGLES.findall(body):
        values = _numbers(angles)
        prefix = "camera_" if whose == "G" else ""
        if len(values) == 3:
            angle_names = (f"{prefix}pitch_deg", f"{prefix}roll_deg", f"{prefix}yaw_deg")
            row |= {name: value for name, (value, _) in zip(angle_names, values, strict=True)}
    for name, said, feet, letter in _NAMED.findall(body):
        if name.lower() in _DJI:
            least, parts = _IN_PARTS.get(name.lower(), (0, 1))
            value = _value(said, feet=feet)
            value = value / parts if said.isdecimal() and value > least else value
            column = _DJI[name.lower()]
            row[column] = -abs(value) if letter[:1].upper() == _NEGATIVE.get(column) else value
    focal_mm = row.pop("focal_mm", 0.0)
    if focal_mm >= 1:
        row["hfov_deg"] = math.degrees(2 * math.atan(_FULL_FRAME_MM / 2 / focal_mm))
    return row


def _place(body: str, *, latitude_first: bool) -> dict[str, float]:
    found = _GPS.search(body)
    if found is None or _UNREAD.search(found[1]):
        return {}
    place = _numbers(found[1])
    if letters := _HEMISPHERES.findall(found[1]):
        values = [((before or behind)[0].upper(), _value(one or two)) for before, one, two, behind in letters]
        said = {
            "longitude_deg" if letter in "EW" else "latitude_deg": -abs(value) if letter in "WS" else value
            for letter, value in values  # some write the sign as well
        }
        if len(said) == 1 and len(place) >= 2:  # of the first two numbers the other one is the other
            other = place[values[0][0] in place[0][1]][0]
            said = dict.fromkeys(_NEGATIVE, other) | said
        return said
    if len(place) < 2:
        return {}
    names = ("latitude_deg", "longitude_deg") if latitude_first else ("longitude_deg", "latitude_deg")
    return {name: value for name, (value, _) in zip(names, place, strict=False)}


def _latitude_first(places: Sequence[Sequence[tuple[float, str]]], note: Callable[[str], None]) -> bool:
    """Which of the first two numbers of GPS(…) is the latitude; the third is its height, or a count of satellites.

    | numbers | first is |
    |---|---|
    | a first number beyond 90 | the longitude |
    | a second number beyond 90 | the latitude |
    | a third with a unit, a fraction, or beyond 60: a height | the latitude (enterprise models, goggles) |
    | else | the longitude (Phantom, Mavic); it is said that this is a guess |
    """
    if not places:
        return False
    if any(abs(one[0][0]) > _MOST_LATITUDE for one in places):
        return False
    if any(abs(one[1][0]) > _MOST_LATITUDE for one in places):
        return True
    if any(len(one) > 2 and not (one[2][1].isdigit() and one[2][0] <= _MOST_SATELLITES) for one in places):
        note("its GPS(…) is taken for latitude, longitude, height, because the third number is a height")
        return True
    note("its GPS(…) is taken for longitude, latitude, satellites, as most models write: look at the map")
    return False


def _numbers(text: str) -> list[tuple[float, str]]:
    # (value, how it is written) of numbers between commas, with decimal points or decimal commas.
    parts = re.split(r"\s*(?:,\s+|;)\s*", text.strip())
    if len(parts) < 2:
        parts = text.strip().split(",")
        if "." not in text and len(parts) >= 4:
            parts = [f"{parts[0]}.{parts[1]}", f"{parts[2]}.{parts[3]}", ".".join(parts[4:])]
    found = [(re.match(_NUMBER, one), one) for one in parts]
    return [(_value(number[0]), one) for number, one in found if number is not None]


def _value(text: str, *, feet: str | None = None) -> float:
    return float(text.replace(",", ".")) * (_METRES if feet else 1.0)


def _seconds(time: re.Match[str]) -> float:
    hours, minutes, seconds, rest = time.groups(default="0")
    return 3600 * int(hours) + 60 * int(minutes) + int(seconds) + float(f"0.{rest}")
