"""Why there is no link, in words: probes of real listeners, keys read before the start, rights read from the file."""

import datetime as dt
import logging
import os
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import zenoh
from cryptography.hazmat.primitives import serialization

from hvt_common.errors import UserError
from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import LinkSettings, configure
from hvt_fleet.link.certificate import KeyPair, Rights, TlsFiles
from hvt_fleet.link.diagnose import Watch, visit
from hvt_fleet.link.probe import why_no_link
from hvt_fleet.pki import authority
from programs.fleet_keys import EXPIRED, Fleet
from programs.outsider import joined
from programs.processes import eventually, free_ports

NEEDS_IPV6 = pytest.mark.skipif(not Path("/proc/net/if_inet6").exists(), reason="this machine has no IPv6")


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Fleet:
    """An edge and a ground on 127.0.0.1."""
    fleet = Fleet(tmp_path_factory.mktemp("keys") / "own")
    fleet.keys("add-edge", "uav-1")
    fleet.keys("add-ground", "base", "--host", "127.0.0.1")
    return fleet


def _files(fleet: Fleet, name: str = "uav-1", *, ca: Fleet | None = None) -> TlsFiles:
    pair = KeyPair(fleet.folder / f"{name}.pem", fleet.folder / f"{name}.key")
    return TlsFiles(root_ca=(ca or fleet).folder / "ca.pem", connect=pair)


@contextmanager
def _server(answer: bytes | None) -> Iterator[int]:
    """A TCP server that sends something to who connects, or hangs up, or (None) keeps silent; yields its port."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        stop = threading.Event()

        def serve() -> None:
            while not stop.is_set():
                try:
                    taken, _ = listening.accept()
                except OSError:
                    return
                with taken:
                    if answer is None:
                        stop.wait()
                    else:
                        taken.sendall(answer)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        try:
            yield listening.getsockname()[1]
        finally:
            stop.set()
            listening.shutdown(socket.SHUT_RDWR)
            thread.join(60)


# Probes of what is not Zenoh. Those of Zenoh with one fault each are in tests/integration/hostile/test_security.py.


SILENT = (
    "somebody listens there and says nothing: a tunnel or proxy whose line is dark, or a side of HVT that stands "
    "still?"
)
DEAF = "does not answer TLS within 3 s: it is a plain tcp/… port, its program stands still, or the link"
NO_TLS = "what listens there does not speak TLS: connect to tcp/127.0.0.1:"
UNKNOWN = "no machine of the name 'no-such-host.invalid' is known here"
NOBODY = "nobody listens on port {free} there: is the other side running?"


@pytest.mark.parametrize(
    ("answer", "endpoint", "says"),
    [
        (b"SSH-2.0-OpenSSH_9.2\r\n", "tls/127.0.0.1:{port}", NO_TLS),
        (b"", "tls/127.0.0.1:{port}", NO_TLS),
        (None, "tls/127.0.0.1:{port}", DEAF),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "tcp/127.0.0.1:{port}", "no Zenoh link comes of it"),
        (None, "tcp/127.0.0.1:{port}", SILENT),
        (b"", "tcp/127.0.0.1:{free}", NOBODY),
        (b"", "tls/127.0.0.1:{free}", NOBODY),
        pytest.param(b"", "tcp/[::1]:{free}", NOBODY, marks=NEEDS_IPV6),
        pytest.param(b"", "tls/[::1]:{free}", NOBODY, marks=NEEDS_IPV6),
        (b"", "tls/no-such-host.invalid:7447", UNKNOWN),
        (b"", "quic/no-such-host.invalid:7447", UNKNOWN),
        (b"", f"tcp/{'a' * 64}:7447", f"'{'a' * 64}' is no name that a machine can have"),
        (b"", "tcp/base..example:7447", "'base..example' is no name that a machine can have"),
        (b"", "udp/127.0.0.1:7447", "cannot be seen from outside"),
        (b"", "quic/127.0.0.1:7447", "QUIC needs a path that carries packets of 1280 bytes"),
    ],
)
def test_what_is_no_ground_is_said(
    fleet: Fleet, free_port: int, answer: bytes | None, endpoint: str, says: str
) -> None:
    """Somebody's other service, a typing error, a ground that swaps: the user would search among the certificates."""
    with _server(answer) as port:
        named = {"port": port, "free": free_port}
        said = why_no_link(endpoint.format(**named), _files(fleet))
    assert said.startswith(f"{endpoint.format(**named)}: ")
    assert says.format(**named) in said


