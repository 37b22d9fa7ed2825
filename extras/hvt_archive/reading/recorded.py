"""Reads recordings back: the events that the ground logged, as far as the files hold them.

Boxes are as they were drawn: a box is held while it moves by less than a pixel (docs/design-notes/recording.md).
"""

from __future__ import annotations

import logging
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from operator import itemgetter
from pathlib import Path

import numpy as np
from rerun.chunk import Chunk

from hvt_archive.reading.drawn_layer import TRACK_COMPONENTS, DrawnLayer, of_file
from hvt_archive.reading.readable import has_holes, id_of, readable, what_is_read
from hvt_archive.reading.spool import Mapped, Spool, SpooledRows, Timed
from hvt_common.errors import UserError, telling
from hvt_common.files import open_plain
from hvt_common.protocol.messages import READ_VERSIONS, Info, RoiHeader, WireError
from hvt_common.video.hevc import BaseDecoder, is_keyframe
from hvt_ground.events import VEHICLE, Notice, Overlay, PoseUpdate, VideoSample
from hvt_ground.poses import NOWHERE, Locator
from hvt_ground.recordings.row import Recorded, RecordedStill
from hvt_ground.sinks.rerun.blueprint import (
    DOUBTED,
    EVENTS,
    MAP_CAMERA,
    PATCHES,
    REFINED,
    REPORTED,
    SESSION,
    STILL_MESSAGES,
    STILLS,
    TRACKS,
    VIDEO,
)
from hvt_ground.sinks.rerun.map_rows import pose_of
from hvt_ground.sinks.rerun.rrd_file import open_rrd
from hvt_ground.sinks.rerun.sdk import RecordingId
from hvt_ground.sinks.rerun.stills import refined_by_event

_log = logging.getLogger(__name__)

_LAYERS = {TRACKS: "Boxes2D", REPORTED: "Ellipses2D", REFINED: "Boxes2D", DOUBTED: "Boxes2D"}
_LEVELS: Mapping[str, str] = {"INFO": "info", "WARN": "warning", "ERROR": "error"}
_POSE, _INFO, _MESSAGE = "pose", "info", "message"
_ONE_COMPONENT = {MAP_CAMERA: _POSE, SESSION: _INFO, STILL_MESSAGES: _MESSAGE}
"""The components that are read of these entities."""
_SAMPLE, _PICTURE, _CAPTION, _CONTEXT = "VideoStream:sample", "EncodedImage:blob", "Boxes2D:labels", "context"

_ODD = (OSError, RuntimeError, ValueError, LookupError, TypeError, AttributeError, OverflowError)
"""Exceptions from a file that is no recording, or has other values under our names."""

_Rows = dict[tuple[str, str], SpooledRows]
"""By entity and component."""


@dataclass(frozen=True)
class _Read(Recorded):
    _layers: Mapping[str, DrawnLayer] = field(repr=False)
    _samples: SpooledRows = field(repr=False)

    def overlays(self) -> Iterator[Overlay]:
        timed = [*(rows for layer in self._layers.values() for rows in layer.times()), self._samples]
        frames, captures_ns = (
            np.concatenate([np.asarray(column, np.int64) for column in columns])[::-1]
            for columns in zip(*((one.frames, one.captures_ns) for one in timed), strict=True)
        )
        # Of one frame the last word holds, and that of a picture before others.
        found, places = np.unique(frames, return_index=True)
        for frame, capture_ns in zip(found, captures_ns[places], strict=True):
            yield self._overlay(int(frame), int(capture_ns))

    def _overlay(self, frame: int, capture_ns: int) -> Overlay:
        rows = sorted(
            (
                (*row, path)
                for path, layer in self._layers.items()
                for row in layer.at(frame, reported=path == REPORTED)
            ),
            key=itemgetter(0),
        )
        columns = zip(*rows, strict=True) if rows else iter(((),) * 8)
        ids, boxes, base_classes, classes, words, confidences, origins, paths = columns
        overlay = Overlay(
            frame_index=frame,
            capture_ns=capture_ns,
            track_ids=np.array(ids, np.int64),
            boxes_base_px=np.array(boxes, np.float32).reshape(-1, 4),
            base_classes=base_classes,
            classes=classes,
            confidences=np.array(confidences, np.float32),
            refined=np.array([self._is_refined(one, path, frame) for one, *_, path in rows], np.bool_),
            origins=origins,
            doubted=np.array([path == DOUBTED for path in paths], np.bool_),
            vague=np.array(
                [word == VEHICLE != name for word, name in zip(words, classes, strict=True)], np.bool_
            ),
        )
        return self._located(overlay)

    def _is_refined(self, track_id: int, path: str, frame: int) -> bool:
        # Stills may doubt a track, or the ground its whole view: then no still of it was shown.
        return path == REFINED or (path == DOUBTED and self._read_from.get(track_id, frame) < frame)

    @cached_property
    def _read_from(self) -> Mapping[int, int]:
        # By track, the frame of its first still: of every object in each still there is an event.
        first: dict[int, int] = {}
        for one in self.notices:
            if (track := refined_by_event(one.text)) is not None:
                first.setdefault(track, one.frame_index)
        return first

    def _located(self, overlay: Overlay) -> Overlay:
        pose = self.trail.at(overlay.capture_ns)
        if pose is None:
            return overlay
        places = self.locator.places(pose, overlay.boxes_base_px, self.poses[0].view)
        return replace(overlay, places=places)


