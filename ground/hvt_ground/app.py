"""The order of things at the ground: link, one receiver an edge, sessions, recordings. Nothing else knows it."""

from __future__ import annotations

import queue
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import zenoh

from hvt_common.errors import FlightError, UserError
from hvt_common.runtime.clock import SteadyClock
from hvt_common.runtime.failures import Failures, reason_of
from hvt_common.runtime.plug_ins import health_server
from hvt_common.runtime.process import give_back_holes, notify_systemd
from hvt_common.runtime.reporting import StatusLine
from hvt_common.transport.link_doctor import LinkWatch, link_doctor
from hvt_common.transport.session import loses_declarations, open_session
from hvt_common.transport.zenoh_config import DEFAULT_ENDPOINT
from hvt_ground.backlog.edge_backlog import BacklogRecordings
from hvt_ground.config import GroundConfig
from hvt_ground.control import EdgeClient
from hvt_ground.events import Event
from hvt_ground.extras import Service, extras_of, part_of
from hvt_ground.report.state import GroundState, StateMaker
from hvt_ground.report.status import completed, status_text, summary
from hvt_ground.session import edge_sessions
from hvt_ground.session.edge_port import EdgePort
from hvt_ground.session.edge_sessions import EdgeSessions
from hvt_ground.session.session import Session
from hvt_ground.session.subscribe import GroundLink, Group
from hvt_ground.sinks import Outputs, Sink
from hvt_ground.wiring import Models, OpenSink, SessionFactory, check_outputs, make_folders, set_aside

_POLL_S = 0.1
_STATUS_EVERY_POLLS = 10
_STUCK_S = 5.0
"""A ground that makes no state for longer does not serve its edges either."""
_MOST_SUMMARIES = 256
"""Limit for an edge: one that restarts for weeks must not fill the memory."""
_MOST_MOVED = 256
"""Limit of edges that have left, for the same reason."""
_BACK_WITHIN_S = 60.0
"""With ``--once``, the least time for edges to come back over a link that was made anew."""


class _Watcher:
    # Shows a service of an extra how all edges are, in a thread of its own: one that hangs holds nothing else.

    def __init__(self, service: Service, failures: Failures) -> None:
        self._service, self._failures = service, failures
        self._states = queue.SimpleQueue[GroundState | None]()
        threading.Thread(target=self._run, name="hvt-watcher", daemon=True).start()

    def show(self, state: GroundState) -> None:
        if self._states.empty():
            self._states.put(state)

    def close(self) -> None:
        self._states.put(None)

    def _run(self) -> None:
        while (state := self._states.get()) is not None:
            self._failures.attempt(part_of(self._service), self._service.show, None, state)


@dataclass(frozen=True, slots=True)
class _Parts:
    """All that outlives a link."""

    models: Models
    factory: SessionFactory
    services: Sequence[Service]
    watchers: Sequence[_Watcher]
    outputs: Outputs
    line: StatusLine