def test_of_a_name_without_connections_the_address_that_is_tried_is_said(monkeypatch) -> None:
    """Zenoh takes the first alone over UDP and QUIC: where no packet reaches it, the link never comes."""
    found = [
        (socket.AF_INET6, 1, 6, "", ("2001:db8::1", 7447, 0, 0)),
        (socket.AF_INET, 1, 6, "", ("192.0.2.1", 7447)),
    ]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    said = why_no_link("udp/ground.example:7447", TlsFiles())
    assert said.endswith("of its addresses 2001:db8::1 alone is tried: if it is dark, connect to 192.0.2.1")


def test_keys_that_vanish_during_a_flight_are_a_sentence(fleet: Fleet, tmp_path: Path) -> None:
    """The thread that explains must not die of what it was to explain."""
    other = fleet.copy(tmp_path / "gone")
    with _server(b"") as port:
        settings = other.settings("uav-1", "edge", connect=(f"tls/127.0.0.1:{port}",))
        (other.folder / "uav-1.key").unlink()
        assert visit(configure(settings)[0]) == [
            "the keys of this machine can no longer be read (No such file or directory)"
        ]


def test_two_links_to_one_place_are_explained_once(free_port: int) -> None:
    """The two endpoints by priority would say the same sentence twice."""
    endpoints = tuple(f"tcp/127.0.0.1:{free_port}?prio={prio}#so_sndbuf=8192" for prio in ("1-3", "4-7"))
    (said,) = visit(configure(LinkSettings("edge", connect=endpoints))[0])
    assert said.startswith(f"tcp/127.0.0.1:{free_port}: nobody")


