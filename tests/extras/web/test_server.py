"""The page's server: who may come in, and what nobody can break from outside."""

import http.client
import json
import math
import os
import socket
import ssl
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives import serialization
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from hvt_common.errors import UserError
from hvt_common.runtime.failures import Failures
from hvt_common.transport.zenoh_config import key_pair
from hvt_ground.events import Notice
from hvt_web import server, site
from hvt_web.requests import BadRequestError, EdgeRequests
from hvt_web.server import WebPage
from hvt_web.viewers import Hub
from programs.fleet_keys import Fleet
from programs.processes import eventually, free_ports
from rigs.examples import refinement
from rigs.flight import Flight


@pytest.fixture(autouse=True)
def state_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path / "hvt"


@pytest.fixture
def port() -> int:
    return free_ports(1)[0]


@pytest.fixture
def local(port) -> Iterator[int]:
    with WebPage(f"127.0.0.1:{port}", clock=time.time_ns):
        yield port


@pytest.fixture
def public(port) -> Iterator[int]:
    with WebPage(f"0.0.0.0:{port}", clock=time.time_ns):
        yield port


@pytest.fixture
def keys(tmp_path) -> tuple[Path, Path]:
    """Of a ground on loopback: its certificate and its key; the CA lies beside them."""
    fleet = Fleet(tmp_path / "own")
    fleet.keys("add-ground", "base", "--host", "127.0.0.1")
    return key_pair(fleet.settings("base", "ground"))


def test_a_server_that_ends_says_so(port, monkeypatch):
    """The page would be gone, and status and log know of nothing."""

    async def serve(_server, sockets):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr("hvt_web.server._Server.serve", serve)
    failures = Failures(time.time_ns)
    with WebPage(f"127.0.0.1:{port}", clock=time.time_ns, failures=failures):
        eventually(lambda: failures.now, what="it is known")
    assert [(one.part, one.reason) for one in failures.now] == [
        ("web page", "RuntimeError: can't start new thread")
    ]


