"""The map of a recording: where the camera was, and once a second where tracks stood."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import fields
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from hvt_common.units import SECOND_NS
from hvt_common.values import Orientation, Pose, View
from hvt_ground.events import Overlay, PoseUpdate
from hvt_ground.sinks.palette import class_colour
from hvt_ground.sinks.rerun import blueprint as names
from hvt_ground.sinks.rerun.tables import MapPoints, TableRow, packed

_EVERY_NS: Final = SECOND_NS
_POINT_BYTES = 24
_PLAIN: Final = tuple(
    one.name for one in fields(Pose) if one.name not in ("capture_ns", "camera", "platform")
)
_VIEW_NUMBERS: Final = 7
_TURNED: Final = tuple(one.name for one in fields(Orientation))


class MapRows:
    """The map rows of one recording."""

    def __init__(self) -> None:
        self._next_ns = 0

    def overlay(self, overlay: Overlay) -> Iterable[TableRow]:
        """The places of tracks, at most once a second."""
        places = overlay.places
        if places is None or 0 < self._next_ns - overlay.capture_ns <= _EVERY_NS:
            return []
        self._next_ns = overlay.capture_ns + _EVERY_NS
        known, words = np.flatnonzero(np.isfinite(places.places_deg).all(axis=1)), overlay.words
        points = MapPoints(
            places.places_deg[known],
            tuple(packed(class_colour(words[row])) for row in known.tolist()),
            tuple(overlay.track_ids[known].tolist()),
        )
        return [TableRow(names.MAP_TRACKS, "map points", points, _POINT_BYTES * len(known))]


def pose_numbers(update: PoseUpdate) -> npt.NDArray[np.float64]:
    """A pose and a view as (21,) float64; NaN for unknown ones.

    Latitude, longitude, height, altitude, field of view, the three errors, the angles of camera and platform, as
    `Pose` and `Orientation` have them; then (width, height) of source and base, scale and offset of the `View`.
    """
    pose, view = update.pose, update.view
    plain = [getattr(pose, name) for name in _PLAIN]
    turned = [
        None if one is None else getattr(one, name)
        for one in (pose.camera, pose.platform)
        for name in _TURNED
    ]
    known = [np.nan if one is None else one for one in (*plain, *turned)]
    return np.array([*known, *view.source_size, *view.base_size, view.scale, *view.offset_px], np.float64)


def pose_of(numbers: Sequence[float], *, frame_index: int, capture_ns: int) -> PoseUpdate:
    """The pose that `pose_numbers` made these of. ValueError for another count of them."""
    values = [None if np.isnan(one) else float(one) for one in numbers]
    count, turned = len(_PLAIN), len(_TURNED)
    if len(values) != count + 2 * turned + _VIEW_NUMBERS:
        raise ValueError(f"a pose of {len(values)} numbers")

    def orientation(at: int) -> Orientation | None:
        yaw, pitch, roll = values[at : at + turned]
        return None if yaw is None or pitch is None or roll is None else Orientation(yaw, pitch, roll)

    plain: dict[str, Any] = dict(zip(_PLAIN, values[:count], strict=True))
    source_w, source_h, base_w, base_h, scale, *offset = numbers[-_VIEW_NUMBERS:]
    view = View(
        (int(source_w), int(source_h)),
        (int(base_w), int(base_h)),
        scale,
        (float(offset[0]), float(offset[1])),
    )
    pose = Pose(capture_ns, camera=orientation(count), platform=orientation(count + turned), **plain)
    return PoseUpdate(frame_index, capture_ns, pose, view)
