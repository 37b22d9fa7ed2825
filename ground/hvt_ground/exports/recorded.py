"""Reads recordings back: the events that the ground logged, as far as the files hold them.

Boxes are as they were drawn: a box is held while it moves by less than a pixel (docs/design-notes/recording.md).
"""

from __future__ import annotations

import heapq
import logging
import tempfile
import warnings
from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import Chunk, RrdReader

from hvt_common.errors import UserError
from hvt_common.video.annex_b import is_keyframe
from hvt_ground.events import Notice, Origin, Overlay, VideoSample
from hvt_ground.sinks.rerun.blueprint import DOUBTED, EVENTS, REFINED, REPORTED, STILLS, TRACKS, VIDEO
from hvt_ground.sinks.rerun.overlays import ORIGINS
from hvt_ground.sinks.rerun.rrd_file import copy_whole_messages

__all__ = ["Recorded", "RecordedStill", "read_recordings"]

_log = logging.getLogger(__name__)

_LAYERS = {TRACKS: "Boxes2D", REPORTED: "Ellipses2D", REFINED: "Boxes2D", DOUBTED: "Boxes2D"}
_LEVELS: Mapping[str, str] = {"INFO": "info", "WARN": "warning", "ERROR": "error"}
_OF_TRACKS = frozenset(
    {"centers", "half_sizes", "track_id", "class_before", "class_ids", "confidence_pct", "origin"}
)
"""The rest is of the layer, once: how it is drawn."""
_HUNDRED = 100
_SAMPLE, _PICTURE, _CAPTION = "VideoStream:sample", "EncodedImage:blob", "Boxes2D:labels"

_Timed = tuple[int, int, Any]
"""Frame index, capture time in nanoseconds, value."""


