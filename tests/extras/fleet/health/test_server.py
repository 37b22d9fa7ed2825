"""Who watches a program: nobody else's page reads along."""

import contextlib
import errno
import http.client
import json
import socket
import threading
import time
from http.server import HTTPServer
from socketserver import ThreadingMixIn

import pytest
from rich.table import Table

import hvt_edge.cli
import hvt_ground.cli
from hvt_common.errors import FlightError, UserError
from hvt_common.runtime.failures import Failures
from hvt_fleet.health.server import Answer, HealthServer
from hvt_fleet.health.status_command import StatusCommand
from programs.processes import answers, eventually, free_ports

STATE = Answer(json.dumps({"latitude_deg": 52.1}).encode())


def asked(port: int, host: str | None) -> int:
    """The status of the answer to a request under that name."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    connection.putrequest("GET", "/state.json", skip_host=True)
    if host is not None:
        connection.putheader("Host", host)
    connection.endheaders()
    status = connection.getresponse().status
    connection.close()
    return status


@pytest.mark.parametrize(
    ("served_at", "names", "strangers"),
    [
        (
            "127.0.0.1",
            ("127.0.0.1", "LOCALHOST:9", "[::1]:9", None),
            (
                *("evil.example", "127.evil.example:9", "127.0.0.1.evil.example", "192.0.2.7"),
                *("[", "[::1].evil.example", "", "a, b"),
            ),
        ),
        (
            "0.0.0.0",
            ("127.0.0.1", "192.0.2.7:9", "[2001:db8::1]:9", "base", socket.gethostname(), None),
            ("evil.example", "127.evil.example:9", "base.evil.example", ""),
        ),
    ],
)
def test_state_is_told_under_names_of_this_machine_alone(served_at, names, strangers):
    """Another site could have its name lead here, and its page would read where the drone is."""
    with serving(at=served_at) as port:
        assert {one: asked(port, one) for one in names} == dict.fromkeys(names, 200)
        assert {one: asked(port, one) for one in strangers} == dict.fromkeys(strangers, 403)


def test_a_probe_may_ask_by_head():
    """`curl -I` and load balancers were told 501, and took a ground that is well for one that is down."""
    with serving() as port:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
        connection.request("HEAD", "/state.json")
        answer, length = connection.getresponse(), str(len(STATE.body))
        assert (answer.status, answer.headers["Content-Length"], answer.read()) == (200, length, b"")
        connection.request("GET", "/../../etc/passwd")
        assert connection.getresponse().status == 404
        connection.close()


def test_connections_that_say_nothing_or_nonsense_hold_their_places_for_seconds_alone():
    """A scanner of ports, or a stuck probe, would keep every other from a program that is well."""
    with serving() as port, contextlib.ExitStack() as stack:
        for number in range(40):
            one = stack.enter_context(socket.create_connection(("127.0.0.1", port)))
            with contextlib.suppress(OSError):  # it may be closed at once
                one.sendall(b"\x00\xff" * 4000 if number % 2 else b"GET /me")

        def serves() -> bool:
            with contextlib.suppress(OSError, http.client.HTTPException):  # all places are taken
                return asked(port, None) == 200
            return False

        eventually(serves, what="it serves on")


def test_threads_and_descriptors_that_are_used_up_for_a_while(monkeypatch):
    """The port would answer nobody for the rest of the flight, or take a core from video."""
    started, taken = ThreadingMixIn.process_request, HTTPServer.get_request
    refused, full = [], []

    def start(server, request, address):
        if len(refused) < 20:
            refused.append(address)
            raise RuntimeError("can't start new thread")
        started(server, request, address)

    def take(server):
        if len(refused) == 20 and len(full) < 4:
            full.append(time.monotonic())
            raise OSError(errno.EMFILE, "too many open files")
        return taken(server)

    monkeypatch.setattr(ThreadingMixIn, "process_request", start)
    monkeypatch.setattr(HTTPServer, "get_request", take)
    with serving() as port:
        while len(refused) < 20:
            answers(port)
        assert [asked(port, None) for _ in range(20)] == [200] * 20
    assert full[-1] - full[0] >= 3 * 0.2, "it rests"


@pytest.mark.parametrize(("main", "port"), [(hvt_edge.cli.main, 9465), (hvt_ground.cli.main, 9464)])
def test_what_is_no_address_is_told_the_one_that_status_asks(main, port, capsys):
    """A script would wait for a program to come where none can be; or metrics be where no `status` finds them."""
    assert main(["status", "--at", "here:99999"]) == 2
    said = f"--at 'here:99999' is not accepted: give HOST:PORT, such as 127.0.0.1:{port}\n"
    assert capsys.readouterr().err.partition(": ")[2] == said
    with pytest.raises(UserError, match=r"give HOST:PORT, such as .*, 127\.0\.0\.1:9465 for an edge"):
        HealthServer("here", {}, failures=Failures(time.time_ns))


@contextlib.contextmanager
def serving(answer=STATE, *, at="127.0.0.1"):
    """The port of a program that answers so, once it does."""
    (port,) = free_ports(1)
    with HealthServer(f"{at}:{port}", {"/state.json": lambda: answer}, failures=Failures(time.time_ns)):
        eventually(lambda: answers(port), what="it serves")
        yield port


def status(port, *words):
    def table(state):
        made = Table(title="uav-1")
        made.add_row(state["reason"])
        return made

    return StatusCommand("hvt-edge", "edge", f"127.0.0.1:{port}", table).run(words)


def test_status_says_brackets_as_they_are_and_asks_no_proxy(monkeypatch, capsys):
    """A part that fails with an address in brackets ended it in a traceback; beside a proxy no edge was there."""
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    reason = "[/dev/video0] is busy, tcp/[fe80::1]:7447 too"
    with serving(Answer(json.dumps({"reason": reason}).encode())) as port:
        assert status(port) == 0
    assert reason in capsys.readouterr().out


def test_status_says_what_a_program_says_that_stands_still():
    """An operator would start a second edge beside one that hangs."""
    with (
        serving(Answer(b"it stands still\n", status=503)) as port,
        pytest.raises(FlightError, match=f"what answers at 127.0.0.1:{port} says: it stands still"),
    ):
        status(port)


def test_status_at_a_port_that_speaks_no_http():
    """A wrong port, such as that of SSH, would be a traceback."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]

        def answer():
            with other.accept()[0] as one:
                one.sendall(b"SSH-2.0-OpenSSH_9.6\r\n")

        thread = threading.Thread(target=answer, daemon=True)
        thread.start()
        with pytest.raises(FlightError, match="no edge answers"):
            status(port)
        thread.join()