class Ground:
    """One run of a ground: build it, `run` it once. ``on_started()`` is called once nothing is refused any more.

    ``program(info)`` opens a sink for each session: another program's, which takes the place of a recording that
    nobody asked for.
    """

    def __init__(
        self,
        config: GroundConfig,
        *,
        stop: threading.Event,
        on_started: Callable[[], None] = lambda: None,
        program: OpenSink | None = None,
    ) -> None:
        self._config = config
        self._program = program
        self._stop = stop
        self._on_started = on_started
        self._clock = SteadyClock()
        self._edges: dict[str, EdgeSessions] = {}
        self._leaving: list[EdgeSessions] = []
        """Edges that are served no more: they finish."""
        self._moved: dict[str, EdgeSessions] = {}
        """Sessions of edges that have left their place to another edge, or to another member of the group."""
        self._ended: defaultdict[str, deque[tuple[dict[str, Any], Sequence[Sink[Event]]]]] = defaultdict(
            partial(deque, maxlen=_MOST_SUMMARIES)
        )
        """By edge, the summaries of sessions and the sinks that wrote them."""
        self._began_s = time.monotonic()
        self._deaf = threading.Event()
        """A listener hears nothing any more: the link is made anew."""
        self._anew = self._begun = False
        self._models: Models | None = None
        self._state: GroundState | None = None

    def run(self) -> list[dict[str, Any]]:
        """Serve edges until ``stop`` is set, or with ``--once`` until they have ended; return a summary a session.

        Raises `UserError` before anything is received, where a setting, a file or a port cannot be used, and
        `FlightError` with the summaries after that. Models are opened beside the link: one that cannot be used ends
        the run within seconds.
        """
        check_outputs(self._config, records=self._program is None)
        models = self._models = Models(self._config, clock=self._clock)
        try:
            self._fly(models)
            if not all(one.finished for one in (*self._edges.values(), *self._leaving)):
                raise self.given_up()
        except FlightError as error:
            error.summary = self._summaries(models)
            raise
        return self._summaries(models)

    def in_hand(self) -> frozenset[tuple[str, int]]:
        """As of `Failures`; for another thread."""
        return self._models.failures.in_hand() if self._models else frozenset()

    def given_up(self) -> FlightError:
        """The end of a run that hangs after ``stop`` was set; for another thread."""
        if self._models is None:
            return FlightError("it was stopped before it had begun")
        return FlightError(self._models.failures.hanging, summary=self._summaries(self._models))

    def _fly(self, models: Models) -> None:
        config = self._config
        with ExitStack() as stack:
            if config.metrics is not None:
                server = health_server(
                    "ground",
                    config.metrics,
                    lambda: self._state,
                    clock=self._clock,
                    stuck_s=_STUCK_S,
                    failures=models.failures,
                )
                stack.enter_context(server)
            offered = (
                one.serve(config, clock=self._clock, failures=models.failures) for one in extras_of(config)
            )
            services = [stack.enter_context(one) for one in offered if one is not None]
            looking = [one for one in services if getattr(one.show, "__func__", None) is not Service.show]
            watchers = [stack.enter_context(closing(_Watcher(one, models.failures))) for one in looking]
            outputs = Outputs(models.failures)
            stack.callback(outputs.close)
            links = stack.enter_context(ExitStack())
            session = links.enter_context(self._open_link(models))
            make_folders(config)
            set_aside(config)
            client = EdgeClient(session, config.link)
            for one in services:
                one.begin(client)
            factory = SessionFactory(
                config, models, clock=self._clock, outputs=outputs, services=services, program=self._program
            )
            line = stack.enter_context(StatusLine(quiet=config.quiet, as_json=config.log_format == "json"))
            parts = _Parts(models, factory, services, watchers, outputs, line)
            try:
                while self._serve_link(session, parts):
                    links.close()
                    anew = self._link_anew(links, parts)
                    if anew is None:
                        break
                    session = anew
                    client.go_on(session)
            except Exception as error:
                if models.error is not None:
                    raise models.error from None
                if not self._begun:
                    raise
                raise FlightError(f"the ground cannot go on: {reason_of(error)}") from error

    def _open_link(self, models: Models) -> AbstractContextManager[zenoh.Session]:
        self._deaf.clear()
        return open_session(self._config.link, failures=models.failures, on_deaf=self._deaf.set)

    def _link_anew(self, links: ExitStack, parts: _Parts) -> zenoh.Session | None:
        # A file of the link's may be gone for a while, or its port taken; None where it is stopped meanwhile. Raises
        # the error of the link where the models cannot be used, or, with --once, none can have come back in time.
        self._anew, self._began_s, maker = True, time.monotonic(), self._state_maker(parts, None)
        while not self._stop.is_set():
            try:
                session = links.enter_context(self._open_link(parts.models))
            except (UserError, zenoh.ZError) as error:
                parts.models.failures.failed("link", reason_of(error))
                notify_systemd("WATCHDOG=1")
                self._tell(maker, parts, "no link")
                if parts.models.error is not None or (self._config.once and self._waited):
                    raise
                self._stop.wait(_POLL_S * _STATUS_EVERY_POLLS)
            else:
                parts.models.failures.works("link")
                self._began_s = time.monotonic()
                return session
        return None

    def _serve_link(self, session: zenoh.Session, parts: _Parts) -> bool:
        # Serve its edges; returns whether to go on with another session.
        config = self._config
        with ExitStack() as stack:
            group: Group | None = None
            if config.group is not None:
                shown = next((one.shown_to_others for one in parts.services if one.shown_to_others), "")
                group = stack.enter_context(link_doctor().sharer()(session, config.group, page=shown))
            attempt = parts.models.failures.attempt
            logs = ((part_of(one), one.message_log) for one in parts.services if one.message_log is not None)
            log = next((partial(attempt, part, log, None) for part, log in logs), None)
            link = stack.enter_context(
                GroundLink(
                    session,
                    edges=config.edges,
                    clock=self._clock,
                    group=group,
                    log=log,
                    loses=loses_declarations(config.link, session),
                )
            )
            watch = stack.enter_context(link_doctor().watch(session, config.link, served=link.is_known))
            self._on_started()
            self._begun = True
            notify_systemd("READY=1")
            self._say_where(parts)
            try:
                self._serve(link, parts, watch, group)
                again = self._deaf.is_set() and not self._stop.is_set()
                if not again:
                    parts.models.give_up()
            finally:
                edge_sessions.join([*self._edges.values(), *self._leaving])
            self._raise_error()
        return again

    def _summaries(self, models: Models) -> list[dict[str, Any]]:
        return [
            completed(content, sessions, sinks=sinks, failures=models.failures)
            for edge, sessions in sorted((self._moved | self._edges).items())
            for content, sinks in self._ended[edge]
        ]

    def _say_where(self, parts: _Parts) -> None:
        config, note = self._config, parts.line.note
        late = {one.part for one in parts.models.failures.now}
        if config.connect:
            note(f"hvt-ground: connecting to {', '.join(config.connect)}")
        if config.listen or not (config.connect or config.zenoh_config):
            yet = "not yet " * ("listener" in late)
            note(f"hvt-ground: {yet}listening on {', '.join(config.listen or (DEFAULT_ENDPOINT,))}")
        for service in parts.services:
            yet = "not yet, " * (service.part in late)  # another program may answer there
            for page in service.links:
                note(f"hvt-ground: {yet}watch at {page}")

    def _serve(self, link: GroundLink, parts: _Parts, watch: LinkWatch, group: Group | None) -> None:
        config, models, polls = self._config, parts.models, 0
        maker = self._state_maker(parts, group)
        while not self._stop.wait(_POLL_S):
            if polls % _STATUS_EVERY_POLLS == 0:
                notify_systemd("WATCHDOG=1")
            ports = link.ports()
            self._leave_edges(ports, link)
            for port in ports:
                if port.edge not in self._edges:
                    self._edges[port.edge] = self._serve_edge(port, parts.factory)
                    self._say_rights(port, parts.line, watch)
            if models.error is not None:
                raise models.error
            self._raise_error()
            polls += 1
            if polls % _STATUS_EVERY_POLLS == 0:
                give_back_holes()
                failed = {one.part for one in models.failures.now}
                if self._anew and "listener" in failed:
                    self._began_s = time.monotonic()  # nobody can come back yet
                self._tell(maker, parts, "no link" if watch.trouble else "no edge yet")
            if self._deaf.is_set() or (config.once and self._all_ended(loading=models.loading)):
                return

    def _state_maker(self, parts: _Parts, group: Group | None) -> StateMaker:
        config, models = self._config, parts.models
        return StateMaker(
            self._clock,
            detector=Path(config.detector).name,
            classifier=Path(config.classifier or "none").name,
            calibrated=models.facts.stills_calibrated,
            failures=models.failures,
            outputs=parts.outputs,
            loading=lambda: models.loading,
            recorded=parts.factory.records,
            group=group,
        )

    def _tell(self, maker: StateMaker, parts: _Parts, nobody: str) -> None:
        self._state = maker.make(sorted(self._edges.items()))
        for one in parts.watchers:
            one.show(self._state)
        parts.line.show(status_text(self._state) or nobody)

    def _serve_edge(self, port: EdgePort, factory: SessionFactory) -> EdgeSessions:
        return EdgeSessions(
            port,
            open_session=factory.open_session,
            on_ended=self._note_ended,
            recordings=BacklogRecordings(factory.open_backlog) if factory.records else None,
            clock=self._clock,
            patience_s=self._config.patience_s,
        ).start()

    def _note_ended(self, session: Session) -> None:
        # In the thread of its edge: forget the session and remember the numbers of the last ones.
        self._ended[session.info.edge].append((summary(session), session.sinks))

    def _leave_edges(self, ports: list[EdgePort], link: GroundLink) -> None:
        # The link has left those without a session, for others, and those that moved.
        for one in [one for one in self._edges.values() if one.port not in ports]:
            del self._edges[one.port.edge]
            one.stop()
            self._leaving.append(one)
        for one in [one for one in self._leaving if one.finished]:
            if one.error is not None:
                raise one.error
            self._leaving.remove(one)
            if one.ended:
                self._moved[one.port.edge] = one
            if len(self._moved) > _MOST_MOVED:
                del self._moved[oldest := next(iter(self._moved))]
                if oldest not in self._edges:
                    self._ended.pop(oldest, None)
            link.closed(one.port)

    def _say_rights(self, port: EdgePort, line: StatusLine, watch: LinkWatch) -> None:
        if not watch.may_command(port.edge):
            line.note(
                f"hvt-ground: {self._config.zenoh_config} lets it watch {port.edge}, not command it: no "
                "keyframes or stills on demand, and no changes of its settings"
            )

    def _all_ended(self, *, loading: bool) -> bool:
        edges = self._edges.values()
        gone = all(one.idle and not one.port.present.is_set() for one in edges)
        if not any(one.ended for one in edges):
            # Nobody came, who came left without a picture, or who left has nothing to come back for.
            return gone and not loading and self._waited
        return gone

    @property
    def _waited(self) -> bool:
        waits_s = max(self._config.wait, _BACK_WITHIN_S * self._anew)
        return 0 < waits_s < time.monotonic() - self._began_s

    def _raise_error(self) -> None:
        for one in (*self._edges.values(), *self._leaving):
            if one.error is not None:
                raise one.error
