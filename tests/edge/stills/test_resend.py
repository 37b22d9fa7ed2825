"""Stills that a ground asks for once more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.values import Still
from hvt_edge.perception.candidates import Candidate
from hvt_edge.stills.crop_job import CropJob
from hvt_edge.stills.outbox import PendingStill
from hvt_edge.stills.policy.base import Request
from hvt_edge.stills.resend import ResendRing, ResendSettings

SECOND_NS = 1_000_000_000
_BOX = (0.0, 0.0, 10.0, 10.0)
_CANDIDATE = Candidate(0, 1, _BOX, _BOX, 0, "car", 0.5, 0.1, 100.0, 0)
_DRAFT = Still(0, 0, 0, 1, _BOX, (0, 0, 10, 10), "car", 0.5, "again", "jpeg", 65, b"")


def kept(side: int = 10) -> PendingStill:
    """A still's crop of ``3 * side * side`` bytes."""
    cut = CropJob(_DRAFT, np.zeros((side, side, 3), np.uint8), None, None)
    return PendingStill(Request(_CANDIDATE, "test", 1.0), cut, 0, again=True)


def test_only_what_was_sent_and_is_asked_for_comes_back_once():
    """Stills would be sent twice, or none at all."""
    ring = ResendRing()
    ring.backlog(3, kept(), now_ns=0)
    ring.backlog(4, kept(), now_ns=0)
    for sequence in (4, 3, 4, 99, -1):
        ring.ask(sequence)
    assert [sequence for sequence, _ in ring.take(1)] == [3, 4]
    for sequence in (3, 4):
        ring.ask(sequence)
    assert ring.take(2) == []
    assert (len(ring), ring.size_bytes) == (0, 0)


def test_what_is_too_old_is_forgotten():
    """The operator would get an object as it was long ago."""
    ring = ResendRing(ResendSettings(max_age_ns=4 * SECOND_NS))
    ring.backlog(0, kept(), now_ns=0)
    ring.backlog(1, kept(), now_ns=SECOND_NS)
    ring.ask(0)
    ring.ask(1)
    assert [sequence for sequence, _ in ring.take(5 * SECOND_NS)] == [1]
    assert len(ring) == 0


@given(
    st.lists(st.tuples(st.integers(1, 40), st.lists(st.integers(-3, 80), max_size=30)), max_size=60),
    st.integers(1, 8),
    st.integers(300, 9_000),
)
def test_whatever_grounds_ask_the_memory_is_bounded(stills, count, size_bytes):
    """A hostile or broken ground would fill the drone's memory, or crash the edge."""
    ring = ResendRing(ResendSettings(max_count=count, max_bytes=size_bytes, max_age_ns=5))
    taken = []
    for sequence, (side, asked) in enumerate(stills):
        ring.backlog(sequence, kept(side), now_ns=sequence)
        for one in asked:
            ring.ask(one)
        assert len(ring) <= count
        assert ring.size_bytes <= size_bytes
        assert len(ring._asked) <= len(ring)
        if sequence % 3 == 0:
            taken += [one for one, _ in ring.take(sequence)]
            assert ring.size_bytes == sum(one.size_bytes for one in ring._kept.values())
    assert len(set(taken)) == len(taken)


def test_a_crop_larger_than_all_the_memory_is_not_kept():
    """The ring would loop for ever, or break its bound."""
    ring = ResendRing(ResendSettings(max_bytes=100))
    ring.backlog(0, replace(kept(), since_ns=1), now_ns=0)
    assert (len(ring), ring.size_bytes) == (0, 0)
