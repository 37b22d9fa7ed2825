"""Who gets in over real TLS, who may do what, and what each who may not is told."""

import logging
import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

import hvt_edge.cli
from hvt_common.protocol.channels import Channel, EdgeKeys, selector
from hvt_common.transport.session import declare_publisher, open_session, query, serve
from hvt_common.transport.zenoh_config import LinkSettings, configure
from hvt_fleet.link.diagnose import Watch
from programs.fleet_keys import EXPIRED, Fleet
from programs.processes import Running, eventually, free_ports

pytestmark = pytest.mark.integration

UAV1, UAV2 = EdgeKeys("uav-1"), EdgeKeys("uav-2")
PATIENCE_S = 0.3
"""Nothing here is merely slow to come."""


@contextmanager
def _unchecked(settings: LinkSettings) -> Iterator[zenoh.Session]:
    """A session of somebody who does not look at keys before the start."""
    with zenoh.open(configure(settings)[0]) as session:
        yield session


# Who does not get in


REFUSALS = {
    "no certificate": r"the other side wants a certificate of this machine, and --zenoh-config names none",
    "other CA of the same name": r"its certificate was not signed by the CA in \S+/other/ca.pem",
    "certificate of another CA of the same name": (
        r"refused our certificate \S+/other/uav-1.pem: it was signed by another CA than the one trusted there, though"
    ),
    "our certificate expired": r"refused our certificate \S+/old/uav-1.pem: it is expired, or not valid yet, by",
    "its certificate expired": r"the other side's certificate of 'base' expired on \d{4}-\d\d-\d\d \d\d:\d\d UTC; it",
    "wrong host": r"its certificate of 'base' is for base, 127.0.0.1, not for 'localhost': connect to one of these",
    "plain to TLS": r"this is a TLS port, and plain tcp does not get in: connect to tls/… with the keys",
    "TLS to plain": r"what listens there does not answer TLS within 3 s: it is a plain tcp/… port",
}


@pytest.fixture(scope="module")
def refused(fleet: Fleet, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, str]]:
    """All of them at once, each calling a ground that would let `uav-1` in; what became of each."""
    folder = tmp_path_factory.mktemp("others")
    other = Fleet(folder / "other")
    other.keys("add-edge", "uav-1")
    other.keys("add-ground", "base", "--host", "127.0.0.1")
    old = fleet.copy(folder / "old")
    old.reissue("uav-1", now=EXPIRED)
    old.reissue("base", "127.0.0.1", now=EXPIRED)
    good, expired, plain = free_ports(3)
    tls = (f"tls/127.0.0.1:{good}",)
    own = fleet.settings("uav-1", "edge", connect=tls)
    foreign = {
        "root_ca_certificate": str(fleet.folder / "ca.pem"),
        "connect_certificate": str(other.folder / "uav-1.pem"),
        "connect_private_key": str(other.folder / "uav-1.key"),
    }
    no_pair = fleet.changed("uav-1", connect_certificate=None, connect_private_key=None)
    callers = {
        "no certificate": replace(own, zenoh_config=no_pair),
        "other CA of the same name": other.settings("uav-1", "edge", connect=tls),
        "certificate of another CA of the same name": replace(
            own, zenoh_config=fleet.changed("uav-1", **foreign)
        ),
        "our certificate expired": old.settings("uav-1", "edge", connect=tls),
        "its certificate expired": replace(own, connect=(f"tls/127.0.0.1:{expired}",)),
        "wrong host": replace(own, connect=(f"tls/localhost:{good}",)),
        "plain to TLS": LinkSettings("edge", connect=(f"tcp/127.0.0.1:{good}",)),
        "TLS to plain": replace(own, connect=(f"tls/127.0.0.1:{plain}",)),
    }
    with ExitStack() as stack:
        grounds = [
            stack.enter_context(_unchecked(settings))
            for settings in (
                fleet.settings("base", "ground", listen=tls),
                old.settings("base", "ground", listen=(f"tls/127.0.0.1:{expired}",)),
                LinkSettings("ground", listen=(f"tcp/127.0.0.1:{plain}",)),
            )
        ]
        watches = {}
        for name, settings in callers.items():
            session = stack.enter_context(_unchecked(settings))
            watch = Watch(session, settings, served=lambda _: True, patience_s=PATIENCE_S)
            watches[name] = session, stack.enter_context(watch)
        eventually(lambda: all(watch.trouble for _, watch in watches.values()), what="all are explained")
        assert [list(ground.info.peers_zid()) for ground in grounds] == [[], [], []]
        return {
            name: (len(list(session.info.links())), watch.trouble)
            for name, (session, watch) in watches.items()
        }


