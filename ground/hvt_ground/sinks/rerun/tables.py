"""How each kind of row becomes columns of a Rerun chunk. A table is one entity with one set of columns."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Generic, TypeVar

import numpy as np
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from hvt_ground.sinks.rerun.gallery import Placement
from hvt_ground.sinks.rerun.overlay_encoding import Geometry
from hvt_ground.sinks.rerun.palette import Rgb

__all__ = [
    "FIXED_BYTES",
    "TABLE_BYTES",
    "Captions",
    "CodedIdentity",
    "Columns",
    "LogText",
    "PlacedJpeg",
    "PlotValues",
    "SizeLimit",
    "Table",
    "box_columns",
    "caption_columns",
    "confidence_columns",
    "hidden_picture_columns",
    "identity_columns",
    "label_columns",
    "line_columns",
    "origin_columns",
    "patch_columns",
    "picture_columns",
    "place_columns",
    "reported_columns",
    "reported_identity_columns",
    "static_chunk",
    "text_columns",
    "video_columns",
]

_LATEST_NS = 2**63 - 1

T = TypeVar("T")
Columns = Iterable[rr.ComponentColumn]


@dataclass(frozen=True, slots=True)
class PlacedJpeg:
    """A JPEG with a place."""

    data: bytes
    place: Placement


@dataclass(frozen=True, slots=True)
class CodedIdentity:
    """`hvt_ground.sinks.rerun.overlay_encoding.Identity` with numbers for classes."""

    track_ids: tuple[int, ...]
    before: tuple[int, ...]
    after: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class LogText:
    """A line of the event log."""

    text: str
    level: str
    colour: Rgb


Captions = tuple[tuple[str, Rgb], ...]
"""Text and colour for each slot of the gallery; an empty text hides its frame."""

PlotValues = tuple[float, ...]
"""One value for each line of a plot."""


@dataclass(slots=True)
class Table(Generic[T]):
    """Rows of one entity that share their columns, gathered until they are compacted."""

    path: str
    columns: Callable[[Sequence[T]], Columns]
    _frames: list[int] = field(default_factory=list)
    _capture_ns: list[int] = field(default_factory=list)
    _values: list[T] = field(default_factory=list)

    def add(self, frame: int, capture_ns: int, value: T) -> Chunk:
        """Keep a row; returns it as a chunk of its own, for the append log.

        Times come from the wire and are reckoned on from there: what no timestamp can hold is held at its end.
        """
        self._frames.append(frame)
        self._capture_ns.append(min(max(capture_ns, 0), _LATEST_NS))
        self._values.append(value)
        return self._chunk(slice(-1, None))

    def __bool__(self) -> bool:
        """Whether there are rows since the last `take`."""
        return bool(self._values)

    def take(self) -> Chunk | None:
        """All rows since the last call as one chunk; None where there are none."""
        if not self._values:
            return None
        self._sort()
        chunk = self._chunk(slice(None))
        self._frames, self._capture_ns, self._values = [], [], []
        return chunk

    def _sort(self) -> None:
        """Rows that were kept while the link was away come late; of those of one frame the last counts."""
        if all(one <= other for one, other in pairwise(self._frames)):
            return
        order = sorted(range(len(self._frames)), key=self._frames.__getitem__)
        self._frames = [self._frames[place] for place in order]
        self._capture_ns = [self._capture_ns[place] for place in order]
        self._values = [self._values[place] for place in order]

    def _chunk(self, rows: slice) -> Chunk:
        times = np.array(self._capture_ns[rows], "datetime64[ns]")
        indexes = [
            rr.TimeColumn("frame", sequence=self._frames[rows]),
            rr.TimeColumn("capture_time", timestamp=times),
        ]
        return Chunk.from_columns(self.path, indexes, self.columns(self._values[rows]))


def static_chunk(path: str, values: rr.AsComponents) -> Chunk:
    """Values that hold for the whole recording."""
    columns = [batch.partition([len(batch.as_arrow_array())]) for batch in values.as_component_batches()]
    return Chunk.from_columns(path, [], columns)


def video_columns(samples: Sequence[bytes]) -> Columns:
    """One access unit a row."""
    return rr.VideoStream.columns(sample=list(samples))


def reported_columns(rows: Sequence[Geometry]) -> Columns:
    """Ellipses in the boxes of the layer of tracks that the base stream does not show, a row."""
    return rr.Ellipses2D.columns(
        centers=np.concatenate([row.centres_px for row in rows]),
        half_sizes=np.concatenate([row.half_sizes_px for row in rows]),
    ).partition([len(row.centres_px) for row in rows])


def box_columns(rows: Sequence[Geometry]) -> Columns:
    """The boxes of one layer a row."""
    return rr.Boxes2D.columns(
        centers=np.concatenate([row.centres_px for row in rows]),
        half_sizes=np.concatenate([row.half_sizes_px for row in rows]),
    ).partition([len(row.centres_px) for row in rows])


def identity_columns(rows: Sequence[CodedIdentity]) -> Columns:
    """Ids and classes of one layer a row. Class ids are those of the layer's annotation context."""
    return _identity_columns(rows, rr.Boxes2D)


