"""The order of things at the ground: link, one receiver an edge, sessions, recordings. Nothing else knows it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from hvt_common.errors import UserError
from hvt_common.protocol.channels import check_edge_pattern
from hvt_common.protocol.messages import Info
from hvt_common.runtime.clock import SteadyClock
from hvt_common.runtime.reporting import StatusLine, check_writable
from hvt_common.transport.doctor.diagnose import LinkWatch
from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import DEFAULT_ENDPOINT, LinkSettings
from hvt_common.units import bitrate_text
from hvt_ground.backlog.recordings import BacklogRecording
from hvt_ground.config import GroundConfig
from hvt_ground.session.receiver import EdgeReceiver
from hvt_ground.session.session import GroundSession
from hvt_ground.session.subscribe import EdgePort, GroundLink
from hvt_ground.sinks.rerun.live_view import LiveView
from hvt_ground.sinks.rerun.recorder import Recorder, RecorderSettings
from hvt_ground.sinks.timing import SessionTiming, TimingTable
from hvt_ground.sinks.tracks_table import TrackTable
from hvt_ground.status import summary
from hvt_ground.wiring import Models, backlog_path, make_backlog_perception, make_pipeline, output_path

__all__ = ["Ground"]

_POLL_S = 0.1
_CLOCK_EVERY_POLLS = 200


class Ground:
    """One run of a ground: build it, `run` it once. ``on_started()`` is called once nothing is refused any more."""

    def __init__(
        self, config: GroundConfig, *, stop: threading.Event, on_started: Callable[[], None] = lambda: None
    ) -> None:
        self._config = config
        self._stop = stop
        self._on_started = on_started
        self._clock = SteadyClock()
        self._receivers: dict[str, EdgeReceiver] = {}
        self._view: LiveView | None = None
        self._timing: TimingTable | None = None
        self._paths: set[Path] = set()
        self._models: Models | None = None
        self._began_s = time.monotonic()

    def run(self) -> list[dict[str, Any]]:
        """Serve edges until ``stop`` is set, or with ``--once`` until they have ended; return a summary a session.

        Raises:
            UserError: before anything is received, where a setting, a file or a port cannot be used.
        """
        config = self._config
        check_edge_pattern(config.edges)
        check_writable(config.summary, name="--summary")
        check_writable(config.timing, name="--timing")
        self._check_record()
        self._models = Models(config)
        with ExitStack() as stack:
            if config.view or config.serve:
                self._view = stack.enter_context(LiveView("spawn" if config.view else "serve"))
            settings = LinkSettings(
                role="ground",
                listen=config.listen,
                connect=config.connect,
                zenoh_config=config.zenoh_config,
                insecure=config.insecure,
                links=2 if config.links == 2 else 1,
            )
            session = stack.enter_context(open_session(settings))
            self._make_record_folder()
            if config.timing is not None:
                self._timing = stack.enter_context(closing(TimingTable(config.timing)))
            line = stack.enter_context(StatusLine(quiet=config.quiet))
            link = stack.enter_context(GroundLink(session, edges=config.edges, clock=self._clock))
            watch = stack.enter_context(LinkWatch(session, settings, served=link.is_known))
            self._on_started()
            self._say_where(line)
            try:
                self._serve(link, line, watch)
            finally:
                self._close_receivers()
        return self._summaries()

    def _check_record(self) -> None:
        record = self._config.record
        if record is None or record.is_dir():
            return
        if record.suffix == ".rrd":
            check_writable(record, name="--record")
        elif record.exists():
            raise UserError(
                f"--record {record} is neither a folder nor named .rrd: give FILE.rrd or a folder"
            )

    def _make_record_folder(self) -> None:
        """Comes after all that may be refused: a failed start leaves nothing behind."""
        record = self._config.record
        if record is None or record.suffix == ".rrd":
            return
        try:
            record.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(
                f"--record {record} cannot be made ({error.strerror}): give FILE.rrd or a folder"
            ) from None

    def _say_where(self, line: StatusLine) -> None:
        config = self._config
        if config.connect:
            line.note(f"hvt-ground: connecting to {', '.join(config.connect)}")
        if config.listen or not (config.connect or config.zenoh_config):
            line.note(f"hvt-ground: listening on {', '.join(config.listen or (DEFAULT_ENDPOINT,))}")
        if self._view is not None and self._view.page:
            line.note(f"hvt-ground: watch at {self._view.page}")

    # Serving

    def _serve(self, link: GroundLink, line: StatusLine, watch: LinkWatch) -> None:
        frames = 0
        while not self._stop.wait(_POLL_S):
            self._attend(link.ports(), line, watch)
            for receiver in self._receivers.values():
                if receiver.error is not None:
                    raise receiver.error
            frames += 1
            if frames % 10 == 0:
                line.show(self._status_text() or ("no link" if watch.trouble else "no edge yet"))
            if frames % _CLOCK_EVERY_POLLS == 0:
                self._refresh_clocks()
            if self._config.once and self._all_ended():
                return

    def _attend(self, ports: list[EdgePort], line: StatusLine, watch: LinkWatch) -> None:
        """A receiver for each edge of the link; none for one that has left it."""
        for receiver in [one for one in self._receivers.values() if one.port not in ports]:
            del self._receivers[receiver.port.edge]
            receiver.close()
        for port in ports:
            if port.edge in self._receivers:
                continue
            receiver = self._receivers[port.edge] = EdgeReceiver(
                port,
                open_session=self._open_session,
                clock=self._clock,
                open_backlog=self._open_backlog,
                patience_s=self._config.patience_s,
            )
            port.in_use = partial(_is_in_use, receiver)
            if not watch.may_command(port.edge):
                line.note(
                    f"hvt-ground: {self._config.zenoh_config} lets it watch {port.edge}, not command it: no "
                    "keyframes or stills on demand, and no changes of its settings"
                )

    def _all_ended(self) -> bool:
        receivers = list(self._receivers.values())
        if not any(receiver.done for receiver in receivers):
            waited_s = time.monotonic() - self._began_s
            return self._config.wait > 0 and not receivers and waited_s > self._config.wait
        return all(receiver.idle and not receiver.port.present.is_set() for receiver in receivers)

    def _refresh_clocks(self) -> None:
        for receiver in self._receivers.values():
            if not receiver.idle and receiver.port.present.is_set():
                receiver.refresh_clock()

    def _close_receivers(self) -> None:
        for receiver in self._receivers.values():
            receiver.stop()
        for receiver in self._receivers.values():
            receiver.close()
        for receiver in self._receivers.values():
            if receiver.error is not None:
                raise receiver.error

    def _open_session(self, info: Info, receiver: EdgeReceiver) -> GroundSession:
        config, models = self._config, self._models
        assert models is not None, "run() opens them"
        stamp = time.strftime("%Y%m%d-%H%M%S")
        path = output_path(config.record, suffix=".rrd", edge=info.edge, stamp=stamp, taken=self._paths)
        return GroundSession(
            info,
            recorder=Recorder(self._recorder_settings(info, path)),
            recording=path,
            tables=self._open_tables(info, stamp),
            timing=self._session_timing(info, receiver),
            pipeline_of=lambda emit: make_pipeline(config, models, info=info, emit=emit),
            to_local_ns=receiver.clock_offset.to_local_ns,
            clock=self._clock,
            report=receiver.report_now,
            backlog_perception=make_backlog_perception(config, models, info=info),
        )

    def _open_backlog(self, info: Info) -> BacklogRecording:
        """What was kept of a session that is over; not shown live, for the viewer shows what is now."""
        config, models = self._config, self._models
        assert models is not None, "run() opens them"
        stamp = time.strftime("%Y%m%d-%H%M%S")
        path = backlog_path(config.record, edge=info.edge, stamp=stamp, taken=self._paths)
        settings = replace(self._recorder_settings(info, path), clocked=False, live_url=None)
        perception = make_backlog_perception(config, models, info=info)
        return BacklogRecording(info, path=path, recorder=Recorder(settings), perception=perception)

    def _recorder_settings(self, info: Info, path: Path) -> RecorderSettings:
        config = self._config
        return RecorderSettings(
            path=path,
            edge_id=info.edge,
            session=f"{info.session_id:016x}",
            base_size=info.base_size,
            fps=info.fps,
            budget_bps=info.budget_bps,
            facts={
                "method": info.method,
                "budget": f"{bitrate_text(info.budget_bps)}, {bitrate_text(info.base_bps)} of it for video",
                "source": f"{info.source_size[0]}x{info.source_size[1]}",
                "base": f"{info.base_size[0]}x{info.base_size[1]} at {info.fps:g} fps, {info.codec}",
                "detector": Path(config.detector).name,
                "classifier": Path(config.classifier or "none").name,
            },
            clocked=info.pace == "realtime",
            live_url=self._view.url if self._view is not None else None,
        )

    def _open_tables(self, info: Info, stamp: str) -> list[TrackTable]:
        target = self._config.tracks
        if target is None:
            return []
        return [
            TrackTable(output_path(target, suffix=".csv", edge=info.edge, stamp=stamp, taken=self._paths))
        ]

    def _session_timing(self, info: Info, receiver: EdgeReceiver) -> SessionTiming | None:
        if self._timing is None:
            return None
        return SessionTiming(
            self._timing,
            edge=info.edge,
            session_id=info.session_id,
            clock=self._clock,
            offset_ns=lambda: receiver.clock_offset.offset_ns or 0,
        )

    # Saying

    def _status_text(self) -> str:
        parts = []
        for edge, receiver in sorted(self._receivers.items()):
            session = receiver.session
            if session is None:
                parts.append(f"{edge}: {'ended' if receiver.done else 'waiting for a keyframe'}")
                continue
            latency_ms = session.overlay_latency.percentile(50)
            age = "" if latency_ms is None or session.lockstep else f"  {latency_ms:.0f} ms"
            total = session.ledger.summary(session.duration_s).total_bps
            parts.append(
                f"{edge}: {session.duration_s:.1f} s  {bitrate_text(total)} of "
                f"{bitrate_text(session.info.budget_bps)}  stills {session.stills_received}  tracks "
                f"{session.pipeline.tracks}, {session.pipeline.refined} refined{age}"
            )
        return " | ".join(parts)

    def _summaries(self) -> list[dict[str, Any]]:
        return [
            summary(session, unusable=receiver.unusable, backlog_recordings=receiver.backlog.paths)
            for _, receiver in sorted(self._receivers.items())
            for session in receiver.done
        ]


def _is_in_use(receiver: EdgeReceiver) -> bool:
    """Whether there is or was more of this edge than messages under its name."""
    return not receiver.idle or bool(receiver.done) or bool(receiver.backlog.paths)
