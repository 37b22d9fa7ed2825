"""Latency percentiles in bounded memory, against NumPy's."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.runtime.statistics import LatencyStats, SequenceWindow

latencies = st.lists(st.floats(0, 1e6, allow_nan=False), min_size=1, max_size=200)


def filled(values_ms):
    """Stats of these latencies."""
    stats = LatencyStats()
    for value_ms in values_ms:
        stats.add(float(value_ms))
    return stats


def assert_near(got_ms, wanted_ms):
    """Within the documented error: 0.5 % or 0.01 ms."""
    assert got_ms == pytest.approx(wanted_ms, rel=0.005, abs=0.0101)


@pytest.mark.parametrize("scale_ms", [0.2, 60.0, 4000.0])
def test_percentiles_agree_with_numpy(scale_ms):
    """The latency a user reads in the summary would not be the latency they had."""
    values = np.random.default_rng(7).lognormal(np.log(scale_ms), 0.8, 20_000)
    stats = filled(values)
    for percent in (0, 1, 25, 50, 75, 95, 99, 99.9, 100):
        assert_near(stats.percentile(percent), np.percentile(values, percent))
    assert len(stats) == 20_000


@settings(deadline=None, max_examples=150)
@given(values=latencies, percent=st.floats(0, 100))
def test_any_percentile_of_any_latencies_agrees_with_numpy(values, percent):
    """Short runs, outliers or repeated values would give a wrong p95."""
    assert_near(filled(values).percentile(percent), np.percentile(values, percent))


def test_an_empty_one_has_no_values():
    """A run without a frame would crash its summary, or claim a latency of nought."""
    stats = LatencyStats()
    assert stats.as_dict() == {"p50": None, "p95": None, "max": None}
    assert json.loads(json.dumps(stats.as_dict())) == {"p50": None, "p95": None, "max": None}


def test_the_dictionary_is_rounded_and_json():
    """The JSON summary would not parse, or drown the reader in digits."""
    assert json.loads(json.dumps(filled([12.3456]).as_dict())) == {"p50": 12.35, "p95": 12.35, "max": 12.35}
    assert filled([1.0, 2.0, 1234.5678]).as_dict()["max"] == 1234.57


def test_negative_latencies_count_as_nought():
    """Two clocks that disagree would show a latency below nought."""
    stats = filled([-5.0, -0.1, 3.0])
    assert stats.percentile(0) == 0
    assert stats.as_dict()["max"] == 3.0


def test_absurd_latencies_neither_crash_nor_move_the_median():
    """One forged capture time would end the ground or spoil its summary."""
    stats = filled([10.0] * 99 + [1e15])
    assert_near(stats.percentile(50), 10.0)
    assert stats.as_dict()["max"] == 1e15


def test_memory_does_not_grow():
    """A ground would grow by every frame it ever showed."""
    stats = LatencyStats()
    before = len(pickle.dumps(stats))
    for value in range(10_000):
        stats.add(value * 37.0)
    assert len(pickle.dumps(stats)) < before + 100 < 20_000


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_what_is_no_number_is_a_bug(value):
    """A miscalculated time would silently turn every percentile into nonsense."""
    with pytest.raises(ValueError, match="finite"):
        LatencyStats().add(value)


@given(st.lists(st.lists(st.integers(0, 40), max_size=5)))
def test_each_distinct_id_counts_once(groups):
    """The summary would count a track once a frame."""
    ids, seen = SequenceWindow(), set()
    for group in groups:
        assert ids.add(group) == len(set(group) - seen)
        seen |= set(group)
        assert ids.count == len(seen)
