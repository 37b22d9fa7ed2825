"""A small HTTP server for programs that watch this one: metrics, and whether it is alive.

It serves few requests at a time, each within some seconds, and makes each answer on request: a scraper comes every
few seconds, and misuse of the port disturbs no other part of the program.
"""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, HTTPServer
from socketserver import ThreadingMixIn
from typing import Any, Protocol, Self, TypeVar
from urllib.parse import urlsplit

from hvt_common.errors import NotYetError, UserError, listening_trouble, may_come
from hvt_common.runtime.failures import Awaited, Failures
from hvt_common.runtime.host_names import host_and_port, names_this_machine, requested_host
from hvt_common.units import SECOND_NS

_METRICS_TYPE = "text/plain; version=0.0.4; charset=utf-8"
"""The media type of Prometheus' text format."""

_MOST_AT_ONCE = 16
_PATIENCE_S = 2.0
"""The time that a client has for its request and for reading the answer."""


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer of one path."""

    body: bytes
    media_type: str = "text/plain; charset=utf-8"
    status: int = 200


class State(Protocol):
    """A program's own state at one moment."""

    @property
    def at_ns(self) -> int: ...

    def as_dict(self) -> dict[str, Any]: ...


_State = TypeVar("_State", bound=State)


def serve(
    metrics_text: Callable[[_State], bytes],
    address: str,
    newest: Callable[[], _State | None],
    *,
    clock: Callable[[], int],
    stuck_s: float,
    failures: Failures,
    lacks: Callable[[_State], str],
    beside: Callable[[], dict[str, Any]] = dict,
) -> HealthServer:
    """See `hvt_common.runtime.plug_ins.health_server`; ``metrics_text(state)`` is for Prometheus.

    ``beside()`` has further fields of the state as JSON.
    """

    def of_state(make: Callable[[_State], Answer]) -> Answer:
        state = newest()
        if state is None:
            return Answer(b"it has not begun\n", status=503)
        age_s = (clock() - state.at_ns) / SECOND_NS
        return make(state) if age_s < stuck_s else Answer(b"it stands still\n", status=503)

    def said(state: _State, *, ready: bool) -> Answer:
        why = lacks(state)
        if ready:
            return Answer(f"{why or 'ok'}\n".encode(), status=503 if why else 200)
        return Answer(f"ok{why and '; '}{why}\n".encode())

    def alive() -> Answer:  # while networks load it is, and not ready
        return Answer(b"starting\n") if newest() is None else of_state(lambda state: said(state, ready=False))

    answers = {
        "/metrics": lambda: of_state(lambda state: Answer(metrics_text(state), _METRICS_TYPE)),
        "/state.json": lambda: of_state(
            lambda state: Answer(json.dumps(state.as_dict() | beside()).encode(), "application/json")
        ),
        "/healthz": alive,
        "/readyz": lambda: of_state(lambda state: said(state, ready=True)),
    }
    return HealthServer(address, answers, failures=failures)


class HealthServer:
    """Serves ``answers``, by path, at ``address`` (HOST:PORT) while the context lasts.

    An address that is not there yet, or a port that is not free, is waited for. Raises `UserError` where the
    address is none or can never be listened on.
    """

    def __init__(
        self, address: str, answers: Mapping[str, Callable[[], Answer]], *, failures: Failures
    ) -> None:
        usual = "127.0.0.1:9464 for a ground, 127.0.0.1:9465 for an edge"
        host, port = host_and_port(address, name="--metrics", example=usual)

        def bound() -> _Server:
            try:
                return _Server(host, port, answers)
            except OSError as error:
                kind = NotYetError if may_come(error) else UserError
                raise kind(f"--metrics {address} cannot be listened on: {listening_trouble(error)}") from None

        self._server = Awaited(bound, "metrics", failures)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hvt-health", daemon=True)

    def _run(self) -> None:
        server = self._server.wait(self._stop)
        if server is not None:
            with server:
                while not self._stop.is_set():
                    server.handle_request()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()


class _Server(ThreadingMixIn, HTTPServer):
    request_queue_size = 16
    timeout = 0.2
    daemon_threads = True
    block_on_close = False

    def __init__(self, host: str, port: int, answers: Mapping[str, Callable[[], Answer]]) -> None:
        self.answers = answers
        self.host = host
        self._free = threading.BoundedSemaphore(_MOST_AT_ONCE)
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        super().__init__((host, port), _Handler)

    def get_request(self) -> tuple[Any, Any]:
        try:
            return super().get_request()
        except OSError:  # no descriptor is free: who knocks goes on knocking, and would be asked without end
            time.sleep(self.timeout)
            raise

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._free.acquire(blocking=False):
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # no thread can be started now
            self._free.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        pass


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = _PATIENCE_S
    server_version, sys_version = "hvt", ""

    def setup(self) -> None:
        super().setup()
        # The timeout is for each read: who sends a byte a second would be here for ever.
        self._deadline = threading.Timer(2 * _PATIENCE_S, self._give_up)
        self._deadline.daemon = True
        self._deadline.start()

    def finish(self) -> None:
        self._deadline.cancel()
        super().finish()

    def do_GET(self) -> None:
        answer = self._answer()
        self.send_response(answer.status)
        self.send_header("Content-Type", answer.media_type)
        self.send_header("Content-Length", str(len(answer.body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(answer.body)

    do_HEAD = do_GET  # noqa: N815 - http.server's name; probes that need no answer's body send it

    def _answer(self) -> Answer:
        # A browser always says which host it asks for, a probe may say nothing.
        said = self.headers.get_all("Host", [])
        if any(not names_this_machine(requested_host(one), served_at=self.server.host) for one in said):
            return Answer(b"unknown host: ask by the address of this machine\n", status=403)
        make = self.server.answers.get(urlsplit(self.path).path)
        return Answer(b"not here\n", status=404) if make is None else make()

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - http.server's name
        pass

    def _give_up(self) -> None:
        with contextlib.suppress(OSError):
            self.connection.shutdown(socket.SHUT_RDWR)