@dataclass(frozen=True, slots=True)
class RecordedStill:
    """A still as the recording shows it."""

    frame_index: int
    """At which it was known."""
    capture_ns: int
    jpeg: bytes
    base_jpeg: bytes
    """What the base showed of it; empty where the recording does not say."""
    caption: str
    """``17  car → van .93``; empty where it was never on the screen."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """One session, from one file or from several that follow each other."""

    edge: str
    session: str
    video: Sequence[VideoSample]
    """In order of frames."""
    stills: Sequence[RecordedStill]
    notices: Sequence[Notice]
    _layers: Mapping[str, _Layer] = field(repr=False)

    def overlays(self) -> Iterator[Overlay]:
        """What was drawn at each frame that has a picture or at which boxes changed, in order of frames."""
        times: dict[int, int] = {}
        for layer in self._layers.values():
            times |= layer.times()
        times |= {one.frame_index: one.capture_ns for one in self.video}
        for frame in sorted(times):
            yield self._overlay(frame, times[frame])

    def all(self) -> Iterator[VideoSample | Overlay | RecordedStill | Notice]:
        """All of it, in order of frames; of a frame the picture comes first."""
        streams = (self.video, self.overlays(), self.stills, self.notices)
        return heapq.merge(*streams, key=lambda one: one.frame_index)

    def _overlay(self, frame: int, capture_ns: int) -> Overlay:
        rows = sorted(
            (
                (row, path)
                for path, layer in self._layers.items()
                for row in layer.at(frame, reported=path == REPORTED)
            ),
            key=lambda one: one[0].track_id,
        )
        return Overlay(
            frame_index=frame,
            capture_ns=capture_ns,
            track_ids=np.array([row.track_id for row, _ in rows], np.int64),
            boxes_base_px=np.array([row.box for row, _ in rows], np.float32).reshape(-1, 4),
            base_classes=tuple(row.base_class for row, _ in rows),
            classes=tuple(row.class_name for row, _ in rows),
            confidences=np.array([row.confidence for row, _ in rows], np.float32),
            refined=np.array([path in (REFINED, DOUBTED) for _, path in rows], np.bool_),
            origins=tuple(row.origin for row, _ in rows),
            doubted=np.array([path == DOUBTED for _, path in rows], np.bool_),
        )


@dataclass(frozen=True, slots=True)
class _DrawnBox:
    track_id: int
    box: tuple[float, float, float, float]
    base_class: str
    class_name: str
    confidence: float
    origin: Origin


class _Layer:
    """The components of one layer of boxes, each with its rows in order of frames."""

    def __init__(self) -> None:
        self._rows: dict[str, list[_Timed]] = defaultdict(list)
        self._frames: dict[str, list[int]] = {}
        self._names: dict[int, str] = {}

    def add(self, component: str, rows: Iterable[_Timed]) -> None:
        """Take rows of a component; the names of classes hold for all times."""
        name = component.rpartition(":")[2]
        if name == "context":
            for _, _, value in rows:
                for one in value[0]:
                    self._names[one["class_id"]] = one["class_description"]["info"]["label"]
        elif name in _OF_TRACKS:
            self._rows[name] += rows

    def sort(self) -> None:
        """After the last row."""
        for name, rows in self._rows.items():
            rows.sort(key=lambda row: row[0])
            self._frames[name] = [row[0] for row in rows]

    def times(self) -> dict[int, int]:
        """Capture time by frame, where boxes changed."""
        return {frame: capture_ns for rows in self._rows.values() for frame, capture_ns, _ in rows}

    def at(self, frame: int, *, reported: bool) -> Iterator[_DrawnBox]:
        """What is drawn at a frame."""
        ids = self._latest("track_id", frame)
        before, after = self._latest("class_before", frame), self._latest("class_ids", frame)
        percents = self._latest("confidence_pct", frame) or [0] * len(ids)
        origins = self._latest("origin", frame) or [int(reported)] * len(ids)
        places = zip(self._latest("centers", frame), self._latest("half_sizes", frame), strict=False)
        for track, ((x, y), (w, h)), was, now, percent, origin in zip(
            ids, places, before, after, percents, origins, strict=False
        ):
            yield _DrawnBox(
                track,
                (x - w, y - h, x + w, y + h),
                self._names.get(was, "?"),
                self._names.get(now, "?"),
                percent / _HUNDRED,
                ORIGINS[origin] if origin < len(ORIGINS) else "base",
            )

    def _latest(self, name: str, frame: int) -> list[Any]:
        place = bisect_right(self._frames.get(name, []), frame)
        return list(self._rows[name][place - 1][2]) if place else []


def read_recordings(paths: Sequence[Path]) -> Recorded:
    """Read the files of one session; their order does not matter.

    Raises:
        UserError: a file is no recording of hvt-ground, or they are of several sessions.
    """
    files = sorted((_opened(path) for path in paths), key=lambda one: one.first)
    names = {one.name for one in files}
    rows = defaultdict[tuple[str, str], list[_Timed]](list)
    for file in files:
        file.go_on_from(rows)
        for where, found in file.rows.items():
            rows[where] += found
    if len(names) > 1:
        raise UserError(
            f"{', '.join(map(str, paths))} are of {len(names)} sessions: give the files of one session"
        )
    if not all(one.ours for one in files):
        raise UserError(
            f"{', '.join(map(str, paths))}: no recording of one edge: give the files that hvt-ground wrote"
        )
    try:
        return _recorded(*names.pop(), rows)
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise UserError(
            f"{', '.join(map(str, paths))}: not as hvt-ground writes a recording ({type(error).__name__}: {error})"
        ) from None


def _recorded(edge: str, session: str, rows: Mapping[tuple[str, str], list[_Timed]]) -> Recorded:
    layers = {path: _Layer() for path in _LAYERS}
    for (entity, component), found in rows.items():
        if entity in layers:
            layers[entity].add(component, found)
    for layer in layers.values():
        layer.sort()
    return Recorded(
        edge=edge,
        session=session,
        video=_video(rows.get((VIDEO, _SAMPLE), [])),
        stills=_stills(rows),
        notices=_notices(rows),
        _layers=layers,
    )


@dataclass(frozen=True, slots=True)
class _File:
    """One file: its edge and session, and its rows by entity and component."""

    name: tuple[str, str]
    rows: dict[tuple[str, str], list[_Timed]]
    ours: bool
    """It has what a recording of one edge has."""

    @property
    def first(self) -> int:
        """The frame that it begins with."""
        return self._begins[0]

    @property
    def _begins(self) -> tuple[int, int]:
        """That frame, and its capture time; zeros without video."""
        samples = self.rows.get((VIDEO, _SAMPLE))
        return samples[0][:2] if samples else (0, 0)

    def go_on_from(self, before: Mapping[tuple[str, str], list[_Timed]]) -> None:
        """Take what the files before it had into account, if there are any.

        A file that follows another begins with what is on the screen: stills that are known, and boxes of each layer
        that has any. One of a ground that was started again begins with nothing.
        """
        if not before:
            return
        for (entity, component), found in self.rows.items():
            if component == _PICTURE:
                known = {bytes(value) for _, _, value in before.get((entity, component), [])}
                found[:] = [row for row in found if row[0] > self.first or bytes(row[2]) not in known]
        for layer in _LAYERS:
            ids = self.rows.get((layer, "track_id"), [])
            if not any(frame <= self.first for frame, _, _ in ids):
                for (entity, component), found in before.items():
                    if entity == layer and found and component.rpartition(":")[2] in _OF_TRACKS:
                        self.rows.setdefault((entity, component), []).insert(0, (*self._begins, []))


def _opened(path: Path) -> _File:
    try:
        return _read(path)
    except (OSError, RuntimeError, ValueError, LookupError) as error:
        refused = f"{path} is no recording ({error}): give .rrd files of hvt-ground"
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "whole.rrd"
        try:
            if not copy_whole_messages(path, whole):
                raise UserError(refused)
            file = _read(whole)
        except (OSError, RuntimeError, ValueError, LookupError):
            raise UserError(refused) from None
    _log.warning("%s breaks off: what comes before is exported", path)
    return file


def _read(path: Path) -> _File:
    rows = defaultdict[tuple[str, str], list[_Timed]](list)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there is no footer
        reader = RrdReader(path)
    (entry,) = reader.recordings()
    ours = False
    for chunk in reader.stream():
        ours |= chunk.entity_path.startswith("/base/")
        for component, found in _rows(chunk):
            rows[chunk.entity_path, component] += found
    for found in rows.values():
        found.sort(key=lambda row: row[0])
    edge = entry.application_id.removeprefix("hvt-")
    return _File((edge, entry.recording_id.removeprefix(f"{edge}-")), rows, ours=ours)


def _rows(chunk: Chunk) -> Iterator[tuple[str, list[_Timed]]]:
    entity = chunk.entity_path
    batch = chunk.to_record_batch()
    columns = dict(zip(batch.schema.names, batch.columns, strict=True))
    static = [0] * chunk.num_rows
    frames = columns["frame"].to_pylist() if "frame" in columns else static
    captures = columns["capture_time"].cast("int64").to_pylist() if "capture_time" in columns else static
    for one, column in zip(batch.schema, batch.columns, strict=True):
        component = (one.metadata or {}).get(b"rerun:component", b"").decode()
        if not _is_used(entity, component):
            continue
        blobs = component in (_SAMPLE, _PICTURE)
        values = (_bytes(value) for value in column) if blobs else column.to_pylist()
        found = zip(frames, captures, values, strict=True)
        yield component, [row for row in found if row[2] is not None]


def _is_used(entity: str, component: str) -> bool:
    if entity in _LAYERS:
        return component.rpartition(":")[2] in _OF_TRACKS | {"context"}
    if entity.startswith(STILLS):
        return component in (_PICTURE, _CAPTION)
    return component in (_SAMPLE, "TextLog:text", "TextLog:level")


def _bytes(value: Any) -> bytes | None:
    """Of a list with one list of bytes, eight times as large as Python's own; None where it is empty."""
    if not value.is_valid or not len(value.values):
        return None
    return bytes(memoryview(value.values[0].values.to_numpy()))


