"""Cursor on Target over real sockets: datagrams, streams, certificates, and servers that are bad or gone."""

import errno
import itertools
import socket
import ssl
import threading
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from types import SimpleNamespace
from typing import Any, Self

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.serialization import pkcs12
from cryptography.x509 import load_pem_x509_certificate

from hvt_common.config import load
from hvt_common.errors import UserError
from hvt_common.runtime.failures import Failures
from hvt_gateways.cot import connection as cot_connection
from hvt_gateways.cot.connection import CotConnection, check_connection
from hvt_gateways.cot.event import CotMessage
from hvt_gateways.cot.extra import CotExtra, CotOptions
from hvt_gateways.cot.schedule import STALE_NS
from hvt_ground.sinks import QueuedSink
from programs.fleet_keys import EXPIRED, Fleet
from programs.processes import PATIENT_S, eventually, free_ports

# What pytak does is its affair.
pytestmark = pytest.mark.filterwarnings("ignore:ssl.OP_NO_SSL:DeprecationWarning")

LAST = b"</event>"


def message(uid: str, number: int = 0, *, size: int = 600) -> CotMessage:
    head = b'<event uid="%s" number="%d">' % (uid.encode(), number)
    return CotMessage(uid, head + b"." * (size - len(head) - len(LAST)) + LAST)


class Server:
    """Accepts connections and reads what comes, until it is closed; ``reads`` False lets it lie."""

    def __init__(self, port: int, *, tls: ssl.SSLContext | None = None, reads: bool = True) -> None:
        self.received = b""
        self.connections: list[socket.socket] = []
        self._tls, self._reads = tls, reads
        self._listening = socket.create_server(("127.0.0.1", port))
        self._threads = [threading.Thread(target=self._accept, daemon=True)]
        self._threads[0].start()

    @property
    def uids(self) -> list[str]:
        """Of the events that came, in order."""
        return [part.split(b'"')[1].decode() for part in self.received.split(LAST)[:-1]]

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                made, _ = self._listening.accept()
                thread = threading.Thread(target=self._serve, args=(made,), daemon=True)
                self._threads.append(thread)
                thread.start()

    def _serve(self, made: socket.socket) -> None:
        with suppress(OSError):
            if self._tls is not None:
                made = self._tls.wrap_socket(made, server_side=True)
            self.connections.append(made)
            while self._reads and (data := made.recv(65536)):
                self.received += data
            if isinstance(made, ssl.SSLSocket) and self._reads:
                made.unwrap()  # else a client waits half a minute for the answer to its goodbye

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """As a process ends: the port is free, the connections are cut."""
        self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        for one in self.connections:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join(PATIENT_S)
        for one in self.connections:
            one.close()


@pytest.fixture(autouse=True)
def patient(monkeypatch) -> None:
    """However busy this machine is, the server has time."""
    for name in ("CONNECT_S", "SEND_S", "END_S"):
        monkeypatch.setattr(cot_connection, name, PATIENT_S)


@pytest.fixture
def port() -> int:
    return free_ports(1)[0]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory) -> Fleet:
    """A CA with a server, a client, and a server of another name."""
    fleet = Fleet(tmp_path_factory.mktemp("keys") / "keys")
    fleet.keys("add-ground", "takserver", "--host", "127.0.0.1")
    fleet.keys("add-ground", "elsewhere", "--host", "192.0.2.9")
    fleet.keys("add-ground", "client")
    return fleet


def demanding(fleet: Fleet, name: str = "takserver") -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(fleet.folder / f"{name}.pem", fleet.folder / f"{name}.key")
    context.load_verify_locations(fleet.folder / "ca.pem")
    context.verify_mode = ssl.CERT_REQUIRED
    return context