@pytest.mark.parametrize("case", REFUSALS)
def test_who_must_not_get_in_does_not_and_is_told_why(refused: dict[str, tuple[int, str]], case: str) -> None:
    """Let in, a stranger watches; refused without a reason, the owner gives up and flies with --insecure."""
    links, trouble = refused[case]
    assert links == 0
    assert re.search(rf"^(tls|tcp)/(127.0.0.1|localhost):\d+: .*{REFUSALS[case]}", trouble)


# Who is in, and may not


@contextmanager
def _edge(fleet: Fleet, endpoint: str, *, name: str = "uav-1") -> Iterator[zenoh.Session]:
    """A session of the edge uav-1 that listens, is present, and answers info and control."""
    settings = fleet.settings(name, "edge", listen=(endpoint,))
    with open_session(settings) as session:
        serve(session, Channel.INFO, keys=UAV1, answer=lambda _question: b"info")
        serve(session, Channel.CONTROL, keys=UAV1, answer=lambda _question: b"done")
        token = session.liveliness().declare_token(UAV1[Channel.ALIVE])
        with Watch(session, settings, served=lambda _ground: False, patience_s=PATIENCE_S):
            yield session
        token.undeclare()  # type: ignore[no-untyped-call]


def _linked(*sessions: zenoh.Session) -> Callable[[], bool]:
    return lambda: all(list(session.info.links()) for session in sessions)


def test_an_edge_cannot_write_as_another(
    fleet: Fleet, free_port: int, caplog: pytest.LogCaptureFixture
) -> None:
    """One captured drone could show the operator pictures under another drone's name."""
    endpoint = f"tls/127.0.0.1:{free_port}"
    ground_settings = fleet.settings("base", "ground", listen=(endpoint,))
    came: list[str] = []
    with ExitStack() as stack:
        ground = stack.enter_context(open_session(ground_settings))
        take = lambda sample: came.append(str(sample.key_expr))  # noqa: E731
        ground.declare_subscriber("hvt/**", take)
        ground.liveliness().declare_subscriber("hvt/**", take, history=True)
        forging = replace(fleet.settings("uav-1", "edge", connect=(endpoint,)), name=None)
        forger = stack.enter_context(open_session(forging))
        served = lambda name: f"hvt/{name}/alive" in came  # noqa: E731
        stack.enter_context(Watch(ground, ground_settings, served=served, patience_s=PATIENCE_S))
        forger.liveliness().declare_token(UAV2[Channel.ALIVE])
        serve(forger, Channel.INFO, keys=UAV2, answer=lambda _question: b"forged")
        own = declare_publisher(forger, Channel.STATUS, keys=UAV1)
        eventually(lambda: own.matching_status.matching, what="the edge's own stream is wanted")
        for row in (Channel.BASE, Channel.ROI, Channel.TRACKS, Channel.STATUS, Channel.FEEDBACK):
            forger.put(UAV2[row], b"forged")
        own.put(b"own")
        eventually(lambda: came, what="the edge's own message")
        assert query(ground, Channel.INFO, keys=UAV2, question=b"", timeout_s=1) == []
        eventually(lambda: "'uav-1' is linked" in caplog.text, what="the ground is told")
        assert came == [UAV1[Channel.STATUS]]
    assert "or it runs under another id than its certificate says, and all it sends is dropped" in caplog.text