def _video(rows: Iterable[_Timed]) -> list[VideoSample]:
    samples = {frame: (capture_ns, data) for frame, capture_ns, data in rows}
    return [
        VideoSample(frame, capture_ns, data, keyframe=is_keyframe(data))
        for frame, (capture_ns, data) in sorted(samples.items())
    ]


def _stills(rows: Mapping[tuple[str, str], list[_Timed]]) -> list[RecordedStill]:
    """Pairs of the gallery, and what was never on the screen."""
    found = []
    for (entity, component), pictures in rows.items():
        if component != _PICTURE or not entity.endswith("/still"):
            continue
        slot = entity.removesuffix("/still")
        captions = {frame: value[0] for frame, _, value in rows.get((slot, _CAPTION), []) if value}
        base = rows.get((f"{slot}/base", component), [])
        crops = {frame: data for frame, _, data in base}
        # Off the screen several may come at one frame, and nothing says which base crop is whose.
        several = Counter(frame for frame, _, _ in pictures)
        for frame, capture_ns, jpeg in pictures:
            crop = crops.get(frame, b"") if several[frame] == 1 else b""
            caption = str(captions.get(frame, ""))
            found.append(RecordedStill(frame, capture_ns, jpeg, crop, caption))
    return sorted(found, key=lambda one: (one.frame_index, one.caption))


def _notices(rows: Mapping[tuple[str, str], list[_Timed]]) -> list[Notice]:
    texts, levels = rows.get((EVENTS, "TextLog:text"), []), rows.get((EVENTS, "TextLog:level"), [])
    found = [
        Notice(frame, capture_ns, _LEVELS.get(level[0], "info"), text[0])  # type: ignore[arg-type]
        for (frame, capture_ns, text), (_, _, level) in zip(texts, levels, strict=False)
    ]
    return sorted(found, key=lambda one: one.frame_index)
