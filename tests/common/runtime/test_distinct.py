"""Counting different ids."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from hvt_common.runtime.distinct import DistinctIds


@given(st.lists(st.lists(st.integers(0, 40), max_size=5)))
def test_each_id_counts_once(groups):
    """The summary would count a track once a frame."""
    ids, seen = DistinctIds(), set()
    for group in groups:
        assert ids.add(group) == len(set(group) - seen)
        seen |= set(group)
        assert ids.count == len(seen)


def test_memory_is_bounded_and_old_ids_count_as_seen():
    """An hour of flight would fill the memory; or a still replayed after minutes would count again."""
    ids = DistinctIds(remember=10)
    for number in range(1_000):
        assert ids.add([number, number - 1]) == (1 if number else 2)
    assert ids.count == 1_001
    assert len(ids._seen) <= 20
    assert ids.add([3, 999, -5]) == 0
    assert ids.add([1_000]) == 1
