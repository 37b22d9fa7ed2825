"""Writes the events of a stream as one Rerun recording, and shows them live.

Everything is timed by two timelines, ``frame`` (sequence) and ``capture_time`` (timestamp). See docs/recording.md for
the entities and for the ways in which the file stays small.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import rerun.blueprint as rrb
from rerun.chunk import Chunk

from hvt_common.protocol.messages import Info
from hvt_common.units import bitrate_text
from hvt_common.video.hevc import parameter_sets
from hvt_ground.events import Event, FrameEvent, Notice, Overlay, PoseUpdate, Refinement, Traffic, VideoSample
from hvt_ground.sinks.palette import AMBER, GREY, VERMILLION, Rgb
from hvt_ground.sinks.queued import SinkWriter, is_stored
from hvt_ground.sinks.rerun import blueprint as names
from hvt_ground.sinks.rerun.blueprint import session_chunk, static_chunks
from hvt_ground.sinks.rerun.live_view import LiveRecording
from hvt_ground.sinks.rerun.map_rows import MapRows, pose_numbers
from hvt_ground.sinks.rerun.overlays import (
    BRIGHTNESS,
    LAYERS,
    BacklogOverlays,
    Identity,
    Layer,
    LayerUpdate,
    OverlayEncoder,
)
from hvt_ground.sinks.rerun.rrd_file import RecordingFile, RrdFile
from hvt_ground.sinks.rerun.sdk import RecordingId
from hvt_ground.sinks.rerun.stills import StillRows
from hvt_ground.sinks.rerun.tables import CodedIdentity, LogText, SizeLimit, TableRow

ON_DEMAND = "asked"
"""The reason of a still that somebody asked for: its track is chosen."""
_PLOT_GAP_NS = 2_500_000_000
"""Plots have a hole where nothing was measured for longer."""
_POSE_BYTES = 90
_BYTES_EACH = {"boxes": 6, "identity": 2, "places": 4, "words": 5}
"""About the component's cost for a track; others cost little more than their row."""
MOST_CLASSES = 256
"""Names of classes in a recording; more are `OTHER`. A new name is written with all before it, and an edge may name
thousands."""
OTHER = "other"
_MOMENTARY = ("video", "text", "lines", "jpeg", "message", "pose", "map points")
"""Tables whose values hold for one frame: a file that begins later does not begin with them."""
_NOTICES: dict[str, tuple[str, Rgb]] = {
    "info": ("INFO", GREY),
    "warning": ("WARN", AMBER),
    "error": ("ERROR", VERMILLION),
}


@dataclass(frozen=True, slots=True)
class RecorderSettings:
    """The subject of a recording, and where it goes."""

    path: Path | None
    """The file; None shows it live only."""
    edge_id: str
    session: str
    """The edge's session id, hexadecimal."""
    base_size: tuple[int, int]
    """(width, height) of the base stream in pixels."""
    fps: float
    budget_bps: float
    facts: Mapping[str, str] = field(default_factory=dict)
    """Further lines of the session panel: ``{"method": "M5", "source": "clip.mp4"}``."""
    info: bytes = b""
    """The edge's `Info` as a message: with it the recording can be received again. Empty leaves it out."""
    clocked: bool = True
    """Whether latencies will be known; False leaves their plot out."""
    live_url: str | None = None
    """Where a viewer listens (`LiveView.url`) that shows it in place of a file."""
    compact_bytes: int = 3 << 19
    """Payload of the append log at which it is compacted: that costs some 50 kB, and this much is in memory."""

    @classmethod
    def of(cls, info: Info, path: Path | None, **more: Any) -> Self:
        """Those of a session."""
        given: dict[str, Any] = {"info": info.pack(), "clocked": info.pace == "realtime", **more}
        session = f"{info.session_id:08x}"
        return cls(path, info.edge, session, info.base_size, info.fps, info.budget_bps, **given)


