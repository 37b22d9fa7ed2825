"""Who of a group serves which edge."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from unittest.mock import MagicMock

import pytest
import zenoh

from hvt_common.errors import UserError
from hvt_common.protocol.channels import Channel, EdgeKeys, GroupKeys
from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_ground.link.group import GroundGroup, member_name, owner_of
from programs.fleet_keys import Fleet
from programs.processes import eventually, free_ports

EDGES = [f"uav-{number}" for number in range(1000)]
MEMBERS = [f"base-{number}" for number in range(40)]


def test_edges_are_spread_evenly():
    """One ground would carry half of the fleet."""
    load = Counter(owner_of(edge, MEMBERS) for edge in EDGES)
    assert set(load) == set(MEMBERS)
    assert max(load.values()) < 2 * len(EDGES) / len(MEMBERS)


def test_only_the_edges_of_who_leaves_move():
    """Each change would interrupt the recordings of the whole fleet."""
    rest = [one for one in MEMBERS if one != "base-7"]
    for edge in EDGES:
        before = owner_of(edge, MEMBERS)
        if before != "base-7":
            assert owner_of(edge, rest) == before


def test_names_are_usable_as_keys():
    """A machine whose name has capitals or dots could take no part."""
    keys = GroupKeys("north")
    assert keys.parse(keys.claim(member_name(), "uav-1")) is not None
    assert keys.parse("hvt-group/south/base-1") is None
    assert keys.parse("hvt-group/north/base-1/uav-1/more") is None
    assert keys.parse("hvt-group/north/BASE") is None
    with pytest.raises(UserError, match="group 'N O' is not usable"):
        GroupKeys("N O")


@pytest.fixture
def sessions() -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    """Two grounds on one link."""
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    with (
        open_session(LinkSettings("ground", (endpoint,), ())) as one,
        open_session(LinkSettings("ground", (), (endpoint,))) as other,
    ):
        yield one, other


def served(group: GroundGroup, edges: list[str]) -> set[str]:
    return {edge for edge in edges if group.serves(edge)}


def test_each_edge_is_served_once_and_by_another_when_its_member_goes(sessions):
    """Two recordings of one flight, or none."""
    edges = EDGES[:12]
    with GroundGroup(sessions[0], "north", member="base-a") as first:
        eventually(lambda: served(first, edges) == set(edges), what="it serves all alone")
        with GroundGroup(sessions[1], "north", member="base-b") as second:
            eventually(lambda: first.members == second.members == ("base-a", "base-b"), what="both know")
            mine = {edge for edge in edges if owner_of(edge, first.members) == "base-a"}
            assert 0 < len(mine) < len(edges)
            assert served(first, edges) == mine
            for _ in range(20):
                assert served(second, edges) == set(), "the former member has not released them"
            for edge in edges:
                first.release(edge)
            eventually(lambda: served(second, edges) == set(edges) - mine, what="they have moved")
            assert served(first, edges) == mine
            assert set(first.elsewhere) == set(edges) - mine
        eventually(lambda: served(first, edges) == set(edges), what="they are back")
        assert not first.elsewhere


def test_a_claim_that_has_to_give_way_interrupts_nothing(sessions):
    """A recording would be split each time a link comes back and tokens arrive out of order."""
    edge = next(one for one in EDGES if owner_of(one, ("base-a", "base-b")) == "base-a")
    with GroundGroup(sessions[0], "north", member="base-a") as group:
        eventually(lambda: group.serves(edge), what="it is served")
        claim = sessions[1].liveliness().declare_token(GroupKeys("north").claim("base-b", edge))
        eventually(lambda: edge in group.elsewhere, what="the other claim is known")
        assert group.serves(edge)
        claim.undeclare()


def test_an_edge_that_its_member_does_not_accept_is_served_by_another(sessions, caplog):
    """With two patterns of --edges in a group the flights of most edges were recorded and shown by nobody."""
    edge = next(one for one in EDGES if owner_of(one, ("base-a", "base-b", "base-c")) == "base-c")
    absent = sessions[0].liveliness().declare_token(GroupKeys("north").member("base-c"))
    with (
        GroundGroup(sessions[0], "north", member="base-a", pass_s=0.5) as first,
        GroundGroup(sessions[1], "north", member="base-b", pass_s=0.5) as second,
    ):
        eventually(lambda: len(first.members) == len(second.members) == 3, what="all are known")
        groups = sorted((first, second), key=lambda one: owner_of(edge, ("base-a", "base-b")) == one.member)

        def share() -> list[bool]:
            for one in groups:
                if not one.serves(edge):
                    one.release(edge)
            return [one.serves(edge) for one in groups]

        eventually(lambda: share() == [False, True], what="one of both serves it")
        assert f"north: base-c does not claim {edge}" in caplog.text
        claim = sessions[0].liveliness().declare_token(GroupKeys("north").claim("base-c", edge))
        eventually(lambda: share() == [False, False], what="it gives way to its member")
        claim.undeclare()
    absent.undeclare()


def test_an_edge_that_comes_back_waits_for_its_member_anew():
    """It was taken from a member that had no time to claim it; and names of edges that are none filled the memory."""
    edge, now_s, session = next(one for one in EDGES if owner_of(one, "ab") == "b"), [0.0], MagicMock()
    group = GroundGroup(session, "north", member="a", clock=lambda: now_s[0])
    on_token = session.liveliness().declare_subscriber.call_args.args[1]
    token = MagicMock(key_expr=GroupKeys("north").member("b"), kind=zenoh.SampleKind.PUT)
    on_token(token)
    for now_s[0] in (5.0, 20.0, 25.0):
        assert not group.serves(edge)
        on_token(token)
        group.forget(except_for=())
    assert not session.liveliness().declare_token.call_args.args[0].endswith(edge)


def test_a_page_is_asked_for_until_it_is_known(sessions):
    """Its tile would lead nowhere for as long as both run."""
    keys = GroupKeys("north")
    with GroundGroup(sessions[0], "north", member="base-a") as group:
        tokens = [
            sessions[1].liveliness().declare_token(key)
            for key in (keys.member("zz"), keys.claim("zz", "uav-1"))
        ]
        eventually(lambda: group.elsewhere, what="the other is known")
        assert group.elsewhere["uav-1"].page == ""
        answers = sessions[1].declare_queryable(
            keys.member("zz"), lambda query: query.reply(keys.member("zz"), b"https://z/")
        )
        eventually(lambda: group.elsewhere["uav-1"].page == "https://z/", what="its page is known")
        for one in (*tokens, answers):
            one.undeclare()


def test_who_comes_and_goes_without_end_does_not_fill_the_log(caplog):
    """Anybody on an open link could fill the disk with the names of grounds that are none."""
    caplog.set_level("INFO")
    session = MagicMock()
    GroundGroup(session, "north", member="base-a", clock=lambda: 1000.0)
    on_token = session.liveliness().declare_subscriber.call_args.args[1]
    for number in range(1000):
        for kind in (zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE):
            on_token(MagicMock(key_expr=GroupKeys("north").member(f"ghost-{number}"), kind=kind))
    assert len(caplog.records) == 60


def test_tokens_of_other_groups_and_nonsense_change_nothing(sessions):
    """Anybody on an open link could take the fleet away."""
    with GroundGroup(sessions[0], "north", member="base-a") as group:
        tokens = [
            sessions[1].liveliness().declare_token(key)
            for key in (
                "hvt-group/south/base-b",
                "hvt-group/north/BAD",
                "hvt-group/north/a/b/c",
                "hvt-group/north/zz",
            )
        ]
        eventually(lambda: "zz" in group.members, what="the last token has come")
        assert group.members == ("base-a", "zz")
        tokens += [
            sessions[1].liveliness().declare_token(f"hvt-group/north/m-{number}/uav-1")
            for number in range(200)
        ]
        tokens += [
            sessions[1].liveliness().declare_token(f"hvt-group/north/n-{number}") for number in range(1200)
        ]
        eventually(lambda: len(group.members) >= 1024, what="more than are taken")
        assert len(group.members) == 1024
        for one in tokens:
            one.undeclare()
        eventually(lambda: group.members == ("base-a",), what="it is gone")


def test_with_keys_grounds_form_a_group_and_edges_take_no_part(tmp_path):
    """The group would be silent behind TLS, or an edge that was stolen could take the fleet away."""
    fleet = Fleet(tmp_path / "own")
    fleet.keys("add-edge", "uav-1")
    fleet.keys("add-ground", "base", "--host", "127.0.0.1")
    fleet.keys("add-ground", "other")
    endpoint = f"tls/127.0.0.1:{free_ports(1)[0]}"
    with (
        open_session(fleet.settings("base", "ground", listen=(endpoint,))) as base,
        open_session(fleet.settings("other", "ground", connect=(endpoint,))) as other,
        open_session(fleet.settings("uav-1", "edge", connect=(endpoint,))) as edge,
    ):
        alive = edge.liveliness().declare_token(EdgeKeys("uav-1")[Channel.ALIVE])
        stolen = edge.liveliness().declare_token(GroupKeys("north").member("zz-stolen"))
        with (
            GroundGroup(base, "north", member="base-a") as first,
            GroundGroup(other, "north", member="base-b") as second,
        ):
            eventually(lambda: first.members == second.members == ("base-a", "base-b"), what="both know")
            token = EdgeKeys("uav-1")[Channel.ALIVE]
            eventually(
                lambda: [one.ok for one in base.liveliness().get(token, timeout=2)],
                what="the edge is there",
            )
            assert "zz-stolen" not in first.members
        alive.undeclare()
        stolen.undeclare()
