"""From settings to objects: what is made for each session of an edge, as one tree."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from itertools import chain
from itertools import count as count_from
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, cast

from hvt_common.errors import UserError, needs_extra
from hvt_common.inference.classify import Classifier
from hvt_common.inference.detect import Detector, detect_every
from hvt_common.protocol.messages import Info
from hvt_common.runtime.reporting import check_writable
from hvt_common.tracking.bytetrack import ByteTracker, TrackerSettings
from hvt_common.transport.inbox import Received
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_common.units import Limit, bitrate_text
from hvt_ground.backlog.perception import BacklogPerception
from hvt_ground.backlog.recordings import BacklogRecording
from hvt_ground.config import DETECTOR, GroundConfig
from hvt_ground.events import Event, Refinement
from hvt_ground.geolocation.surface import FLAT_GROUND, Surface
from hvt_ground.perception.fusion.camera_path import CameraPath
from hvt_ground.perception.fusion.fuse import Fusion, unified_names
from hvt_ground.perception.models import Models, stills_calibrated, track_confidence
from hvt_ground.perception.pipeline import Pipeline, PipelineParts
from hvt_ground.perception.stills.classify import CropReader, NoReader, Redetection, StillReader
from hvt_ground.perception.stills.refine import Refiner
from hvt_ground.perception.stills.vocabulary import Vocabulary
from hvt_ground.recordings.row import RecordingRow
from hvt_ground.recordings.session_files import SessionFiles
from hvt_ground.session.receiver_report import ReceiverReports
from hvt_ground.session.session import GroundSession
from hvt_ground.sinks import Outputs, QueuedSink, Sink, SinkWriter
from hvt_ground.sinks.cot.reporter import SessionReporter, StillAddress
from hvt_ground.sinks.cot.type_table import read_types
from hvt_ground.sinks.message_log import MessageLog
from hvt_ground.sinks.rerun.live_view import LiveView
from hvt_ground.sinks.rerun.recorder import Recorder, RecorderSettings
from hvt_ground.sinks.still_files import StillFiles, picture_of
from hvt_ground.sinks.timing import SessionTiming, timing_table
from hvt_ground.sinks.tracks_table import TrackTable
from hvt_ground.sinks.transport_stream.destination import Addresses, check_destination, destination
from hvt_ground.sinks.transport_stream.stream import live_stream, stream_file
from hvt_ground.sinks.transport_stream.uas import Platform

if TYPE_CHECKING:  # who serves no page needs no web server, nor protobuf who writes no MCAP
    from hvt_ground.sinks.mcap_file import McapFile
    from hvt_ground.web import WebPage

__all__ = [
    "Models",
    "OpenSink",
    "SessionFactory",
    "check_cot",
    "check_outputs",
    "make_backlog_perception",
    "make_link_settings",
    "make_pipeline",
    "make_record_folder",
    "make_surfaces",
    "output_path",
]

S = TypeVar("S", bound=SinkWriter[Any])

OpenSink = Callable[[Info], Callable[[], SinkWriter[Event]]]
"""What opens a sink for a session."""

_LOCKSTEP_WAIT_S = 10.0


class SessionFactory:
    """Makes sessions, and recordings of former ones; each file gets a name of its own. For any thread.

    All that they write to is of ``outputs``; ``view`` is a viewer and ``page`` the page for browsers, None shows
    nothing live; ``index`` learns of the recordings, and ``program`` opens a sink of another program.
    """

    def __init__(
        self,
        config: GroundConfig,
        models: Models,
        *,
        clock: Callable[[], int],
        outputs: Outputs,
        view: LiveView | None,
        page: WebPage | None = None,
        index: Sink[RecordingRow] | None = None,
        program: OpenSink | None = None,
    ) -> None:
        self._config = config
        self._models = models
        self._clock = clock
        self._outputs = outputs
        self._view = view
        self._page = page
        self._index = index
        self._program = program
        self.records = program is None or config.record is not None
        """Whether there are recordings: a program takes their place unless they are asked for."""
        self._paths: set[Path] = set()
        """Taken by this process."""
        self._addresses = Addresses()
        self._naming = threading.Lock()
        if config.mcap is not None:
            _mcap_file()  # that it is there
        self._surface_of = make_surfaces(config.terrain)
        self._cot = _cot(config, outputs)
        self._timing: QueuedSink[str] | None = None
        if config.timing is not None:
            names = partial(_take, [config.timing], number=2, may_exist=config.timing)
            self._timing = outputs.open("timing table", partial(self._opened, timing_table, names))
        self.message_log: Callable[[Received], None] | None = None
        """Takes all that comes from edges."""
        if config.log is not None:
            names = partial(_take, [config.log], number=2, may_exist=config.log)
            make_log = partial(MessageLog, most_bytes=config.log_size)
            self.message_log = outputs.open("message log", partial(self._opened, make_log, names)).log

    def open_session(self, info: Info, reports: ReceiverReports) -> GroundSession:
        """A session with its perception and its sinks."""
        config, models, edge = self._config, self._models, info.edge
        stamp = time.strftime("%Y%m%d-%H%M%S")
        settings = self._recorder_settings(info)
        surface = self._surface_of(edge)
        # In lockstep the edge waits, so that nothing need be lost to a slow disk.
        wait_s = _LOCKSTEP_WAIT_S if info.pace == "lockstep" else 0.0
        sinks: list[Sink[Event]] = []
        if self.records:
            names = partial(output_path, config.record, suffix=".rrd", edge=edge, stamp=stamp)
            open_recording = partial(self._opened, self._files(settings, split=config.split), names)
            part = f"recording of {edge}"
            sinks.append(self._outputs.open(part, open_recording, wait_s=wait_s, for_backlog=True))
        if self._program is not None:
            part, opens = f"program of {edge}", self._program(info)
            sinks.append(self._outputs.open(part, opens, wait_s=wait_s, for_backlog=not self.records))
        if self._view is not None:
            open_live = partial(_live_recorder, settings, self._view)
            sinks.append(self._outputs.open(f"live view of {edge}", open_live))
        if self._page is not None:
            sinks.append(self._outputs.open(f"web page of {edge}", self._page.feed(info)))
        files: dict[str, QueuedSink[Event]] = {}
        for target, what, suffix, make in (
            (config.tracks, "tracks table", ".csv", TrackTable),
            (config.mcap, "MCAP file", ".mcap", lambda path: _mcap_file()(path, edge=edge)),
            (config.stills, "stills", ".csv", StillFiles),
        ):
            if target is not None:
                names = partial(output_path, target, suffix=suffix, edge=edge, stamp=stamp)
                open_file = partial(self._opened, make, names)
                files[what] = self._outputs.open(f"{what} of {edge}", open_file, wait_s=wait_s)
        sinks += files.values()
        if config.ts is not None:
            opens_stream = self._transport_stream(info, config.ts, stamp=stamp, surface=surface)
            sinks.append(self._outputs.open(f"MPEG-TS of {edge}", opens_stream, wait_s=wait_s))
        if self._cot is not None:
            address = self._still_address(info, files.get("stills"))
            open_reporter = partial(self._cot, info, clock=self._clock, still_address=address)
            sinks.append(self._outputs.open(f"CoT of {edge}", open_reporter))
        if self._timing is not None:
            sinks.append(SessionTiming(self._timing, edge=edge, session_id=info.session_id))
        return GroundSession(
            info,
            sinks=sinks,
            pipeline_of=lambda emit: make_pipeline(config, models, info=info, emit=emit),
            clock=self._clock,
            reports=reports,
            backlog_perception=make_backlog_perception(config, models, info=info),
            surface=surface,
        )

    def open_backlog(self, info: Info) -> BacklogRecording:
        """The recording of a session that is over; not shown live, for the viewer shows what is now."""
        settings = replace(self._recorder_settings(info), clocked=False)
        stamp = time.strftime("%Y%m%d-%H%M%S")
        names = partial(_backlog_path, self._config.record, edge=info.edge, stamp=stamp)
        part = f"backlog recording of {info.edge}"
        sink = self._outputs.open(part, partial(self._opened, self._files(settings, backlog=True), names))
        perception = make_backlog_perception(self._config, self._models, info=info)
        return BacklogRecording(info, sink=sink, perception=perception)

    def _transport_stream(
        self, info: Info, target: str, *, stamp: str, surface: Surface
    ) -> Callable[[], SinkWriter[Event]]:
        platform = Platform(info.edge, f"{info.session_id:016x}", info.view, surface)
        where = destination(target)
        if isinstance(where, Path):
            make = partial(stream_file, platform=platform, fps=info.fps)
            names = partial(output_path, where, suffix=".ts", edge=info.edge, stamp=stamp)
            return partial(self._opened, make, names)
        address = where.of_edge(info.edge)
        return partial(live_stream, address, platform=platform, fps=info.fps, addresses=self._addresses)

    def _still_address(self, info: Info, files: QueuedSink[Event] | None) -> StillAddress:
        """Where the picture of a still is: on the page, else in the folder of ``--stills``, else nowhere."""
        page = self._page

        def address(still: Refinement) -> str:
            if page is not None:
                return page.still_address(info, still)
            if files is None or not files.files or still.still_bgr is None or still.crop_base_px is None:
                return ""
            return str(picture_of(still, files.files[-1].resolve()))

        return address

    def _files(
        self, settings: RecorderSettings, *, split: Limit | None = None, backlog: bool = False
    ) -> Callable[[Path], SessionFiles]:
        return lambda path: SessionFiles(
            replace(settings, path=path), split=split, index=self._index, backlog=backlog
        )

    def _opened(self, make: Callable[[Path], S], name: Callable[..., Path]) -> S:
        """A sink with a file; a name that could not be used is free again."""
        with self._naming:
            path = name(taken=self._paths)
        with ExitStack() as undo:
            undo.callback(self._paths.discard, path)
            sink = make(path)
            undo.pop_all()
        return sink

    def _recorder_settings(self, info: Info) -> RecorderSettings:
        config = self._config
        return RecorderSettings(
            path=None,
            edge_id=info.edge,
            session=f"{info.session_id:016x}",
            base_size=info.base_size,
            fps=info.fps,
            budget_bps=info.budget_bps,
            facts={
                "method": info.method,
                "budget": f"{bitrate_text(info.budget_bps)}, {bitrate_text(info.base_bps)} of it for video",
                "source": f"{info.source_size[0]}x{info.source_size[1]}",
                "detector": Path(config.detector).name,
                "classifier": Path(config.classifier or "none").name,
            },
            info=info.pack(),
            clocked=info.pace == "realtime",
        )


def make_surfaces(terrain: Path | None) -> Callable[[str], Surface]:
    """What makes the ground of one flight, by the name of whose it is.

    The file is looked at once, here: `UserError` where it is no elevation model. One that goes later ends no flight.
    """
    if terrain is None:
        return lambda _flight: FLAT_GROUND
    with needs_extra("'hvt[terrain]'"):
        from hvt_ground.geolocation.elevation import ElevationModel  # noqa: PLC0415 - who has none needs no GDAL
        from hvt_ground.geolocation.terrain import Terrain  # noqa: PLC0415 - as above
    return partial(Terrain, ElevationModel(terrain))


def _mcap_file() -> type[McapFile]:
    with needs_extra("'hvt[mcap]'"):
        from hvt_ground.sinks.mcap_file import McapFile  # noqa: PLC0415 - who writes none needs no protobuf
    return McapFile


def check_cot(config: GroundConfig) -> None:
    """Refuse types and certificates of ``--cot`` that cannot be used, before anything is received; `UserError`."""
    if config.cot:
        with needs_extra("'hvt[cot]'"):
            from hvt_ground.sinks.cot.connection import check_connection  # noqa: PLC0415 - who has none needs no pytak
        read_types(config.cot_types)
        for url in config.cot:
            check_connection(url)


def _cot(config: GroundConfig, outputs: Outputs) -> Callable[..., SinkWriter[Event]] | None:
    """What makes the reporter of a session to all of ``--cot``; None without."""
    if not config.cot:
        return None
    check_cot(config)
    from hvt_ground.sinks.cot.connection import CotConnection  # noqa: PLC0415 - as above

    targets = [outputs.open(f"CoT {url}", partial(CotConnection, url)) for url in config.cot]
    return partial(SessionReporter, targets=targets, types=read_types(config.cot_types))


def _live_recorder(settings: RecorderSettings, view: LiveView) -> Recorder:
    view.start_again()
    return Recorder(replace(settings, live_url=view.url))


def check_outputs(config: GroundConfig) -> None:
    """Refuse files that cannot be written, before anything is received; `UserError`."""
    check_writable(config.summary, name="--summary")
    check_writable(config.timing, name="--timing")
    check_writable(config.log, name="--log")
    check_destination(config.ts)
    for path, suffix, name in (
        (config.tracks, ".csv", "--tracks"),
        (config.mcap, ".mcap", "--mcap"),
        (config.record, ".rrd", "--record"),
    ):
        if path is not None and path.suffix == suffix and not path.is_dir():
            check_writable(path, name=name)
    record = config.record
    if record is not None and record.suffix != ".rrd" and record.exists() and not record.is_dir():
        raise UserError(f"--record {record} is neither a folder nor named .rrd: give FILE.rrd or a folder")


def make_record_folder(config: GroundConfig) -> None:
    """Comes after all that may be refused: a failed start leaves nothing behind."""
    record = config.record
    if record is None or record.suffix == ".rrd":
        return
    try:
        record.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"--record {record} cannot be made ({error.strerror}): give FILE.rrd or a folder"
        ) from None


def make_link_settings(config: GroundConfig) -> LinkSettings:
    """How the ground takes part in Zenoh."""
    return LinkSettings(
        role="ground",
        listen=config.listen,
        connect=config.connect,
        zenoh_config=config.zenoh_config,
        insecure=config.insecure,
        links=2 if config.links == 2 else 1,
    )


def make_pipeline(
    config: GroundConfig, models: Models, *, info: Info, emit: Callable[[Event], None]
) -> Pipeline:
    """The pipeline of one session."""
    detector, classifier = models.take()
    reader = _reader(config, detector, classifier, info=info)
    names, edge_classes = unified_names(detector.class_names, info.class_names)
    vocabulary = Vocabulary(names, reader.class_names, kinds=config.refine == "replace")
    path = CameraPath(ahead_frames=max(1, round(info.fps)))
    parts = PipelineParts(
        detector=detector,
        tracker=_tracker(config, info),
        reader=reader,
        refiner=Refiner(
            cast('Literal["replace", "fuse"]', config.refine),
            fps=info.fps,
            vocabulary=vocabulary,
            calibrated=stills_calibrated(config),
        ),
        vocabulary=vocabulary,
        fusion=Fusion(fps=info.fps, edge_classes=edge_classes, path=path),
        path=path,
        # In lockstep the same input gives the same detections, however long they take.
        turns=None if info.pace == "lockstep" else models.turns,
    )
    return Pipeline(
        parts,
        view=info.view,
        fps=info.fps,
        detect_every=detect_every(config.detect_every, fps=info.fps),
        emit=emit,
        wants_base=isinstance(reader, Redetection),
    )


def make_backlog_perception(config: GroundConfig, models: Models, *, info: Info) -> BacklogPerception:
    """What analyzes the stored video and stills of a session."""
    return BacklogPerception(
        info,
        take_models=models.take,
        tracker_of=lambda: _tracker(config, info),
        reader_of=lambda detector, classifier: _reader(config, detector, classifier, info=info),
        detect_every=detect_every(config.detect_every, fps=info.fps),
    )


def _tracker(config: GroundConfig, info: Info) -> ByteTracker:
    motion = cast('Literal["off", "flow"]', config.camera_motion)
    confidence = track_confidence(config)
    return ByteTracker(TrackerSettings.starting_at(confidence, camera_motion=motion), fps=info.fps)


def _reader(
    config: GroundConfig, detector: Detector, classifier: Classifier | None, *, info: Info
) -> StillReader:
    if classifier is not None:
        return CropReader(classifier, view=info.view)
    if config.classifier == DETECTOR:
        return Redetection(detector, view=info.view)
    return NoReader()


def output_path(target: Path | None, *, suffix: str, edge: str, stamp: str, taken: set[Path]) -> Path:
    """Where a file of one session goes, and note it in ``taken``.

    ``target`` is the file or folder that the user named; ``stamp`` the time of the session's beginning. A named file
    is written anew, but each session of this process gets one of its own: the first takes the name, others have the
    edge's id in it. A file that nobody named is never overwritten.
    """
    if target is None or target.is_dir() or target.suffix != suffix:
        first = further = (target or Path()) / f"hvt-{edge}-{stamp}{suffix}"
    else:
        first, further = target, target.with_name(f"{target.stem}-{edge}{suffix}")
    names = [first] if further == first else [first, further]
    return _take(names, taken, number=len(names), may_exist=target)


def _backlog_path(target: Path | None, *, edge: str, stamp: str, taken: set[Path]) -> Path:
    """Where the backlog of a session that is over goes, beside the recording of the one that is open.

    Never over another file: its edge has forgotten what is in there.
    """
    if target is not None and target.suffix == ".rrd" and not target.is_dir():
        return _take([target.with_name(f"{target.stem}-{edge}-backlog.rrd")], taken, number=2)
    return _take([(target or Path()) / f"hvt-{edge}-{stamp}-backlog.rrd"], taken, number=2)


def _take(names: list[Path], taken: set[Path], *, number: int, may_exist: Path | None = None) -> Path:
    """The first that is free of the names and of the last one with a number from ``number`` on; it is taken."""
    last = names[-1]
    numbered = (last.with_name(f"{last.stem}-{count}{last.suffix}") for count in count_from(number))
    path = next(
        one for one in chain(names, numbered) if one not in taken and (one == may_exist or not one.exists())
    )
    taken.add(path)
    return path