def keys(fleet: Fleet, **changes: str) -> dict[str, str]:
    said = {
        "PYTAK_TLS_CLIENT_CERT": str(fleet.folder / "client.pem"),
        "PYTAK_TLS_CLIENT_KEY": str(fleet.folder / "client.key"),
        "PYTAK_TLS_CLIENT_CAFILE": str(fleet.folder / "ca.pem"),
    }
    return {**said, **{f"PYTAK_{name}": value for name, value in changes.items()}}


def sink_of(url: str, environment: dict[str, str] | None = None) -> tuple[QueuedSink[CotMessage], Failures]:
    failures = Failures(time.time_ns)
    opened = QueuedSink(f"CoT {url}", lambda: CotConnection(url, environment or {}), failures=failures)
    return opened, failures


def ended(sink: QueuedSink[CotMessage]) -> bool:
    return sink.join(PATIENT_S)


@pytest.fixture
def datagrams(port: int) -> Iterator[socket.socket]:
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as made:
        made.settimeout(PATIENT_S)
        made.bind(("127.0.0.1", port))
        yield made


def test_a_datagram_is_one_event(port, datagrams):
    """A receiver of datagrams can put nothing together."""
    connection = CotConnection(f"udp://127.0.0.1:{port}", {})
    for number in range(3):
        connection.log(message(f"uid-{number}"))
    assert [datagrams.recv(65536) for _ in range(3)] == [message(f"uid-{number}").data for number in range(3)]
    connection.close()


def test_a_multicast_group_gets_it(port):
    """The first thing that anybody with three phones in a field tries."""
    group, interface = "239.2.3.1", socket.inet_aton("127.0.0.1")
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as receiver:
        receiver.settimeout(PATIENT_S)
        receiver.bind((group, port))
        receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(group) + interface)
        connection = CotConnection(f"udp://{group}:{port}", {"PYTAK_MULTICAST_LOCAL_ADDR": "127.0.0.1"})
        connection.log(message("here"))
        assert receiver.recv(65536) == message("here").data
        connection.close()


def test_nobody_at_the_other_end_of_datagrams_is_known_and_tried_again(port, caplog):
    """The machine that answers "port unreachable" would end the reports, or fill the log."""
    sink, failures = sink_of(f"udp://127.0.0.1:{port}")

    def refused() -> bool:
        sink.log(message("a"))
        return any(not one.working for one in failures.parts)

    eventually(refused, what="a refusal is noticed")
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as receiver:
        receiver.bind(("127.0.0.1", port))
        receiver.settimeout(0.1)
        got = []

        def arrives() -> bool:
            sink.log(message("b"))
            with suppress(TimeoutError):
                got.append(receiver.recv(65536))
            return bool(got)

        eventually(arrives, what="it is tried again")
    assert ended(sink)
    assert sum("Connection refused" in one for one in caplog.messages) == 1


def test_a_server_that_restarts_gets_events_again_and_it_is_said_once(port, caplog):
    """The map would stay empty for the rest of the flight after an update of the server."""
    sink, _ = sink_of(f"tcp://127.0.0.1:{port}")
    numbers = itertools.count()

    def arrives(server: Server) -> bool:
        sink.log(message(f"uid-{next(numbers)}"))
        time.sleep(0.01)
        return bool(server.uids)

    eventually(lambda: not sink.is_open() and caplog.messages, what="nobody is there yet")

    def noticed(sink: QueuedSink[CotMessage]) -> bool:
        sink.log(message("is there anybody"))
        return not sink.is_open()

    for _ in range(2):
        with Server(port) as server:
            eventually(lambda now=server: arrives(now), what="events come")
        eventually(lambda: noticed(sink), what="the end of the server is noticed")
    assert ended(sink)
    assert next(one for one in caplog.messages if "tried again" in one).endswith(
        f"tcp://127.0.0.1:{port}: Connection refused; all else goes on, and it is tried again"
    )
    assert sum("tried again" in one for one in caplog.messages) <= 3
    assert not any("Traceback" in one for one in caplog.messages)


