"""Makes the parts of each session of an edge, and of recordings of former ones, as one tree; names their files."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from glob import escape
from itertools import chain
from itertools import count as count_from
from pathlib import Path
from typing import Any, TypeVar

from hvt_common.errors import NotYetError, UserError
from hvt_common.files import claim_name, has_nothing, takes_lock
from hvt_common.protocol.messages import Info
from hvt_common.runtime.reporting import check_writable
from hvt_common.units import Limit, bitrate_text
from hvt_ground.backlog.edge_backlog import BacklogRecording
from hvt_ground.config import GroundConfig, Written
from hvt_ground.events import Event, Refinement
from hvt_ground.extras import Flight, Opening, Service, extras_of, locators, part_of, written
from hvt_ground.perception.models import Models
from hvt_ground.perception.session import SessionPerception
from hvt_ground.recordings.row import RecordingRow
from hvt_ground.recordings.session_files import SessionFiles
from hvt_ground.session.edge_port import ReceiverReports
from hvt_ground.session.session import Session
from hvt_ground.sinks import Outputs, QueuedSink, Sink, SinkWriter
from hvt_ground.sinks.rerun.recorder import RecorderSettings

_log = logging.getLogger(__name__)

_OF_FILES = frozenset(
    {".avi", ".csv", ".hvtlog", ".json", ".mcap", ".mkv", ".mov", ".mp4", ".rrd", ".ts", ".txt"}
)
"""Endings of names that mean a file, also where no such folder is there yet."""


def check_outputs(config: GroundConfig, *, reads: Sequence[Path] = (), records: bool = True) -> None:
    """Refuse files that cannot be written, or are read (``reads``, too), before anything is received; `UserError`.

    A ground that ``records`` without ``--record`` writes here.
    """
    models = (config.detector, config.classifier, config.labels, config.detector_labels)
    given = (*models, config.zenoh_config)
    reads = [*reads, *(Path(one) for one in given if one is not None)]
    for extra in extras_of(config):
        reads += extra.reads(config)
    for extra in extras_of(config):
        extra.check_outputs(config)
    here = [Written("--record", Path(), ".rrd")] if records and config.record is None else []
    for name, path, suffix, _ in (*written(config), *here):
        if is_file(path, suffix):
            check_writable(path, name=name, reads=reads)
        elif not path.is_dir() and (path.exists() or path.suffix.lower() in _OF_FILES):
            raise UserError(
                f"{name} {path} is neither a folder nor named {suffix}: give FILE{suffix} or a folder"
            )
        elif path.exists() and not (os.access(path, os.W_OK | os.X_OK) or _is_read_only(path)):
            raise UserError(f"{name} {path} cannot be written to by this user: give a folder that can")


def _is_read_only(folder: Path) -> bool:
    # A disk may be mended in flight; nobody changes whose a folder is.
    return bool(os.statvfs(folder).f_flag & os.ST_RDONLY)


def make_folders(config: GroundConfig) -> None:
    """Comes after all that may be refused at once: a start that is refused leaves nothing behind."""
    for name, path, suffix, _ in written(config):
        if is_file(path, suffix):
            continue
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            kind = UserError if isinstance(error, NotADirectoryError) else NotYetError
            raise kind(
                f"{name} {path} cannot be made ({error.strerror}): give FILE{suffix} or a folder"
            ) from None


def set_aside(config: GroundConfig) -> None:
    """Move named files of this run that an earlier one wrote to a folder ``earlier-<time>`` beside them.

    A supervisor starts a ground that died again with the same names, and a flight cannot be received twice. Nothing
    is moved from under another ground that still writes it.
    """
    stamp = f"earlier-{time.strftime('%Y%m%d-%H%M%S')}"
    stamps = chain([stamp], (f"{stamp}-{number}" for number in count_from(2)))
    # Without a battery the clock says the same at each start.
    parents = [one.path.resolve().parent for one in written(config)]
    free = next(one for one in stamps if not any(list(parent.glob(f"{one}*")) for parent in parents))
    for name, path, suffix, beside in written(config):
        file = path.resolve()
        numbered = name == "--record" and config.split is not None
        if name == "--summary" or numbered or not is_file(path, suffix) or not file.is_file():
            continue
        folder = file.with_name(free)
        try:
            if not file.stat().st_size:
                continue
            if _is_written(file):
                _log.warning(
                    "%s %s is another program's, which writes it now: here the name differs", name, path
                )
                continue
            with suppress(OSError):  # on a full disk there may be no room for a folder, but for a name
                folder.mkdir(exist_ok=True)
            into = f"{folder}/" if folder.is_dir() else f"{folder}-"
            for one in chain([file], file.parent.glob(escape(file.stem) + beside) if beside else ()):
                one.rename(into + one.name)
        except OSError as error:
            _log.warning(
                "%s %s cannot be moved (%s): it is written over where its folder takes no other file",
                *(name, path, error.strerror),
            )
        else:
            _log.warning("%s %s was there already: it is %s now", name, path, into + file.name)


def _is_written(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return not takes_lock(file.fileno())
    except OSError:
        return False


def is_file(path: Path, suffix: str) -> bool:
    """Whether this path of a `Written` is one file, not a folder for some."""
    return not suffix or (path.suffix == suffix and not path.is_dir())


def output_path(
    target: Path | None, *, suffix: str, edge: str, stamp: str, taken: set[Path], claim: bool = True
) -> Path:
    """The path of a session's file, noted in ``taken``.

    ``target`` is the file or folder that the user named; ``stamp`` the time of the session's beginning. The first
    session takes a named file, others have the edge's id in the name; see `free_path`. Without ``claim`` the name is
    but the beginning of others, and no file.
    """
    if target is None or not is_file(target, suffix):
        first = further = (target or Path()) / f"hvt-{edge}-{stamp}{suffix}"
    else:
        first, further = target, target.with_name(f"{target.stem}-{edge}{suffix}")
    names = [first] if further == first else [first, further]
    return free_path(names, taken, number=len(names), may_exist=target, claim=claim)


def backlog_path(target: Path | None, *, edge: str, stamp: str, taken: set[Path]) -> Path:
    """The path for the backlog of a session that is over, beside the recording of the one that is open.

    Never over another file: its edge has forgotten the contents.
    """
    if target is not None and is_file(target, ".rrd"):
        return free_path([target.with_name(f"{target.stem}-{edge}-backlog.rrd")], taken, number=2)
    return free_path([(target or Path()) / f"hvt-{edge}-{stamp}-backlog.rrd"], taken, number=2)


def free_path(
    names: list[Path], taken: set[Path], *, number: int, may_exist: Path | None = None, claim: bool = True
) -> Path:
    """The first that is free of the names and of the last one with a number from ``number`` on; it is taken.

    With ``claim`` it is an empty file then: two grounds may share a folder. Such a file shows by itself that it is
    taken. ``may_exist`` may be a file, but none that another ground writes or has written.
    """
    is_free = claim_name if claim else lambda one: not one.exists()
    last = names[-1]
    numbered = (last.with_name(f"{last.stem}-{count}{last.suffix}") for count in count_from(number))
    for path in chain(names, numbered):
        if path not in taken and (is_free(path) if path != may_exist else not claim or _may_begin(path)):
            break
    if path == may_exist or not claim:
        taken.add(path)
    return path


def _may_begin(path: Path) -> bool:
    # Where the folder takes no other file it is this one or none.
    if not path.is_file() or not os.access(path.parent, os.W_OK | os.X_OK):
        return True
    return not path.stat().st_size and not _is_written(path)


T = TypeVar("T")


def open_again(named: Path, taken: set[Path], make: Callable[[Path], T]) -> T:
    """Open the file; one that was opened before and failed stays as it is: the next has a number in its name."""
    return _opened(make, partial(free_path, [named], taken, number=2, may_exist=named), taken, {named})


def _opened(make: Callable[[Path], T], name: Callable[[], Path], taken: set[Path], named: set[Path]) -> T:
    # A name that could not be used is free again, and no empty file of it stays, however often that is.
    path = name()
    try:
        return make(path)
    except BaseException:
        taken.discard(path)
        if path not in named and has_nothing(path):
            with suppress(OSError):
                path.unlink(missing_ok=True)
        raise


S = TypeVar("S", bound=SinkWriter[Any])

OpenSink = Callable[[Info], Callable[[], SinkWriter[Event]]]
"""Opens a sink for a session."""
_Pictures = tuple[QueuedSink[Event], Callable[[Refinement, Path], str]]
"""A sink, and where its newest file has the picture of a still."""

_LOCKSTEP_WAIT_S = 10.0


@dataclass(eq=False)
class SessionFactory:
    """Makes sessions, and recordings of former ones; each file gets a name of its own. For any thread.

    All that they write to is of ``outputs``; ``services`` of extras bring sinks and learn of the recordings, and
    ``program`` opens a sink of another program.
    """

    config: GroundConfig
    models: Models
    _: KW_ONLY
    clock: Callable[[], int]
    outputs: Outputs
    services: Sequence[Service] = ()
    program: OpenSink | None = None

    def __post_init__(self) -> None:
        self.records = self.program is None or self.config.record is not None
        """Whether there are recordings: a program takes their place unless they are requested."""
        self._paths: set[Path] = set()
        """Taken by this process, where no file shows it."""
        self._naming = threading.Lock()
        self._locator_of = locators(getattr(self.config, "terrain", None))
        self._extras = [
            *((part_of(one), one.sinks) for one in self.services),
            *((part_of(one), one.start(self.config, self.outputs)) for one in extras_of(self.config)),
        ]

    def open_session(self, info: Info, reports: ReceiverReports) -> Session:
        config, models, edge = self.config, self.models, info.edge
        stamp = time.strftime("%Y%m%d-%H%M%S")
        settings = self._recorder_settings(info)
        locator = self._locator_of(edge)
        # In lockstep the edge waits, so that nothing need be lost to a slow disk.
        wait_s = _LOCKSTEP_WAIT_S if info.pace == "lockstep" else 0.0
        sinks: list[Sink[Event]] = []
        if self.records:
            whole = config.split is None
            names = partial(output_path, config.record, suffix=".rrd", edge=edge, stamp=stamp, claim=whole)
            open_recording = partial(self._opened, self._files(settings, split=config.split), names)
            part = f"recording of {edge}"
            sinks.append(self.outputs.open(part, open_recording, wait_s=wait_s, for_backlog=True))
        if self.program is not None:
            part, opens = f"program of {edge}", self.program(info)
            sinks.append(self.outputs.open(part, opens, wait_s=wait_s, for_backlog=not self.records))
        pictures: list[_Pictures] = []
        flight = Flight(
            info,
            locator=locator,
            recording=settings,
            clock=self.clock,
            new_file=partial(self._new_file, edge=edge, stamp=stamp),
            still_address=partial(self._still_address, info, pictures),
        )
        brought = (models.failures.attempt(part, opens, (), flight) for part, opens in self._extras)
        for one in chain.from_iterable(brought):
            if not isinstance(one, Opening):
                sinks.append(one)
                continue
            pause_s = one.longest_pause_s
            held_s = wait_s if one.waits else 0.0
            sink = self.outputs.open(one.part, one.open, wait_s=held_s, longest_pause_s=pause_s)
            sinks.append(sink)
            if one.still_address is not None:
                pictures.append((sink, one.still_address))
        perception = SessionPerception(config, models, info)
        return Session(
            info,
            sinks=sinks,
            pipeline_of=perception.pipeline,
            clock=self.clock,
            reports=reports,
            backlog_perception=perception,
            locator=locator,
        )

    def open_backlog(self, info: Info) -> BacklogRecording:
        """The recording of a session that is over; not shown live, for the viewer shows the present."""
        settings = replace(self._recorder_settings(info), clocked=False)
        stamp = time.strftime("%Y%m%d-%H%M%S")
        names = partial(backlog_path, self.config.record, edge=info.edge, stamp=stamp)
        part = f"backlog recording of {info.edge}"
        sink = self.outputs.open(part, partial(self._opened, self._files(settings, backlog=True), names))
        perception = SessionPerception(self.config, self.models, info)
        return BacklogRecording(info, sink=sink, perception=perception)

    def _new_file(
        self, target: Path, suffix: str, make: Callable[[Path], S], *, edge: str, stamp: str
    ) -> Callable[[], S]:
        names = partial(output_path, target, suffix=suffix, edge=edge, stamp=stamp)
        return partial(self._opened, make, names)

    def _still_address(self, info: Info, pictures: Sequence[_Pictures], still: Refinement) -> str:
        # Where the picture of a still is: with a service, else in a file, else nowhere.
        found = (one.still_address(info, still) for one in self.services)
        in_files = (address(still, sink.files[-1]) for sink, address in pictures if sink.files)
        return next(filter(None, chain(found, in_files)), "")

    def _files(
        self, settings: RecorderSettings, *, split: Limit | None = None, backlog: bool = False
    ) -> Callable[[Path], SessionFiles]:
        return lambda path: SessionFiles(
            replace(settings, path=path), split=split, tell=self._recorded, backlog=backlog
        )

    def _recorded(self, row: RecordingRow) -> None:
        for one in self.services:
            self.models.failures.attempt(part_of(one), one.recorded, None, row)

    def _opened(self, make: Callable[[Path], S], name: Callable[..., Path]) -> S:
        def free() -> Path:
            with self._naming:
                return name(taken=self._paths)

        return _opened(make, free, self._paths, {one.path for one in written(self.config)})

    def _recorder_settings(self, info: Info) -> RecorderSettings:
        config = self.config
        facts = {
            "method": info.method,
            "budget": bitrate_text(info.budget_bps),
            "source": f"{info.source_size[0]}x{info.source_size[1]}",
            "detector": Path(config.detector).name,
            "classifier": Path(config.classifier or "none").name,
        }
        return RecorderSettings.of(info, None, facts=facts)