def read_recordings(paths: Sequence[Path], *, locator: Locator = NOWHERE) -> Recorded:
    """Read the files of one session; their order does not matter.

    Raises:
        UserError: a file is no recording of hvt-ground, or they are of several sessions.
    """
    spool = Spool()
    named = {path.resolve(): path for path in paths}.values()  # one that is named twice is read once
    files = sorted((_file(path, spool, at) for at, path in enumerate(named)), key=lambda one: one.first)
    rows: _Rows = {}
    for file in files:
        file.go_on_from(rows)
        for where, found in file.rows.items():
            if (before := rows.setdefault(where, found)) is not found:
                before.extend(found)
    all_paths, names = ", ".join(map(str, paths)), {one.whose for one in files}
    if len(names) > 1:
        raise UserError(f"{all_paths} are of {len(names)} sessions: give the files of one session")
    if not all(one.ours for one in files):
        raise UserError(f"{all_paths}: no recording of one edge: give the files that hvt-ground wrote")
    try:
        return _recorded(names.pop(), rows, locator, spool)
    except _ODD as error:
        raise UserError(
            f"{all_paths}: not as hvt-ground writes a recording ({type(error).__name__}: {error})"
        ) from None


@contextmanager
def readable_part(path: Path, *, done: str) -> Iterator[tuple[Path, bool]]:
    """The readable part of a recording, as a file, and whether it is all; else the log has that it is ``done``.

    Raises:
        UserError: it cannot be read, or is no recording.
    """
    with telling(f"recording {path} cannot be read (", "): give .rrd files of hvt-ground"):
        open_plain(path).close()
    with tempfile.TemporaryDirectory() as folder:
        try:
            (name := Path(folder) / "named.rrd").symlink_to(path.absolute())  # Rerun takes UTF-8 alone
            found = readable(name, Path(folder) / "readable.rrd")
            if found is None:
                raise ValueError("nothing in it can be read")
            yield found, found == name
        except _ODD as error:
            raise UserError(f"{path} is no recording ({error}): give .rrd files of hvt-ground") from None
    if found != name:
        _log.warning("%s %s is %s", path, what_is_read(path), done)


def _recorded(whose: RecordingId, rows: _Rows, locator: Locator, spool: Spool) -> Recorded:
    layers = {path: DrawnLayer() for path in _LAYERS}
    for (entity, component), found in rows.items():
        if entity in layers:
            layers[entity].add(component, found)
    samples = rows.get((VIDEO, _SAMPLE), SpooledRows(spool, blobs=True))
    samples.sort(unique=True)
    return _Read(
        edge=whose.edge,
        session=whose.session,
        info=_info(rows.get((SESSION, _INFO), ())),
        video=Mapped(samples, _sample),
        stills=_stills(rows),
        notices=_notices(rows),
        poses=_poses(rows),
        locator=locator,
        _layers=layers,
        _samples=samples,
    )


