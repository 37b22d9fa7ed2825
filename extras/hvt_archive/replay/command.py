"""``hvt-ground replay FILE [SETTINGS]``: receive a flight again, with other models or rules.

It is the ground of the flight without its link: nothing is skipped for lack of time, so that the same file and the
same settings give the same recording, tables and summary.
"""

from __future__ import annotations

import heapq
import math
import threading
from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from itertools import chain, count, takewhile
from pathlib import Path
from typing import Any, cast

from rich.progress import Progress

from hvt_archive.reading.recorded import read_recordings
from hvt_archive.replay.message_log import read_log
from hvt_archive.viewing import ViewerOptions, viewing
from hvt_common.config import load
from hvt_common.errors import Parser, UserError
from hvt_common.protocol.channels import Channel, EdgeKeys, matches, parse_key
from hvt_common.protocol.messages import (
    READ_VERSIONS,
    BaseHeader,
    Feedback,
    Flags,
    Info,
    PoseEncoder,
    RoiHeader,
    WireError,
)
from hvt_common.runtime.process import stop_on_signals
from hvt_common.runtime.reporting import print_table, version_of, write_json
from hvt_common.transport.inbox import Received
from hvt_common.units import SECOND_NS
from hvt_common.video.hevc import parameter_sets
from hvt_ground.backlog.edge_backlog import BacklogRecordings
from hvt_ground.config import GroundConfig
from hvt_ground.events import PoseUpdate, VideoSample
from hvt_ground.extras import checked, config_class
from hvt_ground.perception.models import Models
from hvt_ground.recordings.row import Recorded, RecordedStill
from hvt_ground.report.status import completed, summary, table
from hvt_ground.session.edge_port import InfoAnswer
from hvt_ground.session.edge_sessions import EdgeSessions
from hvt_ground.session.session import Session
from hvt_ground.sinks import Outputs
from hvt_ground.wiring import SessionFactory, check_outputs, make_folders

_OF_EVERY_POSE = 0
"""Each report stands by itself, so that none is lost with another."""


def messages_of(recorded: Recorded) -> Iterator[Received]:
    """The messages in the order in which they were known, the session's first; times are capture times.

    Each is made when it is its turn. Stills are the JPEGs of the recording. Raises `UserError` where that does not
    name its session.
    """
    info = recorded.info
    if info is None:
        raise UserError(
            f"the recording of {recorded.edge} does not hold what its edge said of the session, as those of an "
            "earlier HVT: it can be exported, not played"
        )
    make = _Recorded(info.edge, info.session_id)
    begins_ns = recorded.video[0].capture_ns if recorded.video else 0
    first = Received(make.keys[Channel.INFO], info.pack(), b"", "", begins_ns)
    # Of one frame the pose is known first, and a still last.
    streams = (
        map(make.pose, recorded.poses),
        map(make.unit, recorded.video),
        (make.still(one, one.header) for one in recorded.stills if one.header is not None),
    )
    return chain([first], heapq.merge(*streams, key=lambda one: one.received_ns))


class _Recorded:
    """Makes the messages of one session."""

    def __init__(self, edge: str, session_id: int) -> None:
        self.keys = EdgeKeys(edge)
        self._session_id = session_id
        self._units: Iterator[int] = count()
        self._poses = PoseEncoder(session_id=session_id, refresh_ns=_OF_EVERY_POSE)

    def pose(self, update: PoseUpdate) -> Received:
        report = self._poses.encode(update.pose)(update.capture_ns)
        return Received(self.keys[Channel.POSE], report.pack(), b"", "", update.capture_ns)

    def unit(self, sample: VideoSample) -> Received:
        """An access unit; those that never came are missed by their frames alone."""
        flags = Flags.LOCKSTEP
        if sample.keyframe:
            flags |= Flags.KEYFRAME
        if parameter_sets(sample.data):
            flags |= Flags.PARAMETER_SETS
        header = BaseHeader(
            session_id=self._session_id,
            sequence=next(self._units),
            frame_index=sample.frame_index,
            capture_ns=sample.capture_ns,
            send_delay_ns=0,
            flags=flags,
        )
        key = self.keys[Channel.BASE]
        return Received(key, sample.data, header.pack(sample.data), "video/h265", sample.capture_ns)

    def still(self, still: RecordedStill, header: RoiHeader) -> Received:
        """A still, at the time at which it was known; one that was stored has its picture here."""
        live = replace(header, flags=header.flags & ~Flags.STORED)
        key = self.keys[Channel.ROI]
        return Received(key, still.jpeg, live.pack(still.jpeg), "image/jpeg", still.capture_ns)


