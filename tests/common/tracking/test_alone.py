"""What is thought of an object that only one of two observers sees."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.tracking.alone import Recall

CONFIDENCES = np.linspace(0, 1, 101)


def heard(*pictures: tuple[int, int]) -> Recall:
    """Of an observer who reported so many of so many that were surely there, three pictures a second."""
    recall = Recall()
    for number, (reported, there) in enumerate(pictures):
        recall.take(reported=reported, there=there, at_s=number / 3)
    return recall


def test_silence_says_nothing_of_an_observer_that_is_not_known():
    """An edge that reports moving objects alone would empty the ground's list of parked cars."""
    for recall in (heard(), heard((1, 1)), heard((3, 10), (4, 10)), heard((0, 0))):
        assert (recall.share, recall.least_confidence) == (0.0, 0.0)
        np.testing.assert_allclose(recall.real(CONFIDENCES), CONFIDENCES)


def test_who_reports_nearly_all_is_believed_against_the_weak():
    """Of the base's errors at a thin link most have a confidence of .4 to .7."""
    recall = heard(*[(9, 10)] * 60)
    assert recall.share == pytest.approx(0.9, abs=0.01)
    assert recall.least_confidence == pytest.approx(0.8, abs=0.02)
    assert heard((60, 60)).least_confidence > 0.8, "a crowd tells at once"
    assert heard(*[(600, 600)] * 60).least_confidence < 0.82, "but nobody sees all of what is hard to see"


def test_the_newest_seconds_count():
    """An edge whose detector was changed by command, or that has flown on, would be judged by what was."""
    recall = heard(*[(10, 10)] * 100, *[(0, 10)] * 30)
    assert recall.share == 0.0
    recall = heard(*[(10, 10)] * 100)
    recall.take(reported=0, there=1, at_s=200)
    assert recall.share == 0.0, "minutes ago"


@given(st.lists(st.tuples(st.integers(0, 80), st.integers(0, 80)), max_size=30))
def test_what_is_listed_is_as_likely_as_the_formula_says(counts):
    """Whatever was counted, nobody is believed more than a detector, and the border is where the formula puts it."""
    recall = heard(*[(min(pair), max(pair)) for pair in counts])
    real = recall.real(CONFIDENCES)
    assert (real <= CONFIDENCES + 1e-12).all()
    assert (np.diff(real) >= -1e-12).all()
    assert 0 <= recall.share < 1
    if recall.share:
        border = np.array([recall.least_confidence])
        assert recall.real(border)[0] == pytest.approx(0.3)


def test_a_detector_that_is_surer_than_sure_is_sure():
    """One of the user's own may count from 0 to 100."""
    assert heard((9, 10)).real(np.array([100.0]))[0] == pytest.approx(1)
