"""One Cursor on Target event, version 2.0, and its XML.

The attributes are those of MITRE's public base schema and of the sub-schemas ``contact``, ``track``, ``sensor``,
``link`` and ``remarks``, as the source of ATAK-CIV 4.6 reads them.

Which Cursor on Target type an object of a class has, and a platform: the table here, and one of the user's.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from importlib.resources import files
from pathlib import Path
from typing import Any, Final
from xml.etree.ElementTree import Element, SubElement, tostring

from hvt_common.errors import UserError, absent
from hvt_common.files import read_text, toml_table
from hvt_common.inference.class_names import kind_of
from hvt_common.units import utc_text

_TYPE: Final = re.compile(r"[A-Za-z0-9]+(-[A-Za-z0-9]+)*")
_MOST_TYPE: Final = 64
_MOST_NAME: Final = 128
_MOST_ROWS: Final = 10_000
_MOST_BYTES: Final = 1_000_000
_TABLES: Final = ("classes", "platforms")
_ANY: Final = "*"


@dataclass(frozen=True, slots=True)
class TypeTable:
    """Types by class name, in small letters, and by pattern of edge ids; both have a row ``*``."""

    classes: Mapping[str, str]
    platforms: Mapping[str, str]

    def of_class(self, name: str) -> str:
        """The type of an object: by its class name, else by the kind that it means, else that of ``*``."""
        plain = name.casefold()
        return self.classes.get(plain) or self.classes.get(kind_of(plain)) or self.classes[_ANY]

    def of_edge(self, edge: str) -> str:
        """The type of the camera's platform: of the first pattern that fits, ``*`` last."""
        fits = (
            kind for pattern, kind in self.platforms.items() if pattern != _ANY and fnmatchcase(edge, pattern)
        )
        return next(fits, self.platforms[_ANY])

    def extended(self, other: TypeTable) -> TypeTable:
        classes = {**self.classes, **other.classes}
        former = {one: kind for one, kind in self.platforms.items() if one not in other.platforms}
        return TypeTable(classes, {**other.platforms, **former})


def default_types() -> TypeTable:
    """The table of ``types.toml`` beside this file."""
    text = (files("hvt_gateways.cot") / "types.toml").read_text(encoding="utf-8")
    return _parsed(toml_table(text), where="types.toml")


def read_types(path: Path | None) -> TypeTable:
    """The default table, with the rows of the user's before them; `UserError` where one of these is wrong."""
    table = default_types()
    if path is None:
        return table
    try:
        content = toml_table(read_text(path, most=_MOST_BYTES))
    except OSError as error:
        raise absent(path)(
            f"--cot-types {path} cannot be read ({error.strerror}): give a table of types, TOML"
        ) from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"--cot-types {path} is no TOML: {error}") from None
    return table.extended(_parsed(content, where=f"--cot-types {path}"))


def _parsed(content: Mapping[str, Any], *, where: str) -> TypeTable:
    unknown = [name for name in content if name not in _TABLES]
    if unknown:
        raise UserError(f"{where}: {unknown[0]!r} is not known: give the tables [classes] and [platforms]")
    classes, platforms = (_rows(content.get(name, {}), where=f"{where}: [{name}]") for name in _TABLES)
    return TypeTable({name.casefold(): kind for name, kind in classes.items()}, platforms)


def _rows(table: object, *, where: str) -> dict[str, str]:
    if not isinstance(table, dict):
        raise UserError(f'{where} is no table: write rows such as car = "a-u-G-E-V-C" below it')
    if len(table) > _MOST_ROWS:
        raise UserError(f"{where} has {len(table)} rows: {_MOST_ROWS} are accepted")
    for name, kind in table.items():
        if not 0 < len(name) <= _MOST_NAME:
            raise UserError(f"{where} {name[:40]!r}: a name has 1 to {_MOST_NAME} characters")
        if not isinstance(kind, str) or len(kind) > _MOST_TYPE or _TYPE.fullmatch(kind) is None:
            raise UserError(
                f"{where} {name} = {str(kind)[:80]!r} is no Cursor on Target type: give one such as "
                "a-u-G-E-V-C, letters and digits between hyphens"
            )
    return table


UNKNOWN_M: Final = 9_999_999.0
"""The schema's value for an unknown height or error."""
_DECLARATION: Final = b'<?xml version="1.0" encoding="UTF-8" standalone="yes"?>\n'
_MOST_CALLSIGN: Final = 64
_MOST_REMARKS: Final = 400
_MOST_URL: Final = 300


