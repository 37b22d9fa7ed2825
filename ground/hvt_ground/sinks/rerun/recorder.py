"""Writes what the ground makes of a stream as one Rerun recording, and shows it live.

Everything is timed by two timelines, ``frame`` (sequence) and ``capture_time`` (timestamp). See docs/recording.md for
the entities and for what keeps the file small.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from rerun.chunk import Chunk

from hvt_common.units import bitrate_text
from hvt_ground.events import Event, FrameEvent, Notice, Overlay, Refinement, Traffic, VideoSample
from hvt_ground.sinks.rerun import blueprint as names
from hvt_ground.sinks.rerun.backlog_overlays import BacklogOverlays
from hvt_ground.sinks.rerun.blueprint import Front
from hvt_ground.sinks.rerun.live_view import LiveSink
from hvt_ground.sinks.rerun.overlay_encoding import LAYERS, Identity, Layer, LayerUpdate, OverlayEncoder
from hvt_ground.sinks.rerun.palette import AMBER, GREY, VERMILLION, Rgb
from hvt_ground.sinks.rerun.rrd_file import RrdEncoder, RrdFile, add_footer
from hvt_ground.sinks.rerun.static_data import class_chunk, static_chunks
from hvt_ground.sinks.rerun.stills import RowTime, StillRows, TableRow
from hvt_ground.sinks.rerun.tables import (
    TABLE_BYTES,
    CodedIdentity,
    LogText,
    SizeLimit,
    Table,
    box_columns,
    confidence_columns,
    identity_columns,
    label_columns,
    line_columns,
    origin_columns,
    reported_columns,
    reported_identity_columns,
    text_columns,
    video_columns,
)

__all__ = ["APPLICATION_ID", "COMPACT_BYTES", "Recorder", "RecorderSettings"]

log = logging.getLogger(__name__)

APPLICATION_ID = "hvt"
COMPACT_BYTES = 3 << 19
"""Payload of the append log at which it is compacted: a compaction costs some 50 kB, and this much is in memory."""

DIMMED = 0.75
"""Brightness of the boxes that no still has spoken on, beside those one has."""

_LAYER_PATHS: dict[Layer, str] = {
    "tracks": names.TRACKS,
    "reported": names.REPORTED,
    "refined": names.REFINED,
}
_NOTICE_COLOURS: dict[str, Rgb] = {"info": GREY, "warning": AMBER, "error": VERMILLION}
_NOTICE_LEVELS = {"info": "INFO", "warning": "WARN", "error": "ERROR"}


@dataclass(frozen=True, slots=True)
class RecorderSettings:
    """What a recording is of, and where it goes."""

    path: Path | None
    """The file; None shows without recording."""
    edge_id: str
    session: str
    """The edge's session id, hexadecimal."""
    base_size: tuple[int, int]
    """(width, height) of the base stream in pixels."""
    fps: float
    budget_bps: float
    title: str = ""
    """Heading of the session panel; the edge's id where empty."""
    facts: Mapping[str, str] = field(default_factory=dict)
    """Further lines of the session panel: ``{"method": "M5", "source": "clip.mp4"}``."""
    clocked: bool = True
    """Whether latencies will be known; False leaves their plot out."""
    front: Front = "tracks"
    """The tab of the video that is seen first."""
    live_url: str | None = None
    """Where a viewer listens, from `hvt_ground.sinks.rerun.live_view`; None shows nothing live."""