def test_a_server_that_takes_nothing_gets_the_newest_of_each_afterwards(port):
    """It would hold up the flight, or be told for minutes where things were long ago."""
    with Server(port, reads=False) as server:
        connection = CotConnection(f"tcp://127.0.0.1:{port}", {})
        eventually(lambda: server.connections, what="the connection")
        server.connections[0].setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
        for number in range(500):  # 6 MB: one that waited would wait for ever
            for uid in range(20):
                connection.log(message(f"uid-{uid}", number))
        reader = server.connections[0]
        reader.settimeout(PATIENT_S)
        received, last = b"", {}
        while last != {f"uid-{uid}".encode(): 499 for uid in range(20)}:
            received += reader.recv(65536)
            parts = received.split(LAST)[:-1]
            last = {part.split(b'"')[1]: int(part.split(b'"')[3]) for part in parts}
        assert len(received) < 3_000_000, "what was replaced was not sent"
        connection.close()


def test_a_server_that_talks_is_heard_out(port):
    """A TAK server passes on what all others say, and cuts off whoever does not take it."""
    with Server(port) as server:
        connection = CotConnection(f"tcp://127.0.0.1:{port}", {})
        eventually(lambda: server.connections, what="the connection")
        server.connections[0].settimeout(PATIENT_S)
        server.connections[0].sendall(b"<event>" + b"x" * 20_000_000)
        connection.log(message("still"))
        eventually(lambda: server.uids == ["still"], what="it goes on")
        connection.close()


def test_what_waits_at_the_end_is_sent(port):
    """The last seconds of a flight would be missing."""
    with Server(port) as server:
        sink, failures = sink_of(f"tcp://127.0.0.1:{port}")
        assert sink.is_open(within_s=PATIENT_S)
        for number in range(500):
            sink.log(message(f"uid-{number}"))
        assert ended(sink)
        eventually(lambda: len(server.uids) == 500, what="all of it")
        assert failures.parts == ()


def test_events_go_over_tls_with_the_certificate_of_the_client(port, fleet):
    """TAK Server takes nothing else."""
    with Server(port, tls=demanding(fleet)) as server:
        url, said = f"tls://127.0.0.1:{port}", keys(fleet)
        check_connection(url, said)
        sink, failures = sink_of(url, said)
        for number in range(200):
            sink.log(message(f"secret-{number}"))
            time.sleep(0.002 * (number % 3))
        eventually(lambda: len(server.uids) == 200, what=f"all is sent, not {len(server.uids)}")
        (made,) = server.connections
        assert isinstance(made, ssl.SSLSocket)
        names = dict(one[0] for one in made.getpeercert()["subject"])
        assert names["commonName"] == "client"
        assert ended(sink)
        assert failures.parts == ()


@pytest.mark.parametrize("password", ["atakatak", "50%%s=${x}"])
def test_the_keystore_of_a_tak_user_works(port, fleet, tmp_path, password, monkeypatch):
    """It is what the administrator of a TAK server hands out, with a password of his taste.

    pytak unpacks it into files: whoever else is on this machine could take part.
    """
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    (tmp_path / "tmp").mkdir()
    certificate = load_pem_x509_certificate((fleet.folder / "client.pem").read_bytes())
    key: Any = serialization.load_pem_private_key((fleet.folder / "client.key").read_bytes(), None)
    store = tmp_path / "client.p12"
    locked = serialization.BestAvailableEncryption(password.encode())
    store.write_bytes(pkcs12.serialize_key_and_certificates(b"client", key, certificate, None, locked))
    said = {
        "PYTAK_TLS_CLIENT_CERT": str(store),
        "PYTAK_TLS_CLIENT_PASSWORD": password,
        "PYTAK_TLS_CLIENT_CAFILE": str(fleet.folder / "ca.pem"),
    }
    url = f"tls://127.0.0.1:{port}"
    with pytest.raises(UserError, match="cannot use the certificate"):
        check_connection(url, {**said, "PYTAK_TLS_CLIENT_PASSWORD": "wrong"})
    check_connection(url, said)
    with Server(port, tls=demanding(fleet)) as server:
        connection = CotConnection(url, said)
        connection.log(message("secret"))
        eventually(lambda: server.uids == ["secret"], what="it is sent")
        connection.close()
    assert list((tmp_path / "tmp").iterdir()) == []