@dataclass(frozen=True, slots=True)
class _File:
    whose: RecordingId
    rows: _Rows
    ours: bool
    """It has the entities of a recording of one edge."""

    @property
    def first(self) -> int:
        return self._begins[0]

    @property
    def _begins(self) -> tuple[int, int]:
        # The first frame, and its capture time; zeros without video.
        samples = self.rows.get((VIDEO, _SAMPLE))
        return samples[0][:2] if samples else (0, 0)

    def go_on_from(self, before: _Rows) -> None:
        """Take the rows of the files before it into account, if there are any.

        A file that follows another begins with the present screen: stills that are known, and boxes of each layer
        that has any. One of a ground that was started again begins with nothing.
        """
        if not before:
            return
        for where, found in self.rows.items():
            if where[1] == _PICTURE:
                known = {hash(value) for _, _, value in before.get(where, ())}
                found.keep(partial(self._is_new, found, known))
        for layer in _LAYERS:
            ids = self.rows.get((layer, "track_id"))
            if ids is None or all(frame > self.first for frame in ids.frames):
                for where, former in before.items():
                    if where[0] == layer and former and not where[1].endswith(_CONTEXT):
                        self.rows[where] = former.begun(*self._begins, [], then=self.rows.get(where))

    def drop_after_holes(self) -> int:
        """Take out samples after lost ones, up to the next keyframe; how many."""
        samples = self.rows.get((VIDEO, _SAMPLE))
        if samples is None:
            return 0
        decoder, stays = BaseDecoder(), list[bool]()
        for place in range(len(samples)):
            unit = samples.value(place)
            if is_keyframe(unit):
                decoder.reset()
            stays.append(decoder.decode_yuv(unit) is not None)
        samples.keep(stays.__getitem__)
        return stays.count(False)

    def _is_new(self, found: SpooledRows, known: set[int], place: int) -> bool:
        return found.frames[place] > self.first or hash(found.value(place)) not in known


def _file(path: Path, spool: Spool, number: int) -> _File:
    with readable_part(path, done="exported") as (found, whole):
        file = _read(found, spool, number)
        lost = file.drop_after_holes() if not whole and has_holes(path, found) else 0
    if lost:
        _log.warning("%s: %d pictures after a hole are left out: they need one that is lost", path, lost)
    return file


def _read(path: Path, spool: Spool, number: int) -> _File:
    rows: _Rows = {}
    reader = open_rrd(path)
    ours = False
    for chunk in reader.stream():
        ours |= chunk.entity_path.startswith("/base/")
        for component, found in _rows(chunk):
            where = chunk.entity_path, component
            spooled = rows.setdefault(where, SpooledRows(spool, blobs=component in (_SAMPLE, _PICTURE)))
            for row in found:
                spooled.add(*of_file(row, component, number=number))
    for (_, component), everything in rows.items():
        everything.sort(unique=component == _SAMPLE)
    return _File(id_of(reader), rows, ours=ours)


def _rows(chunk: Chunk) -> Iterator[tuple[str, list[Timed]]]:
    batch = chunk.to_record_batch()
    columns = dict(zip(batch.schema.names, batch.columns, strict=True))
    static = [0] * chunk.num_rows
    frames = columns["frame"].to_pylist() if "frame" in columns else static
    captures = columns["capture_time"].cast("int64").to_pylist() if "capture_time" in columns else static
    for one, column in zip(batch.schema, batch.columns, strict=True):
        component = (one.metadata or {}).get(b"rerun:component", b"").decode()
        if not _is_used(chunk.entity_path, component):
            continue
        if component in (_SAMPLE, _PICTURE):  # of a list of bytes they are an eighth of Python's own
            values = [
                bytes(memoryview(one.values[0].values.to_numpy()))
                if one.is_valid and len(one.values)
                else None
                for one in column
            ]
        else:
            values = column.to_pylist()
        found = zip(frames, captures, values, strict=True)
        yield component, [row for row in found if row[2] is not None]


def _is_used(entity: str, component: str) -> bool:
    if entity in _LAYERS:
        return component.rpartition(":")[2] in TRACK_COMPONENTS | {_CONTEXT}
    if entity in _ONE_COMPONENT:
        return component == _ONE_COMPONENT[entity]
    if entity.startswith((STILLS, PATCHES)):
        return component in (_PICTURE, _CAPTION)
    return component in (_SAMPLE, "TextLog:text", "TextLog:level")


