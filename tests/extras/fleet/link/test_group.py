"""Who of a group serves which edge."""

from collections import Counter
from collections.abc import Iterator
from unittest.mock import MagicMock

import pytest
import zenoh

from hvt_common.errors import UserError
from hvt_common.protocol.channels import Channel, EdgeKeys, GroupKeys
from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_fleet.link.group import GroundGroup, member_name, owner_of
from programs.fleet_keys import Fleet
from programs.processes import eventually, free_ports

NORTH, ALIVE = GroupKeys("north"), EdgeKeys("uav-1")[Channel.ALIVE]
EDGES = [f"uav-{number}" for number in range(1000)]
MEMBERS = [f"base-{number}" for number in range(40)]


def test_edges_are_spread_evenly_and_only_those_of_who_leaves_move():
    """One ground would carry half of the fleet, and each change interrupt the recordings of all of it."""
    before = {edge: owner_of(edge, MEMBERS) for edge in EDGES}
    load = Counter(before.values())
    assert set(load) == set(MEMBERS)
    assert max(load.values()) < 2 * len(EDGES) / len(MEMBERS)
    rest = [one for one in MEMBERS if one != "base-7"]
    assert all(owner_of(edge, rest) == one for edge, one in before.items() if one != "base-7")


def test_names_are_usable_as_keys():
    """A machine whose name has capitals or dots could take no part."""
    keys = GroupKeys("north")
    assert keys.parse(keys.claim(member_name(), "uav-1")) is not None
    for key in ("south/base-1", "north/base-1/uav-1/more", "north/BASE"):
        assert keys.parse(f"hvt-group/{key}") is None
    with pytest.raises(UserError, match="group 'N O' is not usable"):
        GroupKeys("N O")


@pytest.fixture
def sessions() -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    with (
        open_session(LinkSettings("ground", (endpoint,), ())) as one,
        open_session(LinkSettings("ground", (), (endpoint,))) as other,
    ):
        yield one, other


def token(session: zenoh.Session, key: str) -> zenoh.LivelinessToken:
    return session.liveliness().declare_token(key)


def edge_of(member: str, *members: str) -> str:
    return next(one for one in EDGES if owner_of(one, members) == member)


def mocked(member: str, clock) -> tuple[GroundGroup, MagicMock]:
    """A member without a link, and the session that it thinks it has."""
    session = MagicMock()
    return GroundGroup(session, "north", member=member, clock=clock), session


def comes(session: MagicMock, member: str, kind=zenoh.SampleKind.PUT) -> None:
    on_token = session.liveliness().declare_subscriber.call_args.args[1]
    on_token(MagicMock(key_expr=NORTH.member(member), kind=kind))


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
    edge = edge_of("base-a", "base-a", "base-b")
    with GroundGroup(sessions[0], "north", member="base-a") as group:
        eventually(lambda: group.serves(edge), what="it is served")
        claim = token(sessions[1], NORTH.claim("base-b", edge))
        eventually(lambda: edge in group.elsewhere, what="the other claim is known")
        assert group.serves(edge)
        claim.undeclare()


def test_an_edge_that_its_member_does_not_accept_is_served_by_another(sessions, caplog):
    """With two patterns of --edges in a group the flights of most edges were recorded and shown by nobody."""
    edge = edge_of("base-c", "base-a", "base-b", "base-c")
    absent = token(sessions[0], NORTH.member("base-c"))
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
        claim = token(sessions[0], NORTH.claim("base-c", edge))
        eventually(lambda: share() == [False, False], what="it gives way to its member")
        claim.undeclare()
    absent.undeclare()


def test_an_edge_that_comes_back_waits_for_its_member_anew():
    """It was taken from a member that had no time to claim it; and names of edges that are none filled the memory."""
    edge, now_s = edge_of("b", "a", "b"), [0.0]
    group, session = mocked("a", lambda: now_s[0])
    comes(session, "b")
    for now_s[0] in (5.0, 20.0, 25.0):
        assert not group.serves(edge)
        comes(session, "b")
        group.forget(except_for=())
    assert not session.liveliness().declare_token.call_args.args[0].endswith(edge)


def test_a_page_is_asked_for_until_it_is_known(sessions):
    """Its tile would lead nowhere for as long as both run."""
    member = NORTH.member("zz")
    with GroundGroup(sessions[0], "north", member="base-a") as group:
        tokens = [token(sessions[1], key) for key in (member, NORTH.claim("zz", "uav-1"))]
        eventually(lambda: group.elsewhere, what="the other is known")
        assert group.elsewhere["uav-1"].page == ""
        answers = sessions[1].declare_queryable(member, lambda query: query.reply(member, b"https://z/"))
        eventually(lambda: group.elsewhere["uav-1"].page == "https://z/", what="its page is known")
        for one in (*tokens, answers):
            one.undeclare()


def test_who_comes_and_goes_without_end_does_not_fill_the_log(caplog):
    """Anybody on an open link could fill the disk with the names of grounds that are none."""
    caplog.set_level("INFO")
    _, session = mocked("base-a", lambda: 1000.0)
    for number in range(1000):
        for kind in (zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE):
            comes(session, f"ghost-{number}", kind)
    assert len(caplog.records) == 60


def test_tokens_of_other_groups_and_nonsense_change_nothing(sessions):
    """Anybody on an open link could take the fleet away."""
    with GroundGroup(sessions[0], "north", member="base-a") as group:
        keys = ("south/base-b", "north/BAD", "north/a/b/c", "north/zz")
        tokens = [token(sessions[1], f"hvt-group/{key}") for key in keys]
        eventually(lambda: "zz" in group.members, what="the last token has come")
        assert group.members == ("base-a", "zz")
        tokens += [token(sessions[1], f"hvt-group/north/m-{number}/uav-1") for number in range(200)]
        tokens += [token(sessions[1], f"hvt-group/north/n-{number}") for number in range(1200)]
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
        there = [token(edge, key) for key in (ALIVE, NORTH.member("zz-stolen"))]
        with (
            GroundGroup(base, "north", member="base-a") as first,
            GroundGroup(other, "north", member="base-b") as second,
        ):
            eventually(lambda: first.members == second.members == ("base-a", "base-b"), what="both know")
            eventually(lambda: list(base.liveliness().get(ALIVE, timeout=2)), what="the edge is there")
            assert "zz-stolen" not in first.members
        for one in there:
            one.undeclare()
