"""One layer of boxes of a recording: which box was drawn where at a frame."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from hvt_archive.reading.spool import SpooledRows, Timed
from hvt_ground.events import Origin
from hvt_ground.sinks.rerun.overlays import ORIGINS

_CLASSES = ("class_before", "class_now", "class_ids")
TRACK_COMPONENTS = frozenset({"centers", "half_sizes", "track_id", *_CLASSES, "confidence_pct", "origin"})
"""The rest is of the layer, once: how it is drawn."""
_IDS = 2**16
"""Numbers of classes in a file; another ground may have given the same ones to other classes."""
_HUNDRED = 100


def of_file(row: Timed, component: str, *, number: int) -> Timed:
    """A row of the file of this number, with numbers of classes that no other file has."""
    frame, capture_ns, value = row
    if component.rpartition(":")[2] in _CLASSES:
        value = [one + number * _IDS for one in value]
    elif component.endswith("context"):
        value = [[one | {"class_id": one["class_id"] + number * _IDS} for one in value[0]]]
    return frame, capture_ns, value


DrawnBox = tuple[int, tuple[float, float, float, float], str, str, str, float, Origin]
"""A track with its box as it stood at a frame, x1 y1 x2 y2, base pixels; its base class, its class, the word that it
is called by, its confidence and origin."""


class DrawnLayer:
    """The components of one layer of boxes, each with its rows in order of frames."""

    def __init__(self) -> None:
        self._rows: dict[str, SpooledRows] = {}
        self._shown: dict[str, tuple[int, list[Any]]] = {}
        """By component, the row that was requested last, and its place."""
        self._names: dict[int, str] = {}

    def add(self, component: str, rows: SpooledRows) -> None:
        """Take all rows of a component; the names of classes hold for all times."""
        name = component.rpartition(":")[2]
        if name in TRACK_COMPONENTS:
            rows.sort()
            self._rows[name] = rows
            return
        for _, _, value in rows:
            for one in value[0]:
                self._names[one["class_id"]] = one["class_description"]["info"]["label"]

    def times(self) -> list[SpooledRows]:
        """Where boxes changed."""
        return list(self._rows.values())

    def at(self, frame: int, *, reported: bool) -> Iterator[DrawnBox]:
        """The boxes drawn at a frame."""
        ids = self._latest("track_id", frame)
        before, words = self._latest("class_before", frame), self._latest("class_ids", frame)
        now = self._latest("class_now", frame) or words  # older recordings have one of them
        percents = self._latest("confidence_pct", frame) or [0] * len(ids)
        origins = self._latest("origin", frame) or [int(reported)] * len(ids)
        places = zip(self._latest("centers", frame), self._latest("half_sizes", frame), strict=False)
        for track, ((x, y), (w, h)), was, named, shown, percent, origin in zip(
            ids, places, before, now, words, percents, origins, strict=False
        ):
            yield (
                track,
                (x - w, y - h, x + w, y + h),
                self._names.get(was, "?"),
                self._names.get(named, "?"),
                self._names.get(shown, "?"),
                percent / _HUNDRED,
                ORIGINS[origin] if origin < len(ORIGINS) else "base",
            )

    def _latest(self, name: str, frame: int) -> list[Any]:
        rows = self._rows.get(name)
        place = -1 if rows is None else rows.latest(frame)
        if rows is None or place < 0:
            return []
        if self._shown.get(name, (-1,))[0] != place:
            self._shown[name] = place, rows.value(place)
        return self._shown[name][1]
