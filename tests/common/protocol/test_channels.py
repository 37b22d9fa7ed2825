"""The key table and the edges that a pattern covers."""

from collections import defaultdict

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.errors import UserError
from hvt_common.protocol.channels import (
    DELIVERIES,
    Channel,
    Direction,
    EdgeKeys,
    check_edge_pattern,
    matches,
    parse_key,
    selector,
)

EDGE_IDS = st.from_regex(r"[a-z0-9-]{1,32}", fullmatch=True)
PATTERNS = st.from_regex(r"[ab*-]{1,8}", fullmatch=True)


@given(edge=EDGE_IDS, row=st.sampled_from(Channel))
def test_a_key_parses_back(edge, row):
    """The ground would not know which edge a message is from."""
    assert parse_key(EdgeKeys(edge)[row]) == (edge, row)


@pytest.mark.parametrize(
    ("take", "says", "wrong"),
    [
        (
            *(EdgeKeys, "a-z, 0-9 and '-' are accepted"),
            ["", "UAV-1", "uav_1", "a/b", "a" * 33, "uav 1", "*", "uäv", "uav-1\n"],
        ),
        (*(check_edge_pattern, "'\\*' for any run"), ["", "uav?", "a/b", "[a-z]", "UAV-*", "$*", "a" * 65]),
    ],
)
def test_an_edge_id_or_pattern_outside_the_alphabet_is_one_sentence(take, says, wrong):
    """A slash or a star in a name would put messages under another edge's key, or match none."""
    for one in wrong:
        with pytest.raises(UserError, match=says):
            take(one)


def test_a_foreign_key_is_none():
    """Another program under the same router would be taken for an edge."""
    for key in (
        "",
        f"hvt/{'a' * 33}/base",
        *["hvt", "hvt/uav-1", "hvt/uav-1/base/x", "other/uav-1/base", "hvt/UAV/base", "hvt/uav-1/nothing"],
        *["hvt//base", "hvt/uav-1/", "hvt/*/base", "/hvt/uav-1/base", "hvt/uav-1/BASE"],
    ):
        assert parse_key(key) is None


@given(edge=st.from_regex(r"[ab-]{1,8}", fullmatch=True), pattern=PATTERNS)
def test_the_selector_and_the_pattern_agree(edge, pattern):
    """The ground would record edges that were not asked for, or miss some that were."""
    key_expr = zenoh.KeyExpr(selector(Channel.BASE, edges=pattern))
    key = zenoh.KeyExpr(EdgeKeys(edge)[Channel.BASE])
    assert key_expr.includes(key) == matches(edge, edges=pattern)


def test_the_table_is_whole_and_its_priorities_hold():
    """A row would have no priority; a dropped one would block, or stills would delay video, and video commands."""
    assert set(DELIVERIES) == set(Channel)
    seen = defaultdict(set)
    for delivery in DELIVERIES.values():
        assert hasattr(zenoh.Priority, delivery.priority)
        assert hasattr(zenoh.CongestionControl, delivery.congestion)
        if delivery.direction is not Direction.PRESENCE:
            seen[delivery.priority].add(delivery.congestion)
    assert all(len(kinds) == 1 for kinds in seen.values()), dict(seen)
    order = [
        "REAL_TIME",
        "INTERACTIVE_HIGH",
        "INTERACTIVE_LOW",
        "DATA_HIGH",
        "DATA",
        "DATA_LOW",
        "BACKGROUND",
    ]
    rank = {row: order.index(delivery.priority) for row, delivery in DELIVERIES.items()}
    assert rank[Channel.CONTROL] < rank[Channel.STATUS] < rank[Channel.BASE] < rank[Channel.ROI]