class Recorder:
    """Records the events of one edge's session. Several may run in one process; `log` may be called by any thread.

    When `log` returns, the event is in the file: killing the process loses nothing that was logged. A live viewer
    that goes away is left behind with one warning.

    Raises:
        UserError: the file cannot be created, or (from `log` and `close`) written any further.
    """

    def __init__(self, settings: RecorderSettings) -> None:
        self._settings = settings
        self._lock = threading.Lock()
        self._overlays = OverlayEncoder()
        self._backlog_overlays = BacklogOverlays(fps=settings.fps)
        self._size_limit = SizeLimit()
        self._stills = StillRows(self._size_limit)
        self._class_ids: dict[str, int] = {}
        self._classes_written: dict[Layer, int] = dict.fromkeys(LAYERS, 0)
        self._contexts: dict[Layer, Chunk] = {}
        self._tables: dict[tuple[str, str], Table[Any]] = {}
        self._pending_bytes = 0
        self._last_sample: int | None = None
        self._closed = False
        self._file = RrdFile(settings.path) if settings.path is not None else None
        recording_id = f"{settings.edge_id}-{settings.session}"
        name = settings.title or settings.edge_id
        self._encoder = RrdEncoder(application_id=APPLICATION_ID, recording_id=recording_id, name=name)
        self._live = (
            LiveSink(settings.live_url, application_id=APPLICATION_ID, recording_id=recording_id, name=name)
            if settings.live_url is not None
            else None
        )
        self._open()

    @property
    def size_bytes(self) -> int:
        """The size of the file so far; 0 without one."""
        if self._file is None:
            return 0
        return self._file.path.stat().st_size if self._closed else self._file.size_bytes

    def log(self, event: Event) -> None:
        """Record an event. An access unit that no decoder could use at its place is left out.

        What was ``stored`` may lie before what was logged already: whoever logs it vouches for its place.
        """
        with self._lock:
            if self._closed:
                return
            match event:
                case VideoSample():
                    chunks = self._sample(event)
                case Overlay():
                    chunks = self._overlay(event)
                case Refinement():
                    chunks = self._refinement(event)
                case Traffic():
                    chunks = self._traffic(event)
                case Notice():
                    chunks = self._notice(event)
                case _:
                    return
            self._write(chunks)

    def close(self, *, quickly: bool = False) -> None:
        """Compact what is left and close the file and the viewer's connection; a second call does nothing.

        ``quickly`` adds no footer, which may take seconds.
        """
        with self._lock:
            if self._closed:
                return
            self._closed = True
            try:
                self._compact()
            finally:
                if self._file is not None:
                    self._file.close()
                    if not quickly:
                        add_footer(self._file.path)
                self._encoder.close()
                if self._live is not None:
                    self._live.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # -- the file ---------------------------------------------------------------------------------------------

    def _open(self) -> None:
        settings = self._settings
        chunks = static_chunks(title=settings.title or settings.edge_id, facts=_facts(settings))
        for sink in (self._encoder, self._live):
            if sink is None:
                continue
            screen = names.screen(
                base_size=settings.base_size,
                fps=settings.fps,
                budget_bps=settings.budget_bps,
                clocked=settings.clocked,
                live=sink is self._live,
                front=settings.front,
            )
            data = sink.blueprint(screen) + sink.chunks(chunks)
            if sink is self._encoder and self._file is not None:
                self._file.compact(self._encoder.header + data)

    def _write(self, chunks: list[Chunk]) -> None:
        if not chunks:
            return
        if self._live is not None:
            self._live.chunks(chunks)
        if self._file is None:
            return
        self._file.append(self._encoder.chunks(chunks))
        if self._pending_bytes >= COMPACT_BYTES:
            self._compact()

    def _compact(self) -> None:
        chunks = [*self._contexts.values()]
        chunks += [chunk for table in self._tables.values() if (chunk := table.take()) is not None]
        self._contexts.clear()
        self._pending_bytes = 0
        if chunks and self._file is not None:
            self._file.compact(self._encoder.chunks(chunks))

    def _row(
        self, path: str, columns: Any, event: FrameEvent | RowTime, value: Any, *, size_bytes: int = 64
    ) -> Chunk:
        """Add a row to the table of this entity and these columns; ``size_bytes``: its cost once compacted, about."""
        key = (path, columns.__name__)
        table = self._tables.get(key)
        if table is None:
            table = self._tables[key] = Table(path, columns)
        if not table:
            self._size_limit.logged_bytes += TABLE_BYTES
        self._pending_bytes += size_bytes
        self._size_limit.logged_bytes += size_bytes
        return table.add(event.frame_index, event.capture_ns, value)

    def _rows(self, rows: Sequence[TableRow], event: FrameEvent) -> list[Chunk]:
        return [
            self._row(row.path, row.columns, row.at or event, row.value, size_bytes=row.size_bytes)
            for row in rows
        ]

    # -- the events -------------------------------------------------------------------------------------------

    def _sample(self, sample: VideoSample) -> list[Chunk]:
        if not sample.stored and not self._decodable(sample):
            log.debug("frame %d left out of the recording: not decodable there", sample.frame_index)
            return []
        size = len(sample.data)
        self._size_limit.received_bytes += size
        if sample.stored:
            self._backlog_overlays.earn(size)
        else:
            self._last_sample = sample.frame_index
            self._overlays.earn(size)
        return [self._row(names.VIDEO, video_columns, sample, sample.data, size_bytes=size)]

    def _decodable(self, sample: VideoSample) -> bool:
        """Rerun shows garbage for what its decoder cannot use, so begin at a keyframe and never go back."""
        if self._last_sample is None:
            return sample.keyframe and _has_parameter_sets(sample.data)
        return sample.frame_index > self._last_sample and bool(sample.data)

    def _overlay(self, overlay: Overlay) -> list[Chunk]:
        if overlay.stored:
            return self._backlog_overlay(overlay)
        chunks = self._rows(self._stills.overlay(overlay), overlay)
        for update in self._overlays.encode(overlay):
            chunks += self._layer(overlay, update)
        self._backlog_overlays.note(overlay, self._overlays)
        return chunks

    def _backlog_overlay(self, overlay: Overlay) -> list[Chunk]:
        """Patches stay away: they ride on tracks of now."""
        chunks = []
        timed = self._backlog_overlays.encode(overlay, with_origins=self._overlays.with_origins)
        for frame_index, capture_ns, update in timed:
            chunks += self._layer(replace(overlay, frame_index=frame_index, capture_ns=capture_ns), update)
        return chunks

    def _layer(self, overlay: Overlay, update: LayerUpdate) -> list[Chunk]:
        path, chunks = _LAYER_PATHS[update.layer], []
        if update.geometry is not None:
            size = 6 * len(update.geometry.centres_px)
            columns = reported_columns if update.layer == "reported" else box_columns
            chunks.append(self._row(path, columns, overlay, update.geometry, size_bytes=size))
        if update.identity is not None:
            chunks += self._identity(overlay, update.layer, update.identity)
        if update.labels is not None:
            size = 5 * len(update.labels)
            chunks.append(self._row(path, label_columns, overlay, update.labels, size_bytes=size))
        if update.confidences_pct is not None:
            chunks.append(self._row(path, confidence_columns, overlay, update.confidences_pct))
        if update.origins is not None:
            chunks.append(self._row(path, origin_columns, overlay, update.origins))
        return chunks

    def _identity(self, overlay: Overlay, layer: Layer, identity: Identity) -> list[Chunk]:
        coded = CodedIdentity(
            track_ids=identity.track_ids,
            before=tuple(self._class_id(name) for name in identity.classes_before),
            after=tuple(self._class_id(name) for name in identity.classes_after),
        )
        chunks = []
        if self._classes_written[layer] != len(self._class_ids):
            self._classes_written[layer] = len(self._class_ids)
            self._contexts[layer] = class_chunk(
                _LAYER_PATHS[layer], self._class_ids, share=1.0 if layer == "refined" else DIMMED
            )
            chunks.append(self._contexts[layer])
        size = 2 * len(identity.track_ids)
        columns = reported_identity_columns if layer == "reported" else identity_columns
        chunks.append(self._row(_LAYER_PATHS[layer], columns, overlay, coded, size_bytes=size))
        return chunks

    def _class_id(self, name: str) -> int:
        return self._class_ids.setdefault(name, len(self._class_ids))

    def _refinement(self, refinement: Refinement) -> list[Chunk]:
        before = self._size_limit.received_bytes
        rows = self._stills.refinement(refinement)
        self._overlays.earn(self._size_limit.received_bytes - before)
        return self._rows(rows, refinement)

    def _traffic(self, traffic: Traffic) -> list[Chunk]:
        rates = (traffic.total_bps, traffic.base_bps, traffic.roi_bps, traffic.budget_bps)
        latencies = (traffic.receive_latency_ms, traffic.overlay_latency_ms)
        chunks = [
            self._row(names.BITRATE, line_columns, traffic, tuple(bps / 1000 for bps in rates)),
            self._row(
                names.TRACK_COUNT,
                line_columns,
                traffic,
                (float(traffic.tracks), float(traffic.tracks_refined)),
            ),
        ]
        if any(latency is not None for latency in latencies):
            values = tuple(np.nan if latency is None else latency for latency in latencies)
            chunks.append(self._row(names.LATENCY, line_columns, traffic, values))
        return chunks

    def _notice(self, notice: Notice) -> list[Chunk]:
        text = LogText(notice.text, _NOTICE_LEVELS[notice.level], _NOTICE_COLOURS[notice.level])
        return [self._row(names.EVENTS, text_columns, notice, text, size_bytes=len(notice.text))]


def _facts(settings: RecorderSettings) -> dict[str, str]:
    width, height = settings.base_size
    return {
        "edge": settings.edge_id,
        "session": settings.session,
        "base": f"{width}x{height} at {settings.fps:g} fps, HEVC",
        "budget": bitrate_text(settings.budget_bps),
        **settings.facts,
    }


def _has_parameter_sets(access_unit: bytes) -> bool:
    """Whether VPS, SPS and PPS (NAL types 32, 33, 34 of H.265 table 7-1) precede the picture in an Annex B unit."""
    kinds = {(unit[0] >> 1) & 0x3F for unit in access_unit.split(b"\x00\x00\x01")[1:] if unit}
    return {32, 33, 34} <= kinds
