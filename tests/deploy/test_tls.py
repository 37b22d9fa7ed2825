"""The documented way to keys: the files of ``hvt-ground keys``, over real sessions and a real router."""

import threading
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from hvt_common.protocol.channels import Channel, EdgeKeys, selector
from hvt_common.transport.session import declare_publisher, open_session, query, serve
from programs.fleet_keys import Fleet
from programs.processes import eventually, router

EDGES = ("rov-1", "uav-1")
WRITTEN = (Channel.BASE, Channel.ROI, Channel.TRACKS, Channel.STATUS)

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Fleet:
    """Two edges, a ground for all, a guest that watches one of them, and a router."""
    fleet = Fleet(tmp_path_factory.mktemp("keys") / "own")
    for edge in EDGES:
        fleet.keys("add-edge", edge, "--host", "127.0.0.1")
    fleet.keys("add-ground", "base", "--host", "127.0.0.1")
    fleet.keys("add-ground", "guest", "--watch-only", "--edges", "uav-*")
    fleet.keys("add-router", "hub", "--host", "127.0.0.1")
    return fleet


class _Edge:
    """All that an edge declares."""

    def __init__(self, session: zenoh.Session, name: str) -> None:
        self.session, self.keys = session, EdgeKeys(name)
        self.reports: list[bytes] = []
        self.publishers = {row: declare_publisher(session, row, keys=self.keys) for row in WRITTEN}
        for row in (Channel.INFO, Channel.CONTROL):
            serve(session, row, keys=self.keys, answer=lambda _question, row=row: f"{row} of {name}".encode())
        session.declare_subscriber(
            self.keys[Channel.FEEDBACK], lambda sample: self.reports.append(sample.payload.to_bytes())
        )
        self._token = session.liveliness().declare_token(self.keys[Channel.ALIVE])

    def wanted(self) -> bool:
        return all(one.matching_status.matching for one in self.publishers.values())  # type: ignore[attr-defined]

    def write(self) -> None:
        for row, publisher in self.publishers.items():
            publisher.put(self.keys[row].encode())


class _Ground:
    """All that a ground declares, and what came of it."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session
        self.came: list[str] = []
        for row in (*WRITTEN, Channel.ALIVE):
            take = lambda sample: self.came.append(str(sample.key_expr))  # noqa: E731
            if row is Channel.ALIVE:
                session.liveliness().declare_subscriber(selector(row), take, history=True)
            else:
                session.declare_subscriber(selector(row), take)

    def answered(self, row: Channel, *expected: bytes | None) -> None:
        """Each edge answers so, on a busy machine at another try; who must not, at none."""

        def asked() -> bool:
            found = [
                b"".join(query(self.session, row, keys=EdgeKeys(edge), question=b"", timeout_s=2)) or None
                for edge in EDGES
            ]
            assert not any(one for one, wanted in zip(found, expected, strict=True) if wanted is None), found
            return found == list(expected)

        eventually(asked, what=f"{row} is answered with {expected}")

    def report(self, text: bytes) -> None:
        for edge in EDGES:
            self.session.put(EdgeKeys(edge)[Channel.FEEDBACK], text)


def _all(edges: tuple[str, ...]) -> set[str]:
    return {EdgeKeys(edge)[row] for edge in edges for row in (*WRITTEN, Channel.ALIVE)}


@pytest.mark.parametrize("links", [1, 2])
def test_through_a_router_each_ground_gets_what_is_its_own(fleet: Fleet, free_port: int, links: int) -> None:
    """Behind a router an edge cannot tell who asks: the router has to keep the rights, row by row, on each link."""
    endpoint = f"tls/127.0.0.1:{free_port}"
    with ExitStack() as stack:
        stack.enter_context(router("--zenoh-config", str(fleet.file("hub")), "--listen", endpoint))

        def opened(name: str, role: str) -> zenoh.Session:
            settings = fleet.settings(name, role, connect=(endpoint,))  # type: ignore[arg-type]
            return stack.enter_context(open_session(replace(settings, links=links)))  # type: ignore[arg-type]

        edges = {name: _Edge(opened(name, "edge"), name) for name in EDGES}
        base, guest = _Ground(opened("base", "ground")), _Ground(opened("guest", "ground"))
        eventually(lambda: all(edge.wanted() for edge in edges.values()), what="the streams are wanted")
        eventually(
            lambda: all(len(edge.session.info.links()) == links for edge in edges.values()),
            what="all links stand",
        )
        eventually(lambda: EdgeKeys("uav-1")[Channel.ALIVE] in guest.came, what="the guest sees the edge")

        def came(ground: _Ground, names: tuple[str, ...]) -> bool:
            for edge in edges.values():  # again: that one ground wants a stream says nothing of the other
                edge.write()
            return set(ground.came) == _all(names)

        eventually(lambda: came(base, EDGES), what="the ground has all rows of both")
        eventually(lambda: came(guest, ("uav-1",)), what="the guest has all rows of its edge, and no more")
        base.answered(Channel.INFO, b"info of rov-1", b"info of uav-1")
        base.answered(Channel.CONTROL, b"control of rov-1", b"control of uav-1")
        guest.answered(Channel.INFO, None, b"info of uav-1")
        guest.answered(Channel.CONTROL, None, None)
        guest.report(b"guest")
        base.report(b"base")
        eventually(lambda: b"base" in edges["rov-1"].reports, what="the ground's report arrives")
        eventually(lambda: set(edges["uav-1"].reports) == {b"base", b"guest"}, what="both reports arrive")
        assert edges["rov-1"].reports == [b"base"]


def test_a_router_says_who_is_not_named(fleet: Fleet, tmp_path: Path, free_port: int) -> None:
    """A new drone on an old router file: nothing arrives, and the router is the one that drops it."""
    endpoint = f"tls/127.0.0.1:{free_port}"
    old = fleet.file("hub").read_text()
    try:
        fleet.keys("add-edge", "new-1")
        file = tmp_path / "old.json5"
        file.write_text(old)
        with (
            router("--zenoh-config", str(file), "--listen", endpoint) as running,
            open_session(fleet.settings("new-1", "edge", connect=(endpoint,))),
        ):
            assert running.stderr is not None
            lines: list[str] = []
            stream = running.stderr
            threading.Thread(target=lambda: lines.append(stream.readline()), daemon=True).start()
            eventually(lambda: lines, what="the router says it")
            assert (
                f"'new-1' has a certificate of this CA, but {file} does not name it: what it sends is dropped"
                in lines[0]
            )
    finally:
        fleet.keys("remove", "new-1")