def test_watching_commanding_and_being_a_stranger(
    fleet: Fleet, free_port: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Three keys of one CA, three rights: else every guest steers, or every operator only watches."""
    endpoint = f"tls/127.0.0.1:{free_port}"
    with ExitStack() as stack:
        edge = stack.enter_context(_edge(fleet, endpoint))
        # A guest who has changed its own file to that of a ground that commands: the edge has to refuse it.
        files = {"base": fleet.file("base"), "guest": fleet.bold("base"), "stranger": fleet.file("stranger")}
        grounds = {
            name: stack.enter_context(
                open_session(LinkSettings("ground", connect=(endpoint,), zenoh_config=file))
            )
            for name, file in files.items()
        }
        came: dict[str, list[bytes]] = {name: [] for name in grounds}
        for name, ground in grounds.items():
            ground.declare_subscriber(
                selector(Channel.STATUS),
                lambda sample, name=name: came[name].append(sample.payload.to_bytes()),
            )
        publisher = declare_publisher(edge, Channel.STATUS, keys=UAV1)
        eventually(_linked(*grounds.values()), what="all three are linked")

        def answers(row: Channel, expected: dict[str, bytes | None]) -> bool:
            """Who may ask is answered, on a busy machine at another try; who may not, at none."""
            found = {
                name: b"".join(query(ground, row, keys=UAV1, question=b"do", timeout_s=2)) or None
                for name, ground in grounds.items()
            }
            assert not any(found[name] for name, answer in expected.items() if answer is None), found
            return found == expected

        info = {"base": b"info", "guest": b"info", "stranger": None}
        eventually(lambda: answers(Channel.INFO, info), what="who may watch is answered")
        control = {"base": b"done", "guest": None, "stranger": None}
        eventually(lambda: answers(Channel.CONTROL, control), what="who may command is answered")
        publisher.put(b"picture")
        eventually(lambda: came["base"] and came["guest"], what="the two that may watch receive")
        assert came["stranger"] == []
        eventually(lambda: "'stranger' has a certificate" in caplog.text, what="the edge is told")
    assert (
        f"{fleet.file('uav-1')} does not name it: it gets no picture and no answer from here" in caplog.text
    )


# Real processes


def _words(scene: Path) -> list[str]:
    """Of an edge that starts fast: the demo would have to be drawn first."""
    small = ("--source-fps", "10", "--fps", "10", "--size", "640x360", "--preset", "ultrafast")
    return ["--source", str(scene), *small, "--detector", "motion", "--edge-id", "uav-1"]


def _hvt_edge(scene: Path, folder: Path, *arguments: str, name: str = "edge") -> Running:
    return Running("hvt_edge.cli", [*_words(scene), *arguments], folder=folder, name=name)


def _hvt_ground(fleet: Fleet, who: str, folder: Path, *arguments: str) -> Running:
    common = ["--zenoh-config", str(fleet.file(who)), "--detector", "motion", "--classifier", "none"]
    return Running("hvt_ground.cli", [*common, *arguments], folder=folder, name=who)


TOLD = {
    "guest": "guest.json5 lets it watch uav-1, not command it: no keyframes or stills on demand",
    "stranger": "hvt-ground: 'uav-1' is linked, but nothing of edge uav-1 is seen here: its Zenoh",
    "uav-1": "hvt-edge: no link: ENDPOINT: the other side wants a certificate of this machine, and",
}


@pytest.fixture(scope="module")
def told(fleet: Fleet, scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Running]]:
    """A ground that may only watch, one that the edge does not know, an edge without a certificate: all at once."""
    folder = tmp_path_factory.mktemp("told")
    here, there = (f"tls/127.0.0.1:{port}" for port in free_ports(2))
    bare = fleet.changed("uav-1", connect_certificate=None, connect_private_key=None)
    with _edge(fleet, here), open_session(fleet.settings("base", "ground", listen=(there,))):
        running = {who: _hvt_ground(fleet, who, folder, "--connect", here) for who in ("guest", "stranger")}
        running["uav-1"] = _hvt_edge(
            scene, folder, "--connect", there, "--zenoh-config", str(bare), name="uav-1"
        )
        yield running
        for one in running.values():
            if one.alive:
                one.kill()


@pytest.mark.nightly
@pytest.mark.parametrize("who", TOLD)
def test_who_may_not_is_told_by_its_own_program_and_goes_on(told: dict[str, Running], who: str) -> None:
    """The operator waits for a picture and nothing comes; the engineer beside the drone sees only the drone's log."""
    before, _, after = TOLD[who].partition("ENDPOINT")
    process = told[who]
    process.until(before)
    process.until(after)
    assert process.alive
    process.stop()
    if who == "uav-1":
        assert "uav-1: NOT SENT (" in process.told, "its end says it as well"
        assert "the other side wants a certificate" in process.summary()["unreached"]


def test_an_edge_with_unfit_keys_does_not_start(
    fleet: Fleet, scene: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Exit code 2 and a sentence, so that systemd does not try for ever and the reason is the last line.

    What else keys may lack is in tests/extras/fleet/link/test_diagnose.py.
    """
    file = fleet.file("uav-1")
    asked = ("--connect", "tls/127.0.0.1:9", "--zenoh-config", str(file), "--edge-id", "uav-2")
    assert hvt_edge.cli.main([*_words(scene), *asked]) == 2
    said = capfd.readouterr().err
    assert said.count("\n") == 1, said
    pem = fleet.folder / "uav-1.pem"
    assert said.startswith(
        f"hvt-edge: --edge-id uav-2: {pem} is the certificate of 'uav-1', which may write as 'uav-1' only"
    )


def test_a_ground_that_gets_no_answer_on_control_is_told(
    fleet: Fleet, free_port: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Its keyframe requests would go nowhere, and the picture would come back only by the clock."""
    from hvt_ground.session.subscribe import GroundLink

    caplog.set_level(logging.WARNING)
    endpoint = f"tls/127.0.0.1:{free_port}"
    settings = LinkSettings("ground", connect=(endpoint,), zenoh_config=fleet.bold("base"))
    with _edge(fleet, endpoint), open_session(settings) as session, GroundLink(session, edges="*") as link:
        eventually(link.ports, what="the edge is seen")
        (port,) = link.ports()
        for _ in range(3):
            port.request_keyframe()
            time.sleep(0.1)
        eventually(lambda: "uav-1 does not answer on control" in caplog.text, what="it is said")
    assert "this ground may lack the right to command it (hvt-ground keys list" in caplog.text
