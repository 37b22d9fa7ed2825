"""Which edges a ground serves where more names come than it takes."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest
import zenoh

from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_ground.session.subscribe import MAX_EDGES, GroundLink
from programs.outsider import joined
from programs.processes import eventually


@pytest.fixture
def link(free_port: int) -> Iterator[tuple[GroundLink, zenoh.Session]]:
    """A ground, and somebody else who is joined to it."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with (
        open_session(LinkSettings("ground", listen=(endpoint,))) as session,
        GroundLink(session, edges="*") as link,
        joined(endpoint) as outsider,
    ):
        yield link, outsider


def invent(outsider: zenoh.Session, count: int) -> None:
    """A message under each of so many names."""
    for number in range(count):
        outsider.put(f"hvt/ghost-{number}/base", b"x", congestion_control=zenoh.CongestionControl.BLOCK)


def served(link: GroundLink) -> set[str]:
    """The names of all ports."""
    return {port.edge for port in link.ports()}


def test_invented_names_do_not_lock_out_a_real_edge(link, caplog):
    """Somebody says 64 names, and the drone that starts afterwards is never shown, without a word."""
    ground, outsider = link
    invent(outsider, MAX_EDGES + 6)
    eventually(lambda: ground.foreign == 6, within_s=20, what="all names have come")
    assert len(served(ground)) == MAX_EDGES
    lines = [one.getMessage() for one in caplog.records if one.levelno == logging.WARNING]
    assert lines == [
        (
            f"ghost-{MAX_EDGES} is not served: there are {MAX_EDGES} edge ids already, and more are not taken; "
            "narrow --edges, or see who invents names (docs/security.md has keys against that)"
        )
    ]
    first = ground.ports()[0]
    with outsider.liveliness().declare_token("hvt/uav-1/alive"):
        eventually(lambda: "uav-1" in served(ground), within_s=20, what="the real one is served")
        assert len(served(ground)) == MAX_EDGES
        assert first.edge not in served(ground)
        assert first.inbox.get(timeout_s=0.1) is not None, "what had come is still there"
        assert ground.is_known("uav-1")


def test_edges_that_are_there_or_have_flown_keep_their_place(link):
    """A stranger's token would end a flight, or take its summary."""
    ground, outsider = link
    tokens = [
        outsider.liveliness().declare_token(f"hvt/real-{number}/alive") for number in range(MAX_EDGES - 1)
    ]
    eventually(lambda: len(served(ground)) == MAX_EDGES - 1, within_s=20, what="all are seen")
    invent(outsider, 1)
    eventually(lambda: "ghost-0" in served(ground), within_s=20, what="one more")
    (ghost,) = [port for port in ground.ports() if port.edge == "ghost-0"]
    ghost.used.set()
    with outsider.liveliness().declare_token("hvt/late/alive"):
        eventually(lambda: ground.foreign == 1, within_s=20, what="it is refused")
    assert "late" not in served(ground)
    for token in tokens:
        token.undeclare()