@dataclass(frozen=True, slots=True)
class CotMessage:
    """An event on its way."""

    uid: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Point:
    """A place, WGS 84."""

    latitude_deg: float
    longitude_deg: float
    ce_m: float | None
    """Radius of the circle that holds it with 95 %."""
    le_m: float | None = None
    """Half the interval that holds its height with 95 %."""
    hae_m: float | None = None
    """Height above the ellipsoid."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Course and speed."""

    course_deg: float
    """Clockwise from true north, 0 up to 360."""
    speed_mps: float


@dataclass(frozen=True, slots=True)
class Sensor:
    """The view of a camera."""

    azimuth_deg: float
    """Clockwise from true north."""
    elevation_deg: float
    """Up from the horizon."""
    roll_deg: float
    hfov_deg: float
    vfov_deg: float
    range_m: float | None
    """How far it sees the ground."""


@dataclass(frozen=True, slots=True)
class Parent:
    """Who says it: the event of the platform."""

    uid: str
    type: str
    callsign: str


@dataclass(frozen=True, slots=True)
class CotEvent:
    """An event. Texts may hold anything: `message` removes characters that could harm XML or a reader."""

    uid: str
    type: str
    how: str
    time_ns: int
    """When it was made; this and the next two are Unix nanoseconds by the wall clock."""
    start_ns: int
    """When it was so."""
    stale_ns: int
    point: Point
    callsign: str
    remarks: str = ""
    motion: Motion | None = None
    sensor: Sensor | None = None
    parent: Parent | None = None
    url: str = ""
    """Address of a picture."""

    def message(self) -> CotMessage:
        """The event in UTF-8 with a declaration, in one line."""
        event = Element(
            "event",
            version="2.0",
            uid=self.uid,
            type=self.type,
            how=self.how,
            time=utc_text(self.time_ns),
            start=utc_text(self.start_ns),
            stale=utc_text(self.stale_ns),
        )
        point = self.point
        SubElement(
            event,
            "point",
            lat=f"{point.latitude_deg:.7f}",
            lon=f"{point.longitude_deg:.7f}",
            hae=_metres(point.hae_m),
            ce=_metres(point.ce_m),
            le=_metres(point.le_m),
        )
        detail = SubElement(event, "detail")
        SubElement(detail, "contact", callsign=plain(self.callsign, most=_MOST_CALLSIGN))
        if self.motion is not None:
            motion = self.motion
            SubElement(detail, "track", course=_azimuth(motion.course_deg), speed=f"{motion.speed_mps:.1f}")
        if self.sensor is not None:
            SubElement(detail, "sensor", _sensor(self.sensor))
        link = self._link()
        if link:
            SubElement(detail, "link", link)
        SubElement(detail, "remarks").text = plain(self.remarks, most=_MOST_REMARKS)
        return CotMessage(self.uid, _DECLARATION + tostring(event, encoding="utf-8", xml_declaration=False))

    def _link(self) -> dict[str, str]:
        """One for platform and picture: of two, ATAK takes each attribute from the last."""
        link = {}
        if self.parent is not None:
            link = {
                "relation": "p-p",
                "uid": self.parent.uid,
                "type": self.parent.type,
                "parent_callsign": self.parent.callsign,
                "production_time": utc_text(self.start_ns),
            }
        if self.url and len(self.url) <= _MOST_URL:
            link |= {"url": self.url, "mime": "image/jpeg"}
        return link


def plain(text: str, *, most: int) -> str:
    """One line of limited length; without control, invisible, direction and unassigned characters."""
    visible = "".join(one for one in text[: 4 * most] if one.isspace() or unicodedata.category(one)[0] != "C")
    words = " ".join(visible.split())
    return words if len(words) <= most else f"{words[: most - 1]}…"


def _metres(value: float | None) -> str:
    return f"{UNKNOWN_M:.1f}" if value is None or not math.isfinite(value) else f"{value:.1f}"


def _azimuth(degrees: float) -> str:
    """Clockwise from north, 0.0 up to 359.9: rounded first, for 359.97 is north."""
    return f"{round(degrees, 1) % 360:.1f}"


def _sensor(sensor: Sensor) -> dict[str, str]:
    shown = {
        "elevation": sensor.elevation_deg,
        "roll": sensor.roll_deg,
        "fov": sensor.hfov_deg,
        "vfov": sensor.vfov_deg,
        "range": sensor.range_m,
    }
    numbers = {name: f"{value:.1f}" for name, value in shown.items() if value is not None}
    numbers["azimuth"] = _azimuth(sensor.azimuth_deg)
    return numbers | {"displayMagneticReference": "0", "fovAlpha": "0.3"}