class Recorder(SinkWriter[Event]):
    """Records the events of one edge's session. Several may run in one process, each in one thread.

    When `log` returns, the event is in the file: killing the process loses nothing that was logged. Raises
    `UserError` where the file cannot be created or, later, written any further, or where the viewer is gone.
    """

    def __init__(self, settings: RecorderSettings) -> None:
        self._overlays = OverlayEncoder(settings.base_size)
        self._backlog_overlays = BacklogOverlays(settings.base_size, fps=settings.fps)
        self._size_limit = SizeLimit()
        self._stills = StillRows(self._size_limit)
        self._map = MapRows()
        self._located = False
        """Whether there was ever a pose."""
        self._class_ids: dict[tuple[str, int], int] = {}
        """By name and level of brightness; of all files, which may be opened together."""
        self._class_names: set[str] = {OTHER}
        self._shown: dict[tuple[str, str], TableRow] = {}
        """The screen: the newest row of each table whose values hold until the next."""
        self._last_sample: int | None = None
        self._awaits_keyframe = False
        """Whether live video begins anew at its next keyframe. Lost stored objects come again."""
        self._skipped = 0
        self._settings = settings
        self._traffic_end: tuple[int, int] | None = None
        """Where the plots would end, had no more come."""
        self.file = self._into = self.open_file(settings.path)
        self.path = settings.path

    @property
    def size_bytes(self) -> int:
        """The size of the file so far; 0 without one."""
        return self.file.size_bytes

    def log(self, item: Event, *, into: RecordingFile | None = None) -> None:
        """Record an event. An access unit that no decoder could use at its place is left out.

        An event that was ``stored`` may lie before logged ones: its caller vouches for its place. It may go
        ``into`` another file (`open_file`).
        """
        self._into = file = into or self.file
        if file.closed or not isinstance(item, FrameEvent):
            return
        at = item.frame_index, item.capture_ns
        rows = [
            one if isinstance(one, Chunk) else replace(one, at=one.at or at)
            for one in (*self._gap_rows(item), *self._rows(item))
        ]
        file.write(rows)
        if self.path is not None and not (isinstance(item, Overlay) and item.stored):
            for row in rows:
                if not isinstance(row, Chunk):
                    self._note_shown(row)

    def open_file(self, path: Path | None) -> RecordingFile:
        """Another file of the session, or its viewer: opened together they are shown as one.

        Its caller closes it, but for `file`.
        """
        settings = self._settings
        screen = self._screen(path)
        chunks = static_chunks(
            settings.edge_id, _facts(settings, f"up to {settings.fps:g} fps"), info=settings.info
        )
        recording_id = RecordingId(settings.edge_id, settings.session)
        output: RrdFile | LiveRecording
        if path is not None:
            output = RrdFile(path, recording_id, screen, chunks)
        else:
            assert settings.live_url is not None, "a recording goes into a file or a viewer"
            output = LiveRecording(settings.live_url, recording_id, screen, chunks)
        return RecordingFile(output, size_limit=self._size_limit, compact_bytes=settings.compact_bytes)

    def _screen(self, path: Path | None) -> rrb.Blueprint:
        settings = self._settings
        return names.screen(
            base_size=settings.base_size,
            fps=settings.fps,
            budget_bps=settings.budget_bps,
            clocked=settings.clocked,
            live=path is None,
            located=self._located,
        )

    def begins_with(self, item: Event) -> bool:
        """Whether a file may begin with this: a live keyframe that a decoder can start at."""
        return (
            isinstance(item, VideoSample)
            and item.keyframe
            and not item.stored
            and self._decodable(item)
            and bool(parameter_sets(item.data))
        )

    def go_on_in(self, file: RecordingFile, *, at: tuple[int, int]) -> None:
        """Write into ``file`` from now on, which begins ``at`` (frame and capture time) with the present screen.

        The former one is left open, for `close_file`.
        """
        self.file = self._into = file
        self.path = file.path
        cost = self._size_limit.logged_bytes
        contexts = [one for layer in LAYERS for one in self._new_classes(layer)]
        # Rows of a later time are in there already.
        shown = [replace(row, at=at) for row in self._shown.values() if row.at is not None and row.at < at]
        file.write([*contexts, *shown])
        self._size_limit.logged_bytes = cost  # the price of another file is not the stills'

    def close_file(self, file: RecordingFile, hurry: threading.Event | None = None) -> None:
        """Compact the rest of a file and close it; a second call does nothing.

        Once ``hurry`` is set no footer is added, which may take seconds.
        """
        if file.closed:
            return
        came = None
        if file.samples:  # fewer frames may have come than the edge planned
            settings = self._settings
            rate = file.samples / (file.last_sample - file.first_sample + 1) * settings.fps
            frames = f"{rate:.3g} of {settings.fps:g} fps came"
            came = session_chunk(settings.edge_id, _facts(settings, frames))
        file.close(hurry, session=came)

    def skipped(self, count: int) -> None:
        """Video goes on at its next keyframe, and the log names the loss."""
        self._skipped += count
        self._awaits_keyframe = True

    def close(self, hurry: threading.Event | None = None) -> None:
        self.close_file(self.file, hurry)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _note_shown(self, row: TableRow) -> None:
        # Stored stills lie before others, and may be shown all the same.
        if row.columns in _MOMENTARY or row.at is None:
            return
        if row.columns == "place":  # moves the patch there
            patch = self._shown.get((row.path, "patch"))
            if patch is not None and patch.value is not None:
                moved = replace(patch.value, place=row.value)
                self._shown[row.path, "patch"] = replace(patch, value=moved)
            return
        before = self._shown.get((row.path, row.columns))
        if before is None or before.at is None or before.at <= row.at:
            self._shown[row.path, row.columns] = row

    # The rows of each event

    def _gap_rows(self, event: FrameEvent) -> list[TableRow]:
        if not self._skipped or is_stored(event):
            return []
        text, self._skipped = f"{self._skipped} events are missing here: writing was too slow", 0
        return [TableRow(names.EVENTS, "text", LogText(text, "WARN", AMBER), len(text))]

    def _rows(self, event: FrameEvent) -> Iterable[TableRow | Chunk]:
        match event:
            case VideoSample():
                return self._sample(event)
            case Overlay():
                return self._backlog_overlay(event) if event.stored else self._overlay(event)
            case Refinement():
                return self._refinement(event)
            case Traffic():
                return self._traffic(event)
            case PoseUpdate():
                return self._pose(event)
            case Notice():
                text = LogText(event.text, *_NOTICES[event.level])
                return [TableRow(names.EVENTS, "text", text, len(event.text))]

    def _pose(self, update: PoseUpdate) -> list[TableRow]:
        if not self._located:
            self._located = True
            self._into.show(self._screen(self._into.path))
        return [TableRow(names.MAP_CAMERA, "pose", pose_numbers(update), _POSE_BYTES)]

    def _sample(self, sample: VideoSample) -> list[TableRow]:
        if not sample.stored and not self._goes_on(sample):
            return []
        size = len(sample.data)
        self._size_limit.received_bytes += size
        self._into.count(sample.frame_index, stored=sample.stored)
        if sample.stored:
            self._backlog_overlays.earn(size)
        else:
            self._last_sample = sample.frame_index
            self._overlays.earn(size)
        return [TableRow(names.VIDEO, "video", sample.data, size)]

    def _goes_on(self, sample: VideoSample) -> bool:
        if sample.keyframe:
            self._awaits_keyframe = False
        return not self._awaits_keyframe and self._decodable(sample)

    def _decodable(self, sample: VideoSample) -> bool:
        # Rerun shows garbage for undecodable units, so begin at a keyframe and never go back.
        if self._last_sample is None:
            return sample.keyframe and bool(parameter_sets(sample.data))
        return sample.frame_index > self._last_sample and bool(sample.data)

    def _overlay(self, overlay: Overlay) -> list[TableRow | Chunk]:
        rows: list[TableRow | Chunk] = [*self._stills.overlay(overlay), *self._map.overlay(overlay)]
        for update in self._overlays.encode(overlay):
            rows += self._layer(update, at=(overlay.frame_index, overlay.capture_ns))
        self._backlog_overlays.note(overlay, self._overlays)
        return rows

    def _backlog_overlay(self, overlay: Overlay) -> list[TableRow | Chunk]:
        # Patches stay away: they ride on tracks of now.
        timed = self._backlog_overlays.encode(overlay)
        return [
            row for frame, capture_ns, update in timed for row in self._layer(update, at=(frame, capture_ns))
        ]

    def _layer(self, update: LayerUpdate, *, at: tuple[int, int]) -> list[TableRow | Chunk]:
        path = names.BASE + update.layer
        rows: list[TableRow | Chunk] = []
        shape = "ellipses" if update.layer == "reported" else "boxes"
        for name, component in update.components.items():
            columns, value, count = name, component, 32
            if name in ("boxes", "places", "words"):
                columns, count = shape if name == "boxes" else name, len(component)
            elif name == "inks":
                value = tuple(self._class_id(*ink) for ink in component)
            elif name == "identity":
                columns, count = f"identity of {shape}", len(component.track_ids)
                value = self._coded(component)
            if name in ("inks", "identity"):
                rows += self._new_classes(update.layer)
            rows.append(TableRow(path, columns, value, _BYTES_EACH.get(name, 2) * count, at))
        return rows

    def _coded(self, identity: Identity) -> CodedIdentity:
        before, now = (
            tuple(self._class_id(name, len(BRIGHTNESS) - 1) for name in names)
            for names in (identity.classes_before, identity.classes_now)
        )
        shown = zip(identity.words, identity.levels, strict=True)
        return CodedIdentity(identity.track_ids, before, now, tuple(self._class_id(*one) for one in shown))

    def _class_id(self, name: str, level: int) -> int:
        if len(self._class_names) < MOST_CLASSES:
            self._class_names.add(name)
        known = name if name in self._class_names else OTHER
        return self._class_ids.setdefault((known, level), len(self._class_ids))

    def _new_classes(self, layer: Layer) -> list[Chunk]:
        size = self._settings.base_size
        return self._into.new_classes(layer, names.BASE + layer, self._class_ids, size=size)

    def _refinement(self, refinement: Refinement) -> list[TableRow]:
        if refinement.reason == ON_DEMAND and refinement.track_id is not None:
            self._overlays.choose(refinement.track_id)
        before = self._size_limit.received_bytes
        rows = self._stills.refinement(refinement)
        self._overlays.earn(self._size_limit.received_bytes - before)
        return rows

    def _traffic(self, traffic: Traffic) -> list[TableRow]:
        rates = (traffic.total_bps, traffic.base_bps, traffic.roi_bps, traffic.budget_bps)
        latencies = (traffic.receive_latency_ms, traffic.overlay_latency_ms)
        plots = {
            names.BITRATE: tuple(bps / 1000 for bps in rates),
            names.TRACK_COUNT: (float(traffic.tracks), float(traffic.tracks_refined)),
        }
        if any(latency is not None for latency in latencies):
            plots[names.LATENCY] = tuple(np.nan if latency is None else latency for latency in latencies)
        rows = [TableRow(path, "lines", values) for path, values in plots.items()]
        end, after_ns = self._traffic_end, traffic.capture_ns + _PLOT_GAP_NS
        self._traffic_end = traffic.frame_index + 1, after_ns
        if end is None or end[1] >= traffic.capture_ns or end[0] >= traffic.frame_index:
            return rows
        # A line through the outage would say that something came.
        return [
            *(TableRow(path, "lines", (np.nan,) * len(values), at=end) for path, values in plots.items()),
            *rows,
        ]


def _facts(settings: RecorderSettings, frames: str) -> dict[str, str]:
    width, height = settings.base_size
    return {
        "session": settings.session,
        "base": f"{width}x{height} HEVC, {frames}",
        "budget": bitrate_text(settings.budget_bps),
        **settings.facts,
    }
