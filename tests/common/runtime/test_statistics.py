"""Latency percentiles in bounded memory, against NumPy's."""

import json
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.runtime.statistics import LatencyStats, SequenceWindow

latencies = st.lists(st.floats(0, 1e6, allow_nan=False), min_size=1, max_size=200)


def filled(values_ms):
    stats = LatencyStats()
    for value_ms in values_ms:
        stats.add(float(value_ms))
    return stats


def assert_near(got_ms, wanted_ms):
    """Within the documented error: 0.5 % or 0.01 ms."""
    assert got_ms == pytest.approx(wanted_ms, rel=0.005, abs=0.0101)


@pytest.mark.parametrize("scale_ms", [0.2, 60.0, 4000.0])
def test_percentiles_agree_with_numpy(scale_ms):
    """The delays that the summary shows would be wrong."""
    values = np.random.default_rng(7).lognormal(np.log(scale_ms), 0.8, 20_000)
    stats = filled(values)
    assert len(stats) == 20_000
    for percent in (0, 1, 25, 50, 75, 95, 99, 99.9, 100):
        assert_near(stats.percentile(percent), np.percentile(values, percent))


@given(values=latencies, percent=st.floats(0, 100))
def test_any_percentile_of_any_latencies_agrees_with_numpy(values, percent):
    """Short runs, outliers or repeated values would give a wrong p95."""
    assert_near(filled(values).percentile(percent), np.percentile(values, percent))


@pytest.mark.parametrize(
    ("values_ms", "shown"),
    [
        ([], (None, None, None)),
        ([12.3456], (12.35, 12.35, 12.35)),
        ([1.0, 2.0, 1234.5678], (2.0, pytest.approx(1234.57, rel=0.2), 1234.57)),
        ([-5.0, -0.1, 3.0], (0.0, pytest.approx(3, rel=0.2), 3.0)),
        ([10.0] * 99 + [1e15], (pytest.approx(10, rel=0.005), pytest.approx(10, rel=0.005), 1e15)),
    ],
)
def test_odd_latencies_are_shown_as_json(values_ms, shown):
    """A summary of a flight without pictures would not be written, or one absurd clock spoil all of it."""
    stats = filled(values_ms)
    assert json.loads(json.dumps(stats.as_dict())) == dict(zip(("p50", "p95", "max"), shown, strict=True))
    assert not values_ms or stats.percentile(0) >= 0


def test_memory_does_not_grow_and_what_is_no_number_is_a_bug():
    """An hour's flight would fill the memory; one NaN all percentiles."""
    stats = LatencyStats()
    before = len(pickle.dumps(stats))
    for value in range(10_000):
        stats.add(value * 37.0)
    assert len(pickle.dumps(stats)) < before + 100 < 20_000
    for value in (float("nan"), float("inf"), -float("inf")):
        with pytest.raises(ValueError, match="finite"):
            stats.add(value)


@given(st.lists(st.lists(st.integers(0, 40), max_size=5)))
def test_each_distinct_id_counts_once(groups):
    """The summary would count a track once a frame."""
    ids, seen = SequenceWindow(), set()
    for group in groups:
        assert ids.add(group) == len(set(group) - seen)
        seen |= set(group)
        assert ids.count == len(seen)