_Messages = Callable[[], Iterator[Received]]
"""All that was received, from the beginning."""
_OF_A_LINK = (
    "listen",
    "connect",
    "zenoh_config",
    "insecure",
    "group",
    "once",
    "wait",
    "web",
    "metrics",
    "log",
    "patience",
)
"""Settings that mean nothing without a link."""
_MOST_PAUSE_S = 5.0
"""With ``--speed``: longer pauses are shortened to this."""


def run(argv: Sequence[str]) -> int:
    """Replay a file; `UserError` where it is none, or has nothing to show, or for a setting of the link."""
    parser = Parser(prog="hvt-ground replay", description=__doc__, add_help=False)
    parser.add_argument("--speed", type=float, default=math.inf)
    parser.add_argument("--help", "-h", action="store_true")
    given, words = parser.parse_known_args(list(argv))
    files = [Path(one) for one in takewhile(lambda one: not one.startswith("-"), words)]
    if given.help:
        load(
            config_class(), ["--help"], program=f"{parser.prog} FILE … [--speed 1]", description=str(__doc__)
        )
    if not files:
        raise UserError(
            "give the files first: hvt-ground replay FILE.hvtlog|FILE.rrd … [--speed 1] [settings of hvt-ground]"
        )
    if not given.speed > 0:
        raise UserError(f"--speed {given.speed:g} is not accepted: give more than 0; 1 is as it came")
    messages = messages_in(files)
    config, loaded = load(
        config_class(), words[len(files) :], program="hvt-ground replay", description=str(__doc__)
    )
    _check_given(loaded.values)
    if config.provider == "auto":  # by its speed it may choose one this time and another the next
        config = replace(config, provider="cpu")
    config = checked(config)
    check_outputs(config, reads=files)
    replay, before = _Replay(config, messages, speed=given.speed), version_of(config.summary)
    sessions = replay.run()
    if not (sessions or replay.stop.is_set()):
        raise UserError(
            f"{files[0]} has no session that can be shown, of an edge that --edges {config.edges} names"
        )
    for content in sessions:
        print_table(f"{content['edge']}: received", table(content))
    if config.summary is not None:
        write_json(config.summary, sessions[0] if len(sessions) == 1 else sessions, before=before)
    return 0


def _check_given(settings: Container[str]) -> None:
    """`UserError` for a setting that means nothing here, or too much."""
    for name in _OF_A_LINK:
        if name in settings:
            raise UserError(f"--{name.replace('_', '-')} is not accepted: a replay has no link")
    if "cot" in settings:
        raise UserError("--cot is not accepted: others would take what is replayed for what is there now")


class _ReplayPort:
    """An edge as its messages say it was: it knows its sessions, and answers nothing else."""

    def __init__(self, edge: str, infos: dict[int, Info]) -> None:
        self.edge = edge
        self.present, self.used = threading.Event(), threading.Event()
        self.present.set()
        self._infos = infos

    def query_info(self, session_id: int) -> InfoAnswer | None:
        info = self._infos.get(session_id)
        return None if info is None else (info, info.received_ns, info.answered_ns)

    def request_info(self, session_id: int) -> None:
        """There is nobody to answer."""

    def take_info(self) -> InfoAnswer | None:
        return None

    def request_keyframe(self) -> None:
        """Nothing to request: a replay has only the messages that came."""

    def report(self, feedback: Feedback) -> None:
        """Nobody listens."""

    def raise_error(self) -> None:
        """There are no callbacks."""