def reported_identity_columns(rows: Sequence[CodedIdentity]) -> Columns:
    """The same of the layer that is drawn as ellipses."""
    return _identity_columns(rows, rr.Ellipses2D)


def _identity_columns(rows: Sequence[CodedIdentity], shape: type[rr.Boxes2D | rr.Ellipses2D]) -> Columns:
    lengths = [len(row.track_ids) for row in rows]
    drawn = shape.columns(class_ids=np.array([i for row in rows for i in row.after], np.uint16))
    reported = rr.AnyValues.columns(
        track_id=pa.array([i for row in rows for i in row.track_ids], pa.uint32()),
        class_before=pa.array([i for row in rows for i in row.before], pa.uint16()),
    )
    return [*drawn.partition(lengths), *reported.partition(lengths)]


def label_columns(rows: Sequence[tuple[str, ...]]) -> Columns:
    """The labels of one layer a row."""
    texts = pa.array([label for row in rows for label in row], pa.utf8())
    return rr.Boxes2D.columns(labels=texts).partition([len(row) for row in rows])


def origin_columns(rows: Sequence[tuple[int, ...]]) -> Columns:
    """The origins of the tracks of one layer a row, numbers of `overlay_encoding.ORIGINS`."""
    numbers = pa.array([value for row in rows for value in row], pa.uint8())
    return rr.AnyValues.columns(origin=numbers).partition([len(row) for row in rows])


def confidence_columns(rows: Sequence[tuple[int, ...]]) -> Columns:
    """The confidences of one layer in percent a row."""
    percent = pa.array([value for row in rows for value in row], pa.uint8())
    return rr.AnyValues.columns(confidence_pct=percent).partition([len(row) for row in rows])


def picture_columns(rows: Sequence[PlacedJpeg]) -> Columns:
    """One picture a row, with its place in the gallery."""
    places = place_columns([row.place for row in rows])
    return [*hidden_picture_columns([row.data for row in rows]), *places]


def place_columns(rows: Sequence[Placement]) -> rr.ComponentColumnList:
    """Where a picture lies, one place a row."""
    # The viewer reads a transform as a whole: what a row leaves out is not taken from the row before.
    return rr.Transform3D.columns(
        translation=[(place.x, place.y, 0.0) for place in rows],
        scale=[(place.scale, place.scale, 1.0) for place in rows],
    )


def patch_columns(rows: Sequence[PlacedJpeg | None]) -> Columns:
    """One picture a row, with its place on the base picture; None takes it off."""
    there = [row for row in rows if row is not None]
    lengths = [int(row is not None) for row in rows]
    blobs = rr.EncodedImage.columns(blob=[row.data for row in there])
    return [*blobs.partition(lengths), *place_columns([row.place for row in there]).partition(lengths)]


def hidden_picture_columns(rows: Sequence[bytes]) -> Columns:
    """One JPEG a row that is not in the gallery."""
    return rr.EncodedImage.columns(blob=list(rows))


def caption_columns(rows: Sequence[Captions]) -> Columns:
    """The captions of all pairs a row; their frames are static."""
    return rr.Boxes2D.columns(
        labels=[text for row in rows for text, _ in row],
        colors=np.array([packed(colour) if text else 0 for row in rows for text, colour in row], np.uint32),
    ).partition([len(row) for row in rows])


def text_columns(rows: Sequence[LogText]) -> Columns:
    """One line of the event log a row."""
    return rr.TextLog.columns(
        text=[row.text for row in rows],
        level=[row.level for row in rows],
        color=np.array([packed(row.colour) for row in rows], np.uint32),
    )


def line_columns(rows: Sequence[PlotValues]) -> Columns:
    """The values of one plot's lines a row."""
    return rr.Scalars.columns(scalars=np.array(rows, np.float64).ravel()).partition(
        [len(row) for row in rows]
    )


def packed(colour: Rgb) -> int:
    """Opaque RGBA as one number, which is how Rerun stores a colour."""
    return colour[0] << 24 | colour[1] << 16 | colour[2] << 8 | 0xFF


FIXED_BYTES = 77_000
"""About what the blueprint and the static values cost."""

TABLE_BYTES = 2_000
"""About what a table costs in each compaction before its first row: a chunk and its columns."""

_HEAD_START_BYTES = 30_000
"""Beyond the ratio, so that the first pictures of a flight are shown."""


class SizeLimit:
    """Counts what came over the link and what was written for it."""

    def __init__(self) -> None:
        self.received_bytes = 0
        self.logged_bytes = FIXED_BYTES
        """About, once compacted."""

    def has(self, size_bytes: int, *, ratio: float) -> bool:
        """Whether the recording stays below ``ratio`` times the bytes received with so much more in it."""
        allowed = ratio * self.received_bytes + FIXED_BYTES + _HEAD_START_BYTES
        return self.logged_bytes + size_bytes <= allowed
