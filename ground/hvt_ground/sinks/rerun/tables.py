"""Turns rows into columns of a Rerun chunk. A table is one entity with one set of columns."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, chain, groupby
from operator import itemgetter
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from hvt_ground.sinks.palette import Rgb
from hvt_ground.sinks.rerun.still_places import Placement

_LATEST_NS = 2**63 - 1
FIXED_BYTES = 77_000
"""About the cost of the blueprint and the static values."""
TABLE_BYTES = 2_000
"""About the cost of a chunk before its first row."""
_CHUNK_BYTES = 2**17
"""A table's chunks are about as large at most: where a file breaks off, all of the last one is lost."""
_HEAD_START_BYTES = 30_000
"""Beyond the ratio, so that the first pictures of a flight are shown."""

Columns = Iterable[rr.ComponentColumn]


@dataclass(frozen=True, slots=True)
class PlacedJpeg:
    """A JPEG with a place."""

    data: bytes
    place: Placement


@dataclass(frozen=True, slots=True)
class Caption:
    """Words under a frame."""

    text: str
    colour: Rgb
    frame: tuple[float, float, float, float]
    """x1 y1 x2 y2."""


@dataclass(frozen=True, slots=True)
class CodedIdentity:
    """`overlays.Identity` with the class ids of the layer's annotation context."""

    track_ids: tuple[int, ...]
    before: tuple[int, ...]
    now: tuple[int, ...]
    words: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class MapPoints:
    """Places of N tracks."""

    places_deg: npt.NDArray[np.float64]
    """(N, 2) latitude and longitude."""
    colours: tuple[int, ...]
    track_ids: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class LogText:
    """A line of the event log."""

    text: str
    level: str
    colour: Rgb


@dataclass(frozen=True, slots=True)
class TableRow:
    """A row for the table of an entity with these columns."""

    path: str
    columns: str
    """A name of `COLUMNS`."""
    value: Any
    size_bytes: int = 64
    """Its bytes once compacted, about."""
    at: tuple[int, int] | None = None
    """Frame index and capture time, where they are not the event's."""