class _Replay:
    def __init__(self, config: GroundConfig, messages: _Messages, *, speed: float) -> None:
        self._config = config
        self._messages = messages
        self._speed = speed
        self._now_ns = 0
        self.stop = stop_on_signals()

    def run(self) -> list[dict[str, Any]]:
        """Play all of it; a summary a session."""
        infos = _infos(self._messages())
        make_folders(self._config)
        models = Models(self._config)
        models.wait()  # the log waits for them
        ended: list[tuple[dict[str, Any], Session]] = []
        edges: dict[str, EdgeSessions] = {}
        with ExitStack() as stack:
            view = viewing(cast("ViewerOptions", self._config))
            services = [] if view is None else [stack.enter_context(view)]
            outputs = Outputs(models.failures)
            stack.callback(outputs.close)  # before the viewer, which gets the last events
            factory = SessionFactory(
                self._config, models, clock=self._clock, outputs=outputs, services=services
            )
            for item in self._paced():
                edge = (parse_key(item.key) or ("", None))[0]
                if edge not in infos or not matches(edge, edges=self._config.edges):
                    continue
                if edge not in edges:
                    edges[edge] = EdgeSessions(
                        _ReplayPort(edge, infos[edge]),  # type: ignore[arg-type]
                        open_session=factory.open_session,
                        on_ended=lambda one: ended.append((summary(one), one)),
                        recordings=BacklogRecordings(factory.open_backlog),
                        clock=self._clock,
                        versions=READ_VERSIONS,
                    )
                edges[edge].work(item, pending=False)
            for one in edges.values():
                one.close()
        return [
            completed(content, edges[session.info.edge], sinks=session.sinks, failures=models.failures)
            for content, session in ended
        ]

    def _clock(self) -> int:
        return self._now_ns

    def _paced(self) -> Iterator[Received]:
        size = sum(one.size_bytes for one in self._messages())
        with Progress(transient=True, disable=self._config.quiet) as progress:
            task = progress.add_task("replay", total=size)
            for item in self._messages():
                if self.stop.is_set():
                    return
                if parse_key(item.key) is None or item.key.endswith(f"/{Channel.INFO}"):
                    continue
                pause_s = (item.received_ns - self._now_ns) / SECOND_NS / self._speed if self._now_ns else 0.0
                if pause_s > 0 and self.stop.wait(min(pause_s, _MOST_PAUSE_S)):
                    return
                self._now_ns = max(self._now_ns, item.received_ns)
                progress.advance(task, item.size_bytes)
                yield item


def messages_in(files: Sequence[Path]) -> _Messages:
    """The received messages: of logs that follow each other, or of the recordings of one session."""
    if any(one.suffix == ".rrd" for one in files):
        return partial(messages_of, read_recordings(files))
    ordered = sorted(files, key=_first_ns)
    return lambda: chain.from_iterable(map(read_log, ordered))


def _first_ns(log: Path) -> int:
    """When its first message came; answers to ``info`` are at the beginning of each file, however old."""
    times = (one.received_ns for one in read_log(log) if not one.key.endswith(f"/{Channel.INFO}"))
    return next(times, 0)


def _infos(messages: Iterator[Received]) -> dict[str, dict[int, Info]]:
    """Each edge's facts of its sessions, by session; all are played in lockstep."""
    found: dict[str, dict[int, Info]] = {}
    for item in messages:
        parsed = parse_key(item.key)
        if parsed is None or parsed[1] is not Channel.INFO:
            continue
        try:
            info = Info.parse(item.payload, versions=READ_VERSIONS)
        except WireError:
            continue
        found.setdefault(parsed[0], {})[info.session_id] = replace(info, pace="lockstep")
    return found