def test_certificate_and_key_may_be_in_one_file_locked_or_not(fleet, tmp_path):
    """As many programs write them; OpenSSL would ask for the password at the terminal, and the ground wait."""
    key: Any = serialization.load_pem_private_key((fleet.folder / "client.key").read_bytes(), None)
    locked = serialization.BestAvailableEncryption(b"atakatak")
    both = tmp_path / "both.pem"
    both.write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, locked)
        + (fleet.folder / "client.pem").read_bytes()
    )
    url, said = "tls://takserver.example:8089", keys(fleet, TLS_CLIENT_CERT=str(both), TLS_CLIENT_KEY="")
    with pytest.raises(UserError, match=r"both\.pem has an encrypted key: set PYTAK_TLS_CLIENT_PASSWORD"):
        check_connection(url, said)
    check_connection(url, {**said, "PYTAK_TLS_CLIENT_PASSWORD": "atakatak"})
    both.write_bytes(b"".join((fleet.folder / f"client.{one}").read_bytes() for one in ("key", "pem")))
    check_connection(url, said)


@pytest.mark.parametrize(
    ("server_name", "changes", "reason"),
    [
        ("elsewhere", {}, "IP address mismatch"),
        ("takserver", {"TLS_CLIENT_CAFILE": "other-ca.pem"}, "PYTAK_TLS_CLIENT_CAFILE names its CA"),
        ("expired", {}, "certificate has expired"),
        ("takserver", {"TLS_CLIENT_CERT": "stranger.pem", "TLS_CLIENT_KEY": "stranger.key"}, "TLS failed"),
    ],
)
def test_certificates_that_do_not_fit_are_said(port, fleet, tmp_path, server_name, changes, reason):
    """Nothing would come, and nobody would know which of four certificates it is; places would go to a stranger."""
    other = Fleet(tmp_path / "other")
    other.keys("add-ground", "stranger")
    (tmp_path / "other-ca.pem").write_bytes((other.folder / "ca.pem").read_bytes())
    fleet.reissue("expired", "127.0.0.1", now=EXPIRED)
    for suffix in ("pem", "key"):
        (tmp_path / f"stranger.{suffix}").write_bytes((other.folder / f"stranger.{suffix}").read_bytes())
    with Server(port, tls=demanding(fleet, server_name)) as server:
        said = keys(fleet, **{name: str(tmp_path / file) for name, file in changes.items()})
        sink, failures = sink_of(f"tls://127.0.0.1:{port}", said)

        def refused() -> bool:
            sink.log(message("secret"))
            return any(reason in one.reason for one in failures.parts)

        eventually(refused, what=f"{reason}; there is {failures.parts}")
        assert server.uids == []
        assert ended(sink)


