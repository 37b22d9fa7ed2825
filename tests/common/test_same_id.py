"""Whether another edge of the same id lives on the link."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from flight import Flight
from hvt_common.link.keys import EdgeKeys, Row
from hvt_common.link.same_id import living_edge
from hvt_common.link.session import open_session, serve
from hvt_common.link.zenoh_config import LinkSettings

KEYS = EdgeKeys("uav-1")


@pytest.fixture(scope="module")
def info() -> bytes:
    """What an edge says of itself."""
    return Flight(1).info().pack()


@pytest.fixture
def endpoint(free_port: int) -> Iterator[str]:
    """Of a ground."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with open_session(LinkSettings("ground", listen=(endpoint,))):
        yield endpoint


@contextmanager
def edge(endpoint: str, info: bytes, *, leaves_after: int | None = None) -> Iterator[threading.Event]:
    """An edge that answers, until it was asked so many times; then it withdraws."""
    left = threading.Event()
    with open_session(LinkSettings("edge", connect=(endpoint,), name="uav-1")) as session:
        token = session.liveliness().declare_token(KEYS.key(Row.ALIVE))
        asked = 0

        def answer(_question: bytes) -> bytes:
            nonlocal asked
            asked += 1
            if asked == leaves_after:
                left.set()
            return info

        serve(session, Row.INFO, keys=KEYS, answer=answer)
        leaver = threading.Thread(target=lambda: left.wait(30) and token.undeclare(), daemon=True)
        leaver.start()
        yield left
        left.set()
        leaver.join(5)


def test_an_edge_that_goes_on_is_found(endpoint, info):
    """Two drones would fight for one screen."""
    settings = LinkSettings("edge", connect=(endpoint,), name="uav-1")
    assert living_edge(settings, KEYS) is None
    with edge(endpoint, info):
        found = living_edge(settings, KEYS)
    assert found is not None
    assert found.pack() == info


def test_an_edge_that_says_goodbye_does_not_refuse_its_successor(endpoint, info):
    """A service that restarts its edge would find it gone for good: exit code 2, because of the one it replaces."""
    with edge(endpoint, info, leaves_after=2) as left:
        assert living_edge(LinkSettings("edge", connect=(endpoint,), name="uav-1"), KEYS) is None
        assert left.is_set()
