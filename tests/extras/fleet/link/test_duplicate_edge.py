"""Whether another edge of the same id lives on the link."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import zenoh

from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.transport.session import open_session, serve
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_fleet.link import duplicate_edge
from hvt_fleet.link.duplicate_edge import living_edge
from programs.processes import eventually
from rigs.flight import Flight

KEYS = EdgeKeys("uav-1")
PATIENCE = 12.0
"""Who is there answers at once, but on a busy machine."""


@pytest.fixture(scope="module")
def info() -> bytes:
    return Flight(1).info().pack()


@pytest.fixture
def endpoint(free_port: int) -> str:
    return f"tcp/127.0.0.1:{free_port}"


@pytest.fixture
def ground(endpoint: str) -> Iterator[zenoh.Session]:
    with open_session(LinkSettings("ground", listen=(endpoint,))) as session:
        yield session


@contextmanager
def edge(
    ground: zenoh.Session, endpoint: str, info: bytes, *, leaves_after: int = 0
) -> Iterator[threading.Event]:
    """An edge that answers, until it was asked so many times; then it withdraws. Its ground knows it."""
    left = threading.Event()
    with open_session(LinkSettings("edge", connect=(endpoint,), name="uav-1")) as session:
        asked = 0

        def answer(_question: bytes) -> bytes:
            nonlocal asked
            asked += 1
            if asked == leaves_after:
                left.set()
            return info

        serve(session, Channel.INFO, keys=KEYS, answer=answer)
        token = session.liveliness().declare_token(KEYS[Channel.ALIVE])
        eventually(lambda: list(ground.liveliness().get(KEYS[Channel.ALIVE], timeout=20.0)))
        leaver = threading.Thread(target=lambda: left.wait(60) and token.undeclare(), daemon=True)
        leaver.start()
        yield left
        left.set()
        leaver.join(60)


def test_an_edge_that_goes_on_is_found(ground, endpoint, info, monkeypatch):
    """Two drones would fight for one screen."""
    monkeypatch.setattr(duplicate_edge, "LEAVING_S", 0.1)
    settings = LinkSettings("edge", connect=(endpoint,), name="uav-1")
    assert living_edge(settings, KEYS, patience=PATIENCE) is None
    with edge(ground, endpoint, info):
        found = living_edge(settings, KEYS, patience=PATIENCE)
    assert found is not None
    assert found.pack() == info


def test_an_edge_that_says_goodbye_does_not_refuse_its_successor(ground, endpoint, info):
    """A service that restarts its edge would find it gone for good: exit code 2, because of the one it replaces."""
    with edge(ground, endpoint, info, leaves_after=2) as left:
        assert (
            living_edge(LinkSettings("edge", connect=(endpoint,), name="uav-1"), KEYS, patience=PATIENCE)
            is None
        )
        assert left.is_set()