def _sample(row: Timed) -> VideoSample:
    frame, capture_ns, data = row
    return VideoSample(frame, capture_ns, data, keyframe=is_keyframe(data))


@dataclass(frozen=True, slots=True)
class _StillPlace:
    frame: int
    picture: tuple[SpooledRows, int]
    base: tuple[SpooledRows, int] | None
    caption: str
    header: RoiHeader | None

    def read(self) -> RecordedStill:
        rows, place = self.picture
        frame, capture_ns, jpeg = rows[place]
        base = b"" if self.base is None else self.base[0].value(self.base[1])
        return RecordedStill(frame, capture_ns, jpeg, base, self.caption, self.header)


def _stills(rows: _Rows) -> Sequence[RecordedStill]:
    headers = _Headers(rows.get((STILL_MESSAGES, _MESSAGE), ()))
    found, there = [], set[tuple[int, int]]()
    of_pictures = {
        entity: pictures for (entity, component), pictures in rows.items() if component == _PICTURE
    }
    for entity, pictures in of_pictures.items():
        slot, _, which = entity.rpartition("/")
        if which != "still":
            continue
        captions = {frame: value[0] for frame, _, value in rows.get((slot, _CAPTION), ()) if value}
        base = of_pictures.get(f"{slot}/base")
        crops = {} if base is None else {frame: (base, at) for at, frame in enumerate(base.frames)}
        # A power cut may leave the append log behind the chunks that say the same: each picture counts once.
        places = {(frame, hash(jpeg)): place for place, (frame, _, jpeg) in enumerate(pictures)}
        # Off the screen several may come at one frame, and nothing says which base crop is whose.
        several = Counter(frame for frame, _ in places)
        for (frame, _), place in places.items():
            crop = crops.get(frame) if several[frame] == 1 else None
            caption, header = str(captions.get(frame, "")), headers.of(pictures.value(place), frame=frame)
            found.append(_StillPlace(frame, (pictures, place), crop, caption, header))
        there |= places.keys()
    for pictures in (one for entity, one in of_pictures.items() if entity.startswith(PATCHES)):
        for place, (frame, _, jpeg) in enumerate(pictures):
            header = headers.of(jpeg, frame=frame)
            if header is not None and (frame, hash(jpeg)) not in there:
                found.append(_StillPlace(frame, (pictures, place), None, "", header))
                there.add((frame, hash(jpeg)))
    return Mapped(sorted(found, key=lambda one: (one.frame, one.caption)), _StillPlace.read)


class _Headers:
    def __init__(self, rows: Iterable[Timed]) -> None:
        self._by_frame = defaultdict[int, list[bytes]](list)
        for frame, _, value in rows:
            self._by_frame[frame].append(bytes(value[0]))

    def of(self, jpeg: bytes, *, frame: int) -> RoiHeader | None:
        """The one whose checksum covers this picture; None without one."""
        for message in self._by_frame.get(frame, []):
            with suppress(WireError):
                return RoiHeader.parse(message, jpeg, versions=READ_VERSIONS)
        return None


def _info(rows: Iterable[Timed]) -> Info | None:
    for _, _, value in rows:
        with suppress(WireError):
            return Info.parse(bytes(value[0]), versions=READ_VERSIONS)
    return None


def _poses(rows: _Rows) -> list[PoseUpdate]:
    found = [
        pose_of(numbers, frame_index=frame, capture_ns=capture_ns)
        for frame, capture_ns, numbers in rows.get((MAP_CAMERA, _POSE), ())
    ]
    return sorted(found, key=lambda one: (one.frame_index, one.capture_ns))


def _notices(rows: _Rows) -> list[Notice]:
    texts, levels = rows.get((EVENTS, "TextLog:text"), ()), rows.get((EVENTS, "TextLog:level"), ())
    found = [
        Notice(frame, capture_ns, _LEVELS.get(level[0], "info"), text[0])  # type: ignore[arg-type]
        for (frame, capture_ns, text), (_, _, level) in zip(texts, levels, strict=False)
    ]
    return sorted(found, key=lambda one: one.frame_index)