def test_a_server_that_never_shakes_hands_does_not_hold_up_the_end(port, fleet, monkeypatch):
    """Ctrl-C would be answered with kill -9."""
    monkeypatch.setattr(cot_connection, "CONNECT_S", 0.3)
    with Server(port, reads=False):
        sink, failures = sink_of(f"tls://127.0.0.1:{port}", keys(fleet))
        eventually(lambda: failures.parts, what="it is given up")
        assert failures.parts[0].reason == f"tls://127.0.0.1:{port}: it does not answer"
        assert ended(sink)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"TLS_CLIENT_CERT": ""}, "set PYTAK_TLS_CLIENT_CERT to FILE.pem or FILE.p12"),
        (
            {"TLS_CLIENT_CERT": "/nowhere/c.pem"},
            "PYTAK_TLS_CLIENT_CERT /nowhere/c.pem cannot be read (No such file",
        ),
        ({"TLS_CLIENT_KEY": "/nowhere/c.key"}, "PYTAK_TLS_CLIENT_KEY /nowhere/c.key cannot be read"),
        ({"TLS_CLIENT_CAFILE": "/nowhere/a.pem"}, "PYTAK_TLS_CLIENT_CAFILE /nowhere/a.pem cannot be read"),
        ({"TLS_CLIENT_KEY": "NOTES"}, "cannot use the certificate"),
        ({"TLS_CLIENT_CERT": "NOTES.p12"}, "cannot use the certificate"),
        ({"TLS_CLIENT_CAFILE": "NOTES"}, "cannot use the certificate"),
        ({"TLS_CLIENT_KEY": "NOTES.large"}, "cannot be read (larger than 16 MB)"),
        ({"TLS_DONT_VERIFY": "perhaps"}, "cannot use the certificate"),
    ],
)
def test_keys_that_cannot_be_used_end_the_start(fleet, tmp_path, changes, sentence):
    """It would be noticed in the air."""
    for name in ("NOTES", "NOTES.p12"):
        (tmp_path / name).write_text("no key")
    with (tmp_path / "NOTES.large").open("wb") as file:
        file.truncate(17_000_000)
    said = {name: str(tmp_path / one) if one.startswith("NOTES") else one for name, one in changes.items()}
    with pytest.raises(UserError) as refusal:
        check_connection("tls://takserver.example:8089", keys(fleet, **said))
    assert sentence in str(refusal.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [("TTL", "far"), ("TTL", "128"), ("LOCAL_ADDR", "eth0"), ("LOCAL_ADDRS", "192.0.2.1, ::1")],
)
def test_settings_of_multicast_that_cannot_be_used_end_the_start(name, value):
    """Nothing would ever be sent, and the log would say why in the words of another program."""
    with pytest.raises(UserError, match=f"PYTAK_MULTICAST_{name} '{value}' is not accepted"):
        check_connection("udp://239.2.3.1:6969", {f"PYTAK_MULTICAST_{name}": value})
    check_connection("udp://239.2.3.1:6969", {"PYTAK_MULTICAST_LOCAL_ADDRS": "192.0.2.1, 192.0.2.2"})


def test_a_group_without_a_route_names_the_remedy(monkeypatch):
    """On a laptop in the field, without a gateway, "Network is unreachable" says nothing to whoever reads it."""

    async def refuse(_settings: object) -> None:
        raise OSError(errno.ENETUNREACH, "Network is unreachable")

    monkeypatch.setattr("pytak.protocol_factory", refuse)
    with pytest.raises(UserError, match="set PYTAK_MULTICAST_LOCAL_ADDRS to this machine's address"):
        CotConnection("udp://239.2.3.1:6969")
    with pytest.raises(UserError, match="Network is unreachable"):
        CotConnection("udp://10.0.0.1:6969")


def test_nothing_goes_stale_between_two_tries():
    """A server that cuts one connection would show no camera for most of a minute."""
    pauses_s: list[float] = []
    outputs: Any = SimpleNamespace(open=lambda *_, longest_pause_s: pauses_s.append(longest_pause_s))
    CotExtra().start(CotOptions(cot=("tcp://127.0.0.1:1",)), outputs)
    assert 3 * pauses_s[0] <= STALE_NS / 1e9


def test_a_scheme_in_capitals_is_the_same():
    """It was refused, or taken and never reported to: pytak knows small letters only."""
    words = ["--cot", "UDP://239.2.3.1:6969", "--cot", "Tcp://TAK:8087"]
    given, _ = load(CotOptions, words, program="hvt-ground", description="")
    assert given.cot == ("udp://239.2.3.1:6969", "tcp://TAK:8087")
