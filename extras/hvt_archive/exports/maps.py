"""Exports for maps: GeoJSON (RFC 7946) and KML (OGC 12-007r2).

The camera's way is one line; each track is one, of its places at most once a second. A track that stayed within
the errors of its places is a point, the surest of them. A way that crosses the antimeridian is in parts.
"""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ET
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from hvt_common.errors import UserError
from hvt_common.geodesy import metres_per_degree, moved, wrap_180
from hvt_common.units import SECOND_NS, utc_text
from hvt_ground.recordings.row import Recorded
from hvt_ground.sinks.palette import class_colour

_EVERY_NS: Final = SECOND_NS
_ELLIPSE_CORNERS: Final = 24
_KML: Final = "http://www.opengis.net/kml/2.2"
_GX: Final = "http://www.google.com/kml/ext/2.2"
ET.register_namespace("", _KML)
ET.register_namespace("gx", _GX)

_DIGITS: Final = 7
"""Digits of degrees: a centimetre."""


@dataclass(frozen=True, slots=True)
class Fix:
    """A place of a way."""

    capture_ns: int
    longitude_deg: float
    latitude_deg: float
    height_m: float | None = None
    """Above the ground."""
    ellipse: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of a track: half its axes in metres, and the longer one's direction."""

    @property
    def position(self) -> list[float]:
        return [round(self.longitude_deg, _DIGITS), round(self.latitude_deg, _DIGITS)]


@dataclass(slots=True)
class _Track:
    spots: list[Fix] = field(default_factory=list)
    classes: Counter[str] = field(default_factory=Counter)
    confidence: float = 0.0
    refined: bool = False
    first_ns: int = 2**63
    last_ns: int = 0
    """The earliest and the latest time, by a clock that may have been set back."""

    @property
    def class_name(self) -> str:
        """The one that it bore most often."""
        return self.classes.most_common(1)[0][0]

    @property
    def surest(self) -> Fix:
        return min(self.spots, key=lambda one: one.ellipse[0])

    @property
    def moved(self) -> bool:
        """Whether it went further than its places may be off by."""
        first, reach_m = self.spots[0], max(one.ellipse[0] for one in self.spots)
        north_m, east_m = metres_per_degree(first.latitude_deg)
        return any(
            math.hypot(
                (one.latitude_deg - first.latitude_deg) * north_m,
                wrap_180(one.longitude_deg - first.longitude_deg) * east_m,
            )
            > reach_m
            for one in self.spots
        )


def write_geojson(recorded: Recorded, path: Path) -> None:
    """A FeatureCollection; longitude before latitude, as the standard has it. `UserError` without a pose."""
    features = [_camera_feature(recorded)]
    for track_id, track in _tracks(recorded).items():
        spot = track.surest
        geometry: dict[str, Any] = {"type": "Point", "coordinates": spot.position}
        if track.moved:
            geometry = line(parts_of(track.spots))
        properties = {
            "kind": "track",
            "id": track_id,
            "class": track.class_name,
            "confidence": round(track.confidence, 3),
            "refined": track.refined,
            "first_utc": utc_text(track.first_ns),
            "last_utc": utc_text(track.last_ns),
            "error_m": round(spot.ellipse[0], 1),
            "error_minor_m": round(spot.ellipse[1], 1),
            "error_azimuth_deg": round(spot.ellipse[2], 1),
        }
        features.append({"type": "Feature", "geometry": geometry, "properties": properties})
    collection = {"type": "FeatureCollection", "features": features}
    path.write_text(json.dumps(collection, ensure_ascii=False), encoding="utf-8")


def write_kml(recorded: Recorded, path: Path) -> None:
    """Placemarks with times: the camera's way, and each track with its ellipse. `UserError` without a pose."""
    root = ET.Element(f"{{{_KML}}}kml")
    document = _with(root, "Document", name=recorded.edge)
    _timed_way(_with(document, "Placemark", name=recorded.edge), _camera_way(recorded))
    for track_id, track in _tracks(recorded).items():
        spot = track.surest
        place = _with(document, "Placemark", name=f"{track_id} {track.class_name}")
        if not track.moved:  # a way has times of its own
            _with(place, "TimeSpan", begin=utc_text(track.first_ns), end=utc_text(track.last_ns))
        red, green, blue = class_colour(track.class_name)
        style = _with(place, "Style")
        for kind in ("IconStyle", "LineStyle"):  # in the order of the schema
            _with(style, kind, color=f"ff{blue:02x}{green:02x}{red:02x}")
        _with(style, "PolyStyle", color=f"30{blue:02x}{green:02x}{red:02x}")
        facts = _with(place, "ExtendedData")
        for name, value in (
            ("confidence", f"{track.confidence:.3f}"),
            ("refined", str(int(track.refined))),
            ("error_m", f"{spot.ellipse[0]:.1f}"),
        ):
            _with(_with(facts, "Data", {"name": name}), value=value)
        shapes = _with(place, "MultiGeometry")
        if track.moved:
            _timed_way(shapes, track.spots)
        else:
            _with(_with(shapes, "Point"), coordinates=f"{spot.longitude_deg:.7f},{spot.latitude_deg:.7f}")
        outline = _outline(spot)
        if all(abs(east - spot.longitude_deg) < 180 for _, east in outline):  # else drawn around the earth
            ring = _with(_with(_with(shapes, "Polygon"), "outerBoundaryIs"), "LinearRing")
            _with(ring, coordinates=" ".join(f"{east:.7f},{north:.7f}" for north, east in outline))
    ET.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def _poses(recorded: Recorded) -> Sequence[Any]:
    if not recorded.poses:
        raise UserError(
            f"the recording of {recorded.edge} has no pose: give hvt-edge --pose when it is flown"
        )
    return recorded.poses