def asked(port: int, path: str, method: str = "GET", body: bytes = b"", **headers: str):
    """Status, headers and text of one answer."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path, body=body or None, headers=named)
    answer = connection.getresponse()
    text = answer.read().decode(errors="replace")
    connection.close()
    return answer.status, dict(answer.getheaders()), text


def joined(port: int, **more) -> ClientConnection:
    return connect(f"ws://127.0.0.1:{port}/ws", origin=f"http://127.0.0.1:{port}", open_timeout=10, **more)


def reached(port: int) -> socket.socket:
    """As a proxy on this machine does."""
    return socket.create_connection(("127.0.0.1", port), timeout=10)


def ended(viewer: ClientConnection) -> None:
    """Take what comes until the connection is closed, which raises."""
    while True:
        viewer.recv(timeout=60)


def greets(port: int) -> bool:
    """Whether a viewer is let in and told who it is."""
    with joined(port) as viewer:
        return json.loads(viewer.recv(timeout=60))["type"] == "hello"


def lets_in(port: int) -> bool:
    """Whether there is room for a viewer."""
    with suppress(InvalidHandshake):
        return greets(port)
    return False


def test_on_this_machine_the_page_opens_without_more(local):
    """Who tries it out would have to look for a password first."""
    status, headers, text = asked(local, "/")
    assert status == 200
    assert "<title>HVT</title>" in text
    assert "unsafe" not in headers["content-security-policy"]
    assert greets(local)


def test_a_still_is_where_others_are_told_that_it_is(port):
    """The link on a map would lead to another still, or to none."""
    flight = Flight(1)
    still = refinement(still_sequence=12)
    with WebPage(f"127.0.0.1:{port}", clock=time.time_ns) as page:
        feed = page.feed(flight.info())()
        for number in (11, 12, 13):  # the twelfth is not the twelfth one that came
            feed.log(replace(still, still_sequence=number, still=b"\xff\xd8 %d" % number))
        address = page.still_address(flight.info(), still)
        assert address.startswith(f"http://127.0.0.1:{port}/stills/")
        path = address.partition(f":{port}")[2]
        eventually(lambda: asked(port, path)[0] == 200, what="the still is there")
        _, headers, text = asked(port, path)
    assert headers["content-type"] == "image/jpeg"
    assert text.endswith(" 12")


def test_all_files_of_the_page_are_there_and_nothing_else(local):
    """The page would stay blank, or show files of this machine."""
    for name in ("main.js", "page.css", "player.js", "icon.svg"):
        assert asked(local, f"/static/{name}")[0] == 200
    for path in (
        "/static/../server.py",
        "/static/%2e%2e%2fserver.py",
        "/etc/passwd",
        "/static/",
        "/stills/a/b/c",
    ):
        status, _, text = asked(local, path)
        assert status == 404
        assert os.sep + "hvt" not in text


def test_another_sites_name_for_this_machine_is_not_served(local):
    """A page of another site could have its name lead here, and read everything."""
    for name in ("evil.example", "127.evil.example", "127.0.0.1.evil.example"):
        host = f"{name}:{local}"
        assert asked(local, "/", Host=host)[0] == 403
        answer = asked(local, "/edges/uav-1/keyframe", "POST", b"{}", Host=host, Origin=f"http://{host}")
        assert answer[0] == 403
        with pytest.raises(InvalidStatus, match="403"):
            connect(f"ws://{host}/ws", sock=reached(local), origin=f"http://{host}")


def test_a_page_of_another_site_cannot_watch_or_command(local):
    """What a browser has open beside this page could fly along; by an unknown proxy everybody seem to be here."""
    for origin in ({"origin": "http://evil.example"}, {}):
        with pytest.raises(InvalidStatus, match="403"):
            connect(f"ws://127.0.0.1:{local}/ws", **origin)
    for path, body in (("/ws", b""), ("/edges/uav-1/keyframe", b"{}")):
        assert asked(local, path, "POST", body, Origin="http://evil.example")[0] == 403
    status, _, text = asked(local, "/", X_Forwarded_For="192.0.2.7")
    assert (status, "--web-proxy" in text) == (403, True)


def test_a_proxy_says_who_somebody_is(port):
    """A team that logs in at its own door would share one token."""
    with WebPage(f"127.0.0.1:{port}", clock=time.time_ns, proxy="hvt.example.org") as page:
        assert page.links == ("https://hvt.example.org/",)
        host, origin = "hvt.example.org", "https://hvt.example.org"
        for role in ("viewer", "operator"):
            headers: dict[str, Any] = {"X-HVT-Role": role, "Host": host}
            assert asked(port, "/", **headers)[0] == 200
            with connect(
                f"ws://{host}/ws", sock=reached(port), origin=origin, additional_headers={"X-HVT-Role": role}
            ) as one:
                assert json.loads(one.recv())["role"] == role
            answer = asked(port, "/ws", "POST", b"", Origin=origin, **headers)
            assert answer[0] == 204, "no reason is told to who may come in: a viewer read of operators"
            answer = asked(port, "/edges/uav-1/keyframe", "POST", b"{}", Origin=origin, **headers)
            assert answer[0] == (403 if role == "viewer" else 400), answer[2]
        for role in ("", "admin", "operator, viewer"):
            assert asked(port, "/", Host=host, X_HVT_Role=role)[0] == 403
        assert asked(port, "/", Host=host)[0] == asked(port, "/")[0] == 403
        for name in ("evil.example", f"127.evil.example:{port}", f"127.0.0.1:{port}", "[127.0.0.1"):
            assert asked(port, "/", Host=name, X_HVT_Role="operator")[0] == 403
        with reached(port) as raw:  # one of a browser, passed on beside the proxy's
            raw.sendall(b"GET / HTTP/1.0\r\nHost: %s\r\n" % host.encode())
            raw.sendall(b"X-HVT-Role: viewer\r\nX-HVT-Role: operator\r\n\r\n")
            assert b" 403 " in raw.recv(100)


@pytest.mark.parametrize(
    ("address", "proxy", "sentence"),
    [
        ("0.0.0.0", "hvt.example.org", "needs a page on this machine alone"),
        ("127.0.0.1", "https://hvt.example.org/", "give a host, such as hvt.example.org"),
    ],
)
def test_a_proxy_that_cannot_be_is_refused(port, address, proxy, sentence):
    """The role would come from anybody, or from nobody."""
    with pytest.raises(UserError, match=sentence):
        WebPage(f"{address}:{port}", clock=time.time_ns, proxy=proxy)


def test_elsewhere_nothing_is_shown_without_the_token(public, state_folder):
    """Whoever finds the port would see the pictures."""
    tokens = json.loads((state_folder / "web-tokens.json").read_text())
    assert (state_folder / "web-tokens.json").stat().st_mode & 0o777 == 0o600
    for path in ("/", "/static/main.js", "/?token=wrong", "/stills/a/b/still"):
        status, _, text = asked(public, path, Cookie=f"hvt-{public}=wrong")
        assert status == 401
        assert tokens["operator"] not in text
    with pytest.raises(InvalidStatus) as refused:
        joined(public)
    assert refused.value.response.status_code == 401
    status, headers, _ = asked(public, f"/?token={tokens['viewer']}")
    assert (status, headers["location"]) == (303, "."), "the page of a proxy lies below a path"
    assert "HttpOnly" in headers["set-cookie"]
    cookie = f"hvt-{public}={tokens['viewer']}"
    assert asked(public, "/", Cookie=cookie)[0] == 200
    with joined(public, additional_headers={"Cookie": cookie}) as viewer:
        assert json.loads(viewer.recv())["role"] == "viewer"


def test_the_keys_of_the_link_encrypt_the_page(port, keys, tmp_path, state_folder):
    """Tokens and pictures would cross a network in clear, though there are keys."""
    trust = ssl.create_default_context(cafile=tmp_path / "own" / "ca.pem")
    with WebPage(f"0.0.0.0:{port}", clock=time.time_ns, keys=keys) as page:
        token = json.loads((state_folder / "web-tokens.json").read_text())["operator"]
        assert all(one.startswith("https://") for one in page.links)
        connection = http.client.HTTPSConnection("127.0.0.1", port, timeout=10, context=trust)
        connection.request("GET", f"/?token={token}")
        answer = connection.getresponse()
        assert answer.status == 303
        assert "Secure" in answer.headers["set-cookie"]
        connection.close()
    with pytest.raises(UserError, match="cannot use the keys"):
        WebPage(f"0.0.0.0:{port}", clock=time.time_ns, keys=(tmp_path / "a", tmp_path / "b"))
    plain = serialization.load_pem_private_key(keys[1].read_bytes(), password=None)
    locked = serialization.BestAvailableEncryption(b"secret")
    keys[1].write_bytes(
        plain.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, locked)
    )
    with pytest.raises(UserError, match="the key is encrypted: a key without a password is needed"):
        WebPage(f"0.0.0.0:{port}", clock=time.time_ns, keys=keys)


def test_a_viewer_commands_nothing(public, state_folder):
    """A link that was given away to watch would spend the budget."""
    tokens = json.loads((state_folder / "web-tokens.json").read_text())
    for role, expected in (("viewer", 403), ("operator", 400)):
        said = {"Cookie": f"hvt-{public}={tokens[role]}", "Origin": f"http://127.0.0.1:{public}"}
        assert asked(public, "/edges/uav-1/still", "POST", b"{}", **said)[0] == expected


@pytest.mark.parametrize("host", ["0.0.0.0", "[::]"])
def test_the_links_at_the_start_open_the_page(host, port, state_folder, monkeypatch):
    """Nobody would know the token."""
    monkeypatch.setattr(server, "own_addresses", lambda: ["10.8.0.1"])
    with WebPage(f"{host}:{port}", clock=time.time_ns) as page:
        tokens = json.loads((state_folder / "web-tokens.json").read_text())
        assert any(f"?token={tokens['operator']}" in one for one in page.links)
        assert len(page.links) == 2
        assert all(f" or http://10.8.0.1:{port}/?token=" in one for one in page.links), "some have no names"


@pytest.mark.parametrize("content", ["", "nonsense", "[]", "[" * 99_999, '{"operator": "x", "viewer": "y"}'])
def test_a_spoilt_token_file_is_one_sentence(port, state_folder, content):
    """The ground would start with a traceback, or with an empty password."""
    state_folder.mkdir()
    file = state_folder / "web-tokens.json"
    file.write_text(content)
    for mode, said in ((0o600, "holds no tokens"), (0o644, "read by others")):
        file.chmod(mode)
        with pytest.raises(UserError, match=said):
            WebPage(f"0.0.0.0:{port}", clock=time.time_ns)


def test_a_wrong_address_is_one_sentence():
    """The ground would seem to serve, and wait for ever."""
    for wrong in ("8080", "127.0.0.1", "host:port", ":8080", "127.0.0.1:99999", "a b:80", "127.0.0.1:80/x"):
        with pytest.raises(UserError, match="--web"):
            WebPage(wrong, clock=time.time_ns)


@pytest.mark.parametrize(
    "message",
    [
        "nonsense",
        "[]",
        "null",
        "{}",
        '{"type": "watch"}',
        '{"type": "watch", "edge": 5, "rung": "h264"}',
        '{"type": "watch", "edge": "a", "rung": {}}',
        '{"type": "time", "sent": "x"}',
        '{"type": []}',
        "[" * 4000,
        b"\x00\xff" * 100,
    ],
)
def test_nonsense_closes_that_connection_alone(local, message):
    """One broken browser would take the page from all others."""
    with joined(local) as viewer:
        viewer.send(message)
        with pytest.raises(ConnectionClosed):
            ended(viewer)
    assert greets(local)


@pytest.mark.parametrize(
    ("does", "messages"),
    [
        ("watch", [{"type": "watch", "edge": f"uav-{number}", "rung": "h264"} for number in range(20)]),
        ("show_wall", [{"type": "wall", "shown": bool(number % 2)} for number in range(20)]),
    ],
)
def test_who_changes_what_is_shown_all_the_time_gets_a_few(local, monkeypatch, does, messages):
    """Each time pictures are made anew from their keyframe: one viewer would take the processor from all others."""
    done: list[str] = []
    monkeypatch.setattr(site, "WATCH_PAUSE_S", 60.0)
    monkeypatch.setattr(Hub, does, lambda *_, **__: done.append(does))
    with joined(local, close_timeout=0.1) as viewer:  # nobody answers before the pause is over
        for message in messages:
            viewer.send(json.dumps(message))
        eventually(lambda: done, what="the first is done")
        time.sleep(0.3)
        assert len(done) == 1, "the next has to wait"
    assert greets(local)


@pytest.mark.parametrize(
    "box", [[0, 0, 1, 10**400], [0, 0, math.nan, 5], [0, 0, -1, 5], ["0", 0, 1, 1], [0, 0, 1]]
)
def test_a_box_that_is_none_is_one_sentence(box):
    """It would be an error of the server, in no words at all."""
    with pytest.raises(BadRequestError, match="box is no"):
        EdgeRequests(lambda: pytest.fail("nobody is asked")).request_still("uav-1", {"box": box})


def test_frames_of_a_megabyte_are_refused(local):
    """Some of them would fill the memory of the ground."""
    for _ in range(5):
        with joined(local) as viewer, suppress(ConnectionClosed):
            viewer.send("x" * 2**20)
            ended(viewer)
    origin = f"http://127.0.0.1:{local}"
    assert asked(local, "/edges/uav-1/still", "POST", b"x" * 2**20, Origin=origin)[0] == 400
    assert greets(local)


def test_two_hundred_viewers_are_as_many_as_are_let_in(local):
    """The ground would spend itself on viewers."""
    refused = 0
    with ExitStack() as let_in:
        for _ in range(200):
            try:
                let_in.enter_context(joined(local))
            except InvalidHandshake:
                refused += 1
        assert 100 <= refused <= 180

    eventually(lambda: lets_in(local), what="others are let in")


def test_five_hundred_connections_that_say_nothing_leave_room(local):
    """A port scanner would close the page to those who need it."""
    silent = [socket.create_connection(("127.0.0.1", local)) for _ in range(500)]
    closed = set()

    def many_are_closed() -> bool:
        for one in silent:
            one.setblocking(False)
            with suppress(BlockingIOError):
                one.recv(100)
                closed.add(one)
        return len(closed) >= 200

    eventually(many_are_closed, what="most are refused")
    for one in silent:
        one.close()
    eventually(lambda: lets_in(local), what="others are let in")


def is_closed(connection: socket.socket) -> bool:
    """Whether the server has ended it; what it sent meanwhile is taken."""
    connection.setblocking(False)
    with suppress(BlockingIOError):
        try:
            return connection.recv(4096) == b""
        except ConnectionError:
            return True
    return False


def test_a_byte_now_and_then_holds_no_connection(port, monkeypatch):
    """A few hundred such connections would keep everybody else out for ever."""
    monkeypatch.setattr(server, "REQUEST_S", 0.5)
    with WebPage(f"127.0.0.1:{port}", clock=time.time_ns), ExitStack() as held:
        eventually(lambda: lets_in(port), what="it serves")
        for request in (b"", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"):
            one = held.enter_context(reached(port))
            with suppress(ConnectionError):  # where this process stands still for so long
                one.sendall(request)
                if request:
                    assert one.recv(10_000).startswith((b"HTTP/1.1 200", b"HTTP/1.1 408"))
                one.sendall(b"G")
            eventually(lambda one=one: is_closed(one), what="it is closed")


def test_silent_connections_take_no_more_descriptors_than_others(port, keys, monkeypatch):
    """Before TLS nobody counted them: recordings found no descriptor for their next file."""
    monkeypatch.setattr(server, "MOST_OPEN", 8)
    with WebPage(f"0.0.0.0:{port}", clock=time.time_ns, keys=keys), ExitStack() as held:
        silent = [held.enter_context(reached(port)) for _ in range(40)]
        eventually(lambda: sum(map(is_closed, silent)) >= 32, what="most are closed")


def test_who_begins_no_tls_is_closed(port, keys, monkeypatch):
    """Its place would be taken for a minute, again and again."""
    monkeypatch.setattr(server, "REQUEST_S", 0.5)
    with WebPage(f"0.0.0.0:{port}", clock=time.time_ns, keys=keys), reached(port) as silent:
        eventually(lambda: is_closed(silent), what="it is closed")


def test_who_takes_all_places_makes_room_for_others(public, state_folder, monkeypatch):
    """One machine with a link for viewers, or with none, would keep the operator out."""
    token = json.loads((state_folder / "web-tokens.json").read_text())["operator"]
    cookie = {"Cookie": f"hvt-{public}={token}"}

    def watch(source: str) -> ClientConnection:
        raw = socket.create_connection(("127.0.0.1", public), timeout=10, source_address=(source, 0))
        said = {"X-Forwarded-For": f"10.9.8.{next(made_up)}"}  # anybody may write it: it must not count
        return joined(public, sock=raw, additional_headers=cookie | said)

    made_up = count(1)
    monkeypatch.setattr(site, "MOST_VIEWERS", 3)
    with watch("127.0.0.1") as first, watch("127.0.0.1") as second, watch("127.0.0.1") as third:
        with pytest.raises(InvalidStatus, match="503"):
            watch("127.0.0.1")
        with watch("127.0.0.2") as other:
            assert json.loads(other.recv(timeout=60))["type"] == "hello"
            three = (first, second, third)
            eventually(lambda: sum(map(hung_up, three)) == 1, what="one of the three has gone")
            (gone,) = filter(hung_up, three)
            assert gone.close_reason == "too many viewers: one from another address took this place"
    where = ("127.0.0.1", public)
    for bound in ("MOST_CONNECTIONS", "MOST_OPEN"):
        with ExitStack() as held, monkeypatch.context() as few:
            few.setattr(server, bound, 3)
            silent = [held.enter_context(reached(public)) for _ in range(3)]
            with socket.create_connection(where, timeout=60, source_address=("127.0.0.2", 0)) as late:
                late.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
                assert late.recv(100).startswith(b"HTTP/1.1 401"), bound
            eventually(lambda these=silent: sum(map(is_closed, these)), what="one is closed")


def hung_up(viewer: ClientConnection) -> bool:
    """Whether the page has closed it."""
    with suppress(TimeoutError, ConnectionClosed):
        while True:
            viewer.recv(timeout=0)
    return viewer.close_code is not None


def test_a_viewer_that_reads_nothing_is_closed(port, monkeypatch):
    """It would keep its place for ever: to close it waits for what it does not take."""
    monkeypatch.setattr(server, "STALL_S", 0.5)
    with WebPage(f"127.0.0.1:{port}", clock=time.time_ns) as page:
        eventually(lambda: lets_in(port), what="it serves")
        feed = page.feed(Flight(1).info())()
        with socket.socket() as raw:
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            raw.connect(("127.0.0.1", port))
            raw.sendall(
                f"GET /ws HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nOrigin: http://127.0.0.1:{port}\r\n".encode()
                + b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
                + b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
            )
            assert b" 101 " in raw.recv(100)

            def is_reset() -> bool:
                feed.log(Notice(0, 0, "info", "x" * 200_000))
                try:
                    raw.sendall(b"\x8a\x80\0\0\0\0")  # a pong that nobody asked for
                except ConnectionError:
                    return True
                return False

            eventually(is_reset, what="it is closed")


def test_what_is_no_http_disturbs_nothing(local):
    """Another protocol on the port would stop the page."""
    for data in (
        b"\x16\x03\x01\x02\x00",
        b"GET / HTTP/9.9\r\n\r\n",
        b"A" * 100_000,
        b"POST / HTTP/1.1\r\n" * 50,
    ):
        with socket.create_connection(("127.0.0.1", local), timeout=5) as raw:
            try:
                raw.sendall(data)
                raw.shutdown(socket.SHUT_WR)
                while raw.recv(4096):
                    pass
            except OSError:
                pass
    assert greets(local)


def test_the_server_ends_while_viewers_watch(port):
    """The ground would hang at its end."""
    before = set(threading.enumerate())

    def serves() -> bool:
        return any(one.name == "hvt-web" for one in set(threading.enumerate()) - before)

    with ExitStack() as viewers:
        with WebPage(f"127.0.0.1:{port}", clock=time.time_ns):
            viewers.enter_context(joined(port)).recv()
            assert serves()
        eventually(lambda: not serves(), what="its thread ends")