def test_a_ca_that_has_ended_is_not_the_reason(
    tmp_path: Path, free_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Zenoh takes it; the user read that the ground's good certificate expired in three years."""
    monkeypatch.setattr(authority, "CA_DAYS", 0)
    monkeypatch.setattr(authority.Authority, "until", dt.datetime.max.replace(tzinfo=dt.UTC))
    old = Fleet(tmp_path / "keys")
    old.keys("add-edge", "uav-1")
    old.keys("add-ground", "base", "--host", "127.0.0.1")
    endpoint = f"tls/127.0.0.1:{free_port}"
    with open_session(old.settings("base", "ground", listen=(endpoint,))):
        said = why_no_link(endpoint, _files(old))
    assert "TLS works, both certificates are in order, but no Zenoh link comes of it" in said


def test_who_asks_with_keys_of_another_fleet_is_told(fleet: Fleet, tmp_path: Path, free_port: int) -> None:
    """'Nobody answers' would be said of a ground that runs."""
    other, where = Fleet(tmp_path / "other"), (f"tls/127.0.0.1:{free_port}",)
    other.keys("add-ground", "base")
    with (
        open_session(fleet.settings("base", "ground", listen=where)),
        pytest.raises(UserError, match=r"^no link: tls/.*: its certificate was not signed by the CA in"),
        open_session(LinkSettings("client", connect=where, zenoh_config=other.file("base"))),
    ):
        pass


# The watch


def test_a_certificate_that_ends_in_flight_is_told_where_it_listens(
    fleet: Fleet, tmp_path: Path, free_port: int, caplog: pytest.LogCaptureFixture
) -> None:
    """A ground that ran for months refused every edge, and only the edges, in the air, said why."""
    old = fleet.copy(tmp_path / "old")
    old.reissue("base", "127.0.0.1", now=EXPIRED)
    settings = old.settings("base", "ground", listen=(f"tls/127.0.0.1:{free_port}",))
    with (
        zenoh.open(configure(settings)[0]) as session,
        Watch(session, settings, served=lambda _: True, patience_s=0.1),
    ):
        eventually(lambda: caplog.records)
    assert "listens expired on" in caplog.text
    assert caplog.text.count("nobody can connect any more; make a new one with hvt-ground keys renew") == 1


def test_the_watch_explains_once_and_is_quiet_when_the_link_comes(
    free_port: int, caplog: pytest.LogCaptureFixture
) -> None:
    """A line a second in the log of a drone that waits for its ground hides everything else."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    settings = LinkSettings("edge", connect=(endpoint,), name="uav-1")
    with open_session(settings) as session, Watch(session, settings, served=lambda _: True) as watch:
        assert watch.trouble == ""
        eventually(lambda: watch.trouble)
        assert "nobody listens" in watch.trouble
        with open_session(LinkSettings("ground", listen=(endpoint,))):
            eventually(lambda: not watch.trouble)
    lines = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert lines == [f"no link: {endpoint}: {NOBODY.format(free=free_port)}"]


def test_a_link_that_comes_while_its_lack_is_explored_is_not_missed(caplog: pytest.LogCaptureFixture) -> None:
    """A ground that stood still for a moment would leave 'no link' as the last line of the log."""
    links: list[SimpleNamespace] = []
    looks: list[int] = []

    def look() -> list[SimpleNamespace]:
        looks.append(len(links))
        return list(links)

    def examine(_config: zenoh.Config) -> list[str]:
        links.append(SimpleNamespace(auth_identifier=None))
        return ["nobody is there"]

    info = SimpleNamespace(
        links=look,
        routers_zid=list,
        declare_link_events_listener=lambda *_, **__: SimpleNamespace(try_recv=lambda: None),
    )
    session = cast("zenoh.Session", SimpleNamespace(info=info))
    settings = LinkSettings("edge", connect=("tcp/127.0.0.1:9",), name="uav-1")
    with Watch(session, settings, served=lambda _: True, patience_s=0.05, examine=examine):
        eventually(lambda: looks.count(1) > 1)
    assert not caplog.records


@pytest.mark.parametrize(
    ("side", "taken_back"),
    [
        (
            "edge",
            "a ground hears uav-1 now: 'base' or another",
        ),  # Zenoh does not say whose subscription it is
        ("ground", "uav-1 and this ground hear each other now"),
    ],
)
def test_what_came_late_is_no_lack_of_rights(
    fleet: Fleet, caplog: pytest.LogCaptureFixture, side: str, taken_back: str
) -> None:
    """A ground that loaded its models for long was told of for the whole flight, and the operator looked for keys."""
    name, other = ("uav-1", "base") if side == "edge" else ("base", "uav-1")
    link = SimpleNamespace(auth_identifier=other, zid="1", src="tcp/127.0.0.1:1", dst="tcp/127.0.0.1:2")
    info = SimpleNamespace(
        links=lambda: [link],
        routers_zid=list,
        declare_link_events_listener=lambda *_, **__: SimpleNamespace(try_recv=lambda: None),
    )
    session = cast("zenoh.Session", SimpleNamespace(info=info))
    settings = LinkSettings(
        cast("Any", side), listen=("tls/127.0.0.1:9",), zenoh_config=fleet.file(name),
        name=name if side == "edge" else None,
    )  # fmt: skip
    there: list[bool] = []
    with Watch(session, settings, served=lambda _: bool(there), patience_s=0.05):
        eventually(lambda: f"{other!r} is linked, but" in caplog.text)
        there.append(True)
        eventually(lambda: taken_back in caplog.text)
    assert len(caplog.records) == 2


def test_a_second_link_that_does_not_come_is_said_once(
    free_port: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Answers that were to overtake pictures would wait behind them, and refused calls would cost bytes."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    file = tmp_path / "one.json5"
    file.write_text("{ transport: { unicast: { max_links: 1 } } }")
    settings = LinkSettings("edge", connect=(endpoint,), name="uav-1", links=2)
    with (
        open_session(LinkSettings("ground", listen=(endpoint,), zenoh_config=file)),
        open_session(settings) as session,
    ):
        eventually(session.info.links)
        with Watch(session, settings, served=lambda _: True, patience_s=0.2) as watch:
            eventually(lambda: caplog.records)
            time.sleep(0.6)
            assert watch.trouble == ""
    (said,) = [record.getMessage() for record in caplog.records]
    assert said.startswith(
        "one of the two links is missing: answers and pictures share the other; either the other"
    )


def test_a_ground_that_calls_another_is_told_that_it_passes_nothing_on(
    free_port: int, caplog: pytest.LogCaptureFixture
) -> None:
    """A second screen connected to the first ground stayed empty, and said only that no edge was heard."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    settings = LinkSettings("ground", connect=(endpoint,))
    with (
        open_session(LinkSettings("ground", listen=(endpoint,))),
        open_session(settings) as session,
        Watch(session, settings, served=lambda _: False, patience_s=0.1) as watch,
    ):
        eventually(lambda: caplog.records)
        assert watch.trouble == ""
    (said,) = [record.getMessage() for record in caplog.records]
    assert said.startswith(
        f"linked to {endpoint}, but no edge is seen there: if another ground listens there, it"
    )


def test_a_guest_with_one_link_is_no_half(
    free_port: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A viewer that calls with one link would be reported as a loss, and the user search for what is not missing."""
    own, other = f"tcp/127.0.0.1:{free_port}", f"tcp/127.0.0.1:{free_ports(1)[0]}"
    settings = LinkSettings("edge", listen=(own,), connect=(other,), name="uav-1", links=2)
    with open_session(LinkSettings("ground", listen=(other,), links=2)), open_session(settings) as session:
        eventually(lambda: len(session.info.links()) == 2)
        with Watch(session, settings, served=lambda _: True, patience_s=0.2) as watch, joined(own):
            eventually(lambda: len(session.info.links()) == 3)
            time.sleep(1.5)
            assert watch.trouble == ""
    assert not caplog.records


def _watching() -> bool:
    return any(one.name == "hvt-link-watch" for one in threading.enumerate())


def test_the_watch_ends_with_its_session_and_holds_nobody_up(fleet: Fleet) -> None:
    """Ctrl-C during a visit to a dead address has to end the program at once."""
    eventually(lambda: not _watching())
    visiting, gone = threading.Event(), threading.Event()

    def dead(_config: zenoh.Config) -> list[str]:
        visiting.set()
        gone.wait(60)
        return []

    settings = fleet.settings("uav-1", "edge", connect=("tls/127.0.0.1:9",))
    with open_session(settings) as session:
        with Watch(session, settings, served=lambda _: True, patience_s=0.2, examine=dead):
            assert visiting.wait(60)
        assert _watching(), "nobody has waited for the visit"
    gone.set()
    eventually(lambda: not _watching())


# Keys, before the start


def _start(fleet: Fleet, file: Path, *, name: str = "uav-1", listen: bool = False) -> None:
    there = ("tls/127.0.0.1:9",)
    edge = LinkSettings("edge", connect=there, zenoh_config=file, name=name)
    with open_session(LinkSettings("ground", listen=there, zenoh_config=file) if listen else edge):
        pass


BASE_KEY, TEXT, LOCKED = "base.key", "text.pem", "locked.key"


@pytest.mark.parametrize(
    ("changes", "listen", "words"),
    [
        *(
            ({f"{side}_{part}": value}, side == "listen", words.format(f"{side}_{part}"))
            for side in ("connect", "listen")
            for part in ("certificate", "private_key")
            for value, words in (
                ("/nowhere/x.pem", r"^/nowhere/x.pem, the {} of --zenoh-config, cannot be read \(No such"),
                (None, "but no {}: give both"),
            )
        ),
        (
            {"listen_certificate": None, "listen_private_key": None},
            True,
            r"listening on tls/127.0.0.1:9 takes listen_certificate and listen_private",
        ),
        ({"connect_private_key": BASE_KEY}, False, r"uav-1.pem and .*base.key do not belong together"),
        ({"connect_certificate": TEXT}, False, "are not a certificate and its key in PEM"),
        (
            {"root_ca_certificate": TEXT},
            False,
            "root_ca_certificate of --zenoh-config, holds no certificate in PEM",
        ),
        ({"connect_private_key": LOCKED}, False, "this key is encrypted; a key without a password is needed"),
    ],
)
def test_keys_that_cannot_be_used_are_named(fleet: Fleet, changes: dict, listen, words: str) -> None:
    """Zenoh would go on trying for ever without a word, or a service wait on a terminal that it does not have."""
    (fleet.folder / TEXT).write_text("no key at all")
    key = serialization.load_pem_private_key((fleet.folder / "uav-1.key").read_bytes(), None)
    locked = serialization.BestAvailableEncryption(b"secret")
    (fleet.folder / LOCKED).write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, locked)
    )
    ours = {
        name: str(fleet.folder / value) if value in (BASE_KEY, TEXT, LOCKED) else value
        for name, value in changes.items()
    }
    with pytest.raises(UserError, match=words):
        _start(fleet, fleet.changed("uav-1", **ours), listen=listen)


def test_keys_that_others_can_read_are_warned_of(
    fleet: Fleet, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The key of a drone copied with mode 644: everything works, for everybody on that machine."""
    other = fleet.copy(tmp_path / "open")
    (other.folder / "uav-1.key").chmod(0o644)
    _start(other, other.file("uav-1"))
    assert f"{other.folder}/uav-1.key: every user of this machine can read this key" in caplog.text
    caplog.clear()
    (other.folder / "uav-1.key").chmod(0o640)  # root:hvt, as the documents say
    _start(other, other.file("uav-1"))
    assert caplog.text == ""


@pytest.mark.parametrize(
    ("spoil", "name", "words"),
    [
        pytest.param(
            lambda fleet: (fleet.folder / "uav-1.key").chmod(0),
            "uav-1",
            r"connect_private_key of --zenoh-config, cannot be read \(Permission denied\)",
            marks=pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything"),
        ),
        (
            lambda fleet: fleet.reissue("uav-1", now=EXPIRED),
            "uav-1",
            r"uav-1.pem: this certificate expired on \d{4}-\d\d-\d\d \d\d:\d\d UTC \(it is",
        ),
        (
            lambda _: None,
            "uav-2",
            r"--edge-id uav-2: .*uav-1.pem is the certificate of 'uav-1', which may write",
        ),
    ],
)
def test_keys_that_do_not_serve_are_refused_here_not_there(fleet: Fleet, tmp_path: Path, spoil, name, words):
    """Copied by root for a service; two years old; of another edge, all of whose data would be dropped in silence."""
    other = fleet.copy(tmp_path / "other")
    spoil(other)
    with pytest.raises(UserError, match=words):
        _start(other, other.file("uav-1"), name=name)


def test_a_clock_that_is_behind_is_warned_of_and_tried(
    fleet: Fleet, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A drone without a clock of its own starts in the past and learns the time later: it must not stay down."""
    other, now = fleet.copy(tmp_path / "young"), dt.datetime.now(dt.UTC)
    for days, said in (
        (5, r"certificate holds from .* is the clock right\?"),
        (-810, "certificate expires on"),
    ):
        caplog.clear()
        other.reissue("uav-1", now=now + dt.timedelta(days=days))
        _start(other, other.file("uav-1"))
        assert re.search(f"uav-1.pem: this {said}", caplog.text)


def test_keys_that_are_not_used_are_not_looked_at(fleet: Fleet, free_port: int) -> None:
    """The same file on a bench, over plain TCP on loopback, must not need the keys."""
    file = fleet.changed("uav-1", connect_certificate="/nowhere/x.pem")
    settings = LinkSettings("edge", connect=(f"tcp/127.0.0.1:{free_port}",), zenoh_config=file, name="uav-2")
    with open_session(settings):
        pass


def test_a_certificate_reads_the_same_from_both_ends(fleet: Fleet) -> None:
    """Its name is what access control goes by: read wrongly, a good edge would be refused."""
    pair = KeyPair(fleet.folder / "base.pem", fleet.folder / "base.key")
    here, there = pair.read(as_server=True), pair.read(as_server=False)
    assert here == there
    assert (here.name, here.hosts) == ("base", ("base", "127.0.0.1"))
    assert here.not_after_s - here.not_before_s == pytest.approx(825 * 86_400 + 3600, abs=2)


# Rights


def test_rights_are_read_as_zenoh_reads_them() -> None:
    """A rule read too kindly gives no warning, one read too strictly a false one; without rules all is allowed."""
    config, _ = configure(LinkSettings("ground"))
    plain = Rights.of(config)
    config.insert_json5(
        "access_control",
        """{ enabled: true, default_permission: "deny",
             subjects: [{ id: "a", cert_common_names: ["a", "b"] }, { id: "all" }],
             rules: [
               { id: "r", permission: "allow", flows: ["ingress"], messages: ["put"], key_exprs: ["hvt/*/base"] },
               { id: "no", permission: "deny", flows: ["ingress"], messages: ["put"], key_exprs: ["hvt/x/**"] },
               { id: "q", permission: "allow", messages: ["query"], key_exprs: ["**"] }],
             policies: [{ subjects: ["a"], rules: ["r", "no"] }, { subjects: ["all"], rules: ["q"] }] }""",
    )
    rights = Rights.of(config)
    for who, flow, message, key, allowed in (
        ("b", "ingress", "put", "hvt/y/base", True),
        ("b", "ingress", "put", "hvt/x/base", False),  # a refusal goes before a permission
        ("b", "egress", "put", "hvt/y/base", False),
        ("c", "ingress", "put", "hvt/y/base", False),
        ("c", "ingress", "query", "hvt/y/control", True),  # no flow said: both
        ("c", "egress", "query", "hvt/y/control", True),
    ):
        assert rights.allow(who, flow=flow, message=message, key=key) is allowed, (who, flow, message, key)
        assert plain.allow(who, flow=flow, message=message, key=key)
    assert rights.knows("c"), "the subject without names is everybody"
    assert plain.knows("anybody")
    assert plain.allow_somebody(flow="egress", message="query", key="hvt/uav-1/control")