def _tracks(recorded: Recorded) -> dict[int, _Track]:
    """The tracks by id, of those whose place was ever known; doubted tracks are left out."""
    _poses(recorded)
    tracks: defaultdict[int, _Track] = defaultdict(_Track)
    for overlay in recorded.overlays():
        places = overlay.places
        if places is None:
            continue
        for row, track_id in enumerate(overlay.track_ids.tolist()):
            latitude, longitude = places.places_deg[row].tolist()
            if math.isnan(latitude) or overlay.doubted[row]:
                continue
            track = tracks[track_id]
            track.classes[overlay.words[row]] += 1
            track.confidence = max(track.confidence, float(overlay.confidences[row]))
            track.refined |= bool(overlay.refined[row])
            at_ns = overlay.capture_ns
            track.first_ns, track.last_ns = min(track.first_ns, at_ns), max(track.last_ns, at_ns)
            if not track.spots or abs(at_ns - track.spots[-1].capture_ns) >= _EVERY_NS:
                major, minor, azimuth = places.ellipses[row].tolist()
                track.spots.append(Fix(at_ns, longitude, latitude, ellipse=(major, minor, azimuth)))
    return dict(sorted(tracks.items()))


def _camera_way(recorded: Recorded) -> list[Fix]:
    return [
        Fix(one.capture_ns, one.pose.longitude_deg, one.pose.latitude_deg, one.pose.height_m)
        for one in _poses(recorded)
    ]


def _camera_feature(recorded: Recorded) -> dict[str, Any]:
    """``utc`` and ``height_m`` have a value for each position, those of parts one after another."""
    way = _camera_way(recorded)
    still = all(one.position == way[0].position for one in way)
    parts = [way] if still else parts_of(way)
    properties = {
        "kind": "camera",
        "edge": recorded.edge,
        "session": recorded.session,
        "utc": [utc_text(one.capture_ns) for part in parts for one in part],
        "height_m": [one.height_m for part in parts for one in part],
    }
    geometry = {"type": "Point", "coordinates": way[0].position} if still else line(parts)
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _outline(spot: Fix) -> list[tuple[float, float]]:
    """Latitude and longitude around the ellipse, the first again at the end."""
    major, minor, azimuth = spot.ellipse
    turned = math.radians(azimuth)
    corners = []
    for number in range(_ELLIPSE_CORNERS + 1):
        angle = 2 * math.pi * (number % _ELLIPSE_CORNERS) / _ELLIPSE_CORNERS
        along, across = major * math.cos(angle), minor * math.sin(angle)
        corners.append(
            moved(
                spot.latitude_deg,
                spot.longitude_deg,
                north_m=along * math.cos(turned) - across * math.sin(turned),
                east_m=along * math.sin(turned) + across * math.cos(turned),
            )
        )
    return corners


def _timed_way(parent: ET.Element, way: Sequence[Fix]) -> None:
    element = ET.SubElement(parent, f"{{{_GX}}}Track")
    _with(element, altitudeMode="clampToGround" if way[0].height_m is None else "relativeToGround")
    for one in way:
        _with(element, when=utc_text(one.capture_ns))
    for one in way:
        text = f"{one.longitude_deg:.7f} {one.latitude_deg:.7f} {one.height_m or 0:.1f}"
        ET.SubElement(element, f"{{{_GX}}}coord").text = text


def _with(
    parent: ET.Element, tag: str = "", attributes: dict[str, str] | None = None, **texts: str
) -> ET.Element:
    """A new element below ``parent``, or itself, with an element for each text."""
    element = ET.SubElement(parent, f"{{{_KML}}}{tag}", attributes or {}) if tag else parent
    for name, text in texts.items():
        ET.SubElement(element, f"{{{_KML}}}{name}").text = "".join(c for c in text if c.isprintable())
    return element


def line(parts: Sequence[Sequence[Fix]]) -> dict[str, Any]:
    """A LineString, or a MultiLineString of several parts."""
    lines = [[one.position for one in part] for part in parts]
    if len(lines) == 1:
        return {"type": "LineString", "coordinates": lines[0]}
    return {"type": "MultiLineString", "coordinates": lines}


def parts_of(way: Sequence[Fix]) -> list[list[Fix]]:
    """The way, with an end at the antimeridian and a beginning on its other side each time that it crosses it.

    RFC 7946, 3.1.9: a reader would draw the line around the earth.
    """
    parts = [[way[0]]]
    for before, after in pairwise(way):
        if abs(after.longitude_deg - before.longitude_deg) > 180:
            side_deg = math.copysign(180.0, before.longitude_deg)
            crossing = _crossing(before, after, side_deg)
            parts[-1].append(crossing)
            parts.append([replace(crossing, longitude_deg=-side_deg)])
        parts[-1].append(after)
    return parts


def _crossing(before: Fix, after: Fix, side_deg: float) -> Fix:
    """Between two places, where the line through them is at 180 or -180 degrees."""
    across_deg = wrap_180(after.longitude_deg - before.longitude_deg)
    share = (side_deg - before.longitude_deg) / across_deg if across_deg else 0.0
    heights = before.height_m, after.height_m
    return Fix(
        before.capture_ns + round(share * (after.capture_ns - before.capture_ns)),
        side_deg,
        before.latitude_deg + share * (after.latitude_deg - before.latitude_deg),
        None if heights[0] is None or heights[1] is None else heights[0] + share * (heights[1] - heights[0]),
    )
