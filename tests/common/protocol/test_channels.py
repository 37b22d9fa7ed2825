"""The key table and the edges that a pattern covers."""

from __future__ import annotations

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


@pytest.mark.parametrize("edge", ["", "UAV-1", "uav_1", "a/b", "a" * 33, "uav 1", "*", "uäv", "uav-1\n"])
def test_an_edge_id_outside_the_alphabet_is_one_sentence(edge):
    """A typo would become a key that nobody can subscribe to."""
    with pytest.raises(UserError, match="a-z, 0-9 and '-' are accepted"):
        EdgeKeys(edge)


@pytest.mark.parametrize(
    "key",
    [
        "",
        "hvt",
        "hvt/uav-1",
        "hvt/uav-1/base/x",
        "other/uav-1/base",
        "hvt/UAV/base",
        "hvt/uav-1/nothing",
        "hvt//base",
        "hvt/uav-1/",
        "hvt/*/base",
        "hvt/" + "a" * 33 + "/base",
        "/hvt/uav-1/base",
        "hvt/uav-1/BASE",
    ],
)
def test_a_foreign_key_is_none(key):
    """A stranger's key would end the ground or name a recording."""
    assert parse_key(key) is None


@given(key=st.text(max_size=60))
def test_no_key_raises(key):
    """The same for any text."""
    parse_key(key)


@given(edge=st.from_regex(r"[ab-]{1,8}", fullmatch=True), pattern=PATTERNS)
def test_the_selector_and_the_pattern_agree(edge, pattern):
    """The ground would record edges that were not asked for, or miss some that were."""
    key_expr = zenoh.KeyExpr(selector(Channel.BASE, edges=pattern))
    key = zenoh.KeyExpr(EdgeKeys(edge)[Channel.BASE])
    assert key_expr.includes(key) == matches(edge, edges=pattern)


@pytest.mark.parametrize("pattern", ["", "uav?", "a/b", "[a-z]", "UAV-*", "$*", "a" * 65])
def test_a_pattern_outside_the_alphabet_is_one_sentence(pattern):
    """A pattern that Zenoh reads otherwise would silently match nothing."""
    with pytest.raises(UserError, match="'\\*' for any run"):
        check_edge_pattern(pattern)


def test_the_table_is_whole_and_its_names_are_zenohs():
    """A stream without a delivery would go out with Zenoh's defaults: dropped under load."""
    assert set(DELIVERIES) == set(Channel)
    for delivery in DELIVERIES.values():
        assert hasattr(zenoh.Priority, delivery.priority)
        assert hasattr(zenoh.CongestionControl, delivery.congestion)


def test_no_priority_carries_both_blocking_and_dropping_rows():
    """They disturb each other: a full queue of one would stall the other."""
    seen = defaultdict(set)
    for delivery in DELIVERIES.values():
        if delivery.direction is not Direction.PRESENCE:
            seen[delivery.priority].add(delivery.congestion)
    assert all(len(kinds) == 1 for kinds in seen.values()), dict(seen)


def test_stills_yield_to_video_and_video_to_commands():
    """A keyframe request would wait behind the stills that the operator does not care about now."""
    order = [
        "REAL_TIME",
        "INTERACTIVE_HIGH",
        "INTERACTIVE_LOW",
        *("DATA_HIGH", "DATA", "DATA_LOW", "BACKGROUND"),
    ]
    rank = {row: order.index(delivery.priority) for row, delivery in DELIVERIES.items()}
    assert rank[Channel.CONTROL] < rank[Channel.STATUS] < rank[Channel.BASE] < rank[Channel.ROI]