@dataclass(slots=True)
class Table:
    """Rows of one entity that share their columns, gathered until they are compacted."""

    path: str
    columns: str
    _rows: list[tuple[int, int, Any, int]] = field(default_factory=list)
    _bytes: int = 0

    def add(self, frame: int, capture_ns: int, value: Any, *, size_bytes: int) -> Chunk:
        """Gather a row; returns it as a chunk of its own, for the append log.

        Times come from the wire: one beyond the range of timestamps becomes the nearest that can be held.
        """
        row = frame, min(max(capture_ns, 0), _LATEST_NS), value, size_bytes
        self._rows.append(row)
        self._bytes += size_bytes
        return self._chunk([row])

    @property
    def chunk_count(self) -> int:
        """Number of chunks that `take` would give."""
        return bool(self._rows) + self._bytes // _CHUNK_BYTES

    def take(self) -> list[Chunk]:
        """All rows since the last call as chunks. Those of a backlog have come late."""
        rows = sorted(self._rows, key=itemgetter(0))
        ends = zip(accumulate(size_bytes for *_, size_bytes in rows), rows, strict=True)
        self._rows, self._bytes = [], 0
        return [
            self._chunk([row for _, row in some])
            for _, some in groupby(ends, lambda one: one[0] // _CHUNK_BYTES)
        ]

    def _chunk(self, rows: Sequence[tuple[int, int, Any, int]]) -> Chunk:
        frames, capture_ns, values, _ = zip(*rows, strict=True)
        indexes = [
            rr.TimeColumn("frame", sequence=frames),
            rr.TimeColumn("capture_time", timestamp=np.array(capture_ns, "datetime64[ns]")),
        ]
        return Chunk.from_columns(self.path, indexes, COLUMNS[self.columns](values))


class SizeLimit:
    """The limit of a recording's size: the more bytes the link brought, the more is worth writing."""

    def __init__(self) -> None:
        self.received_bytes = 0
        self.logged_bytes = FIXED_BYTES
        """About, once compacted."""

    def has(self, size_bytes: int, *, ratio: float) -> bool:
        """Whether the recording stays below ``ratio`` times the bytes received with ``size_bytes`` more in it."""
        allowed = ratio * self.received_bytes + FIXED_BYTES + _HEAD_START_BYTES
        return self.logged_bytes + size_bytes <= allowed


def static_chunk(path: str, values: rr.AsComponents) -> Chunk:
    """Values that hold for the whole recording."""
    columns = [batch.partition([len(batch.as_arrow_array())]) for batch in values.as_component_batches()]
    return Chunk.from_columns(path, [], columns)


def _shapes(shape: type[rr.Boxes2D | rr.Ellipses2D], rows: Sequence[npt.NDArray[np.float32]]) -> Columns:
    boxes = np.concatenate(rows)
    columns = shape.columns(centers=boxes[:, :2], half_sizes=boxes[:, 2:])
    return columns.partition([len(row) for row in rows])


def _identities(shape: type[rr.Boxes2D | rr.Ellipses2D], rows: Sequence[CodedIdentity]) -> Columns:
    lengths = [len(row.track_ids) for row in rows]
    drawn = shape.columns(class_ids=np.array([i for row in rows for i in row.words], np.uint16))
    values = rr.AnyValues.columns(
        track_id=pa.array([i for row in rows for i in row.track_ids], pa.uint32()),
        class_before=pa.array([i for row in rows for i in row.before], pa.uint16()),
        class_now=pa.array([i for row in rows for i in row.now], pa.uint16()),
    )
    return [*drawn.partition(lengths), *values.partition(lengths)]


def _bytes(name: str, rows: Sequence[tuple[int, ...]]) -> Columns:
    values = rr.AnyValues.columns(**{name: pa.array(chain.from_iterable(rows), pa.uint8())})
    return values.partition([len(row) for row in rows])


def _labels(**values: Sequence[Sequence[Any]]) -> Columns:
    # One component of points, any number in each row.
    ((name, rows),) = values.items()
    columns = rr.Points2D.columns(**{name: list(chain.from_iterable(rows))})
    return columns.partition([len(row) for row in rows])


def _places(rows: Sequence[Placement]) -> rr.ComponentColumnList:
    # The viewer reads a transform as a whole: a missing field is not taken from the row before.
    return rr.Transform3D.columns(
        translation=[(place.x, place.y, 0.0) for place in rows],
        scale=[(place.scale, place.scale, 1.0) for place in rows],
    )


def _patches(rows: Sequence[PlacedJpeg | None]) -> Columns:
    there = [row for row in rows if row is not None]
    lengths = [int(row is not None) for row in rows]
    blobs = rr.EncodedImage.columns(blob=[row.data for row in there])
    return [*blobs.partition(lengths), *_places([row.place for row in there]).partition(lengths)]


def _captions(rows: Sequence[Caption]) -> Columns:
    frames = np.array([row.frame for row in rows])
    return rr.Boxes2D.columns(
        centers=(frames[:, :2] + frames[:, 2:]) / 2,
        half_sizes=(frames[:, 2:] - frames[:, :2]) / 2 + 2,
        labels=[row.text for row in rows],
        colors=np.array([packed(row.colour) for row in rows], np.uint32),
    )


def _texts(rows: Sequence[LogText]) -> Columns:
    return rr.TextLog.columns(
        text=[row.text for row in rows],
        level=[row.level for row in rows],
        color=np.array([packed(row.colour) for row in rows], np.uint32),
    )


def _poses(rows: Sequence[npt.NDArray[np.float64]]) -> Columns:
    numbers = np.array(rows)
    values = rr.AnyValues.columns(pose=pa.array(numbers.ravel(), pa.float64()))
    return [*rr.GeoPoints.columns(positions=numbers[:, :2]), *values.partition([len(row) for row in rows])]


def _map_points(rows: Sequence[MapPoints]) -> Columns:
    lengths = [len(row.track_ids) for row in rows]
    points = rr.GeoPoints.columns(
        positions=np.concatenate([row.places_deg for row in rows]),
        colors=np.array([one for row in rows for one in row.colours], np.uint32),
    )
    ids = rr.AnyValues.columns(track_id=pa.array([i for row in rows for i in row.track_ids], pa.uint32()))
    return [*points.partition(lengths), *ids.partition(lengths)]


def packed(colour: Rgb) -> int:
    """Opaque RGBA as one number, which is how Rerun stores a colour."""
    return colour[0] << 24 | colour[1] << 16 | colour[2] << 8 | 0xFF


COLUMNS: dict[str, Callable[[Sequence[Any]], Columns]] = {
    "video": lambda rows: rr.VideoStream.columns(sample=list(rows)),
    "boxes": lambda rows: _shapes(rr.Boxes2D, rows),
    "ellipses": lambda rows: _shapes(rr.Ellipses2D, rows),
    "identity of boxes": lambda rows: _identities(rr.Boxes2D, rows),
    "identity of ellipses": lambda rows: _identities(rr.Ellipses2D, rows),
    "places": lambda rows: _labels(positions=rows),
    "words": lambda rows: _labels(labels=rows),
    "inks": lambda rows: _labels(class_ids=rows),
    "confidences": lambda rows: _bytes("confidence_pct", rows),
    "origins": lambda rows: _bytes("origin", rows),
    "jpeg": lambda rows: rr.EncodedImage.columns(blob=list(rows)),
    "placed jpeg": lambda rows: [
        *rr.EncodedImage.columns(blob=[row.data for row in rows]),
        *_places([row.place for row in rows]),
    ],
    "place": _places,
    "patch": _patches,
    "caption": _captions,
    "message": lambda rows: rr.AnyValues.columns(message=pa.array(rows, pa.binary())),
    "pose": _poses,
    "map points": _map_points,
    "text": _texts,
    "lines": lambda rows: rr.Scalars.columns(scalars=np.ravel(rows)).partition(list(map(len, rows))),
}
"""Component of each value of a row, by name. ``patch``: a placed JPEG, or None, which takes it off."""
