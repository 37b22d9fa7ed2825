"""What is thought of an object that only one of two observers sees."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.tracking.recall import Recall

CONFIDENCES = np.linspace(0, 1, 101).tolist()
CAR, PERSON, BUS = range(3)


def take(recall, at_s, *counts):
    """Of each class (class id, how many were reported, how many were there)."""
    ids = [one for class_id, _, there in counts for one in [class_id] * there]
    reported = [number < some for _, some, there in counts for number in range(there)]
    recall.take(np.array(ids, np.int32), reported=np.array(reported, bool), at_s=at_s)


def heard(*pictures):
    """Of an observer who reported so many cars of so many that were surely there, three pictures a second."""
    recall = Recall()
    for number, (reported, there) in enumerate(pictures):
        take(recall, number / 3, (CAR, reported, there))
    return recall


def test_silence_says_nothing_of_an_observer_that_is_not_known():
    """An edge that reports moving objects alone would empty the ground's list of parked cars."""
    for recall in (heard(), heard((1, 1)), heard((3, 10), (4, 10)), heard((0, 0))):
        assert (recall.share(CAR), recall.least_confidence(CAR)) == (0.0, 0.0)
        assert [recall.real(one, CAR) for one in CONFIDENCES] == pytest.approx(CONFIDENCES)


def test_who_reports_nearly_all_is_believed_against_the_weak():
    """Of the base's errors at a thin link most have a confidence of .4 to .7."""
    recall = heard(*[(9, 10)] * 60)
    assert recall.share(CAR) == pytest.approx(0.9, abs=0.01)
    assert recall.least_confidence(CAR) == pytest.approx(0.8, abs=0.02)
    assert heard((60, 60)).least_confidence(CAR) > 0.8, "a crowd tells at once"
    assert heard(*[(600, 600)] * 60).least_confidence(CAR) < 0.82, "nobody sees all of what is hard to see"


def test_who_reports_each_car_may_know_no_people():
    """Beside forty cars the people whom the edge's small network never finds would be taken off the list."""
    recall = heard(*[(40, 40)] * 30)
    assert recall.least_confidence(PERSON) > 0.8, "of a class of which nothing is known the others speak"
    for number in range(9):
        take(recall, 10 + number / 3, (CAR, 40, 40), (PERSON, 0, 5))
    assert recall.least_confidence(PERSON) == 0
    assert recall.least_confidence(CAR) > 0.8
    assert recall.least_confidence(BUS) > 0.7


def test_a_share_at_the_border_does_not_come_and_go():
    """All that only the ground sees would appear and vanish together."""
    recall = heard(*[(6, 10)] * 60)
    assert recall.share(CAR)
    shares = []
    for number in range(300):
        take(recall, 20 + number / 3, (CAR, 4 + number % 2, 10))
        shares.append(recall.share(CAR))
    assert min(shares) > 0.4
    assert min(shares) < 0.5
    for number in range(60):
        take(recall, 120 + number / 3, (CAR, 3, 10))
    assert recall.share(CAR) == 0


def test_the_newest_seconds_count():
    """An edge whose detector was changed by command, or that has flown on, would be judged by what was."""
    recall = heard(*[(10, 10)] * 100, *[(0, 10)] * 40)
    assert recall.share(CAR) == 0.0
    recall = heard(*[(10, 10)] * 100)
    take(recall, 200, (CAR, 0, 1))
    assert recall.share(CAR) == 0.0, "minutes ago"


@settings(max_examples=30)
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 80), st.integers(0, 80)), max_size=30))
def test_what_is_listed_is_as_likely_as_the_formula_says(counts):
    """Whatever was counted, nobody is believed more than a detector, and the border is where the formula puts it."""
    recall = Recall()
    for number, (class_id, one, other) in enumerate(counts):
        take(recall, number / 3, (class_id, min(one, other), max(one, other)))
    for class_id in range(5):
        real = np.array([recall.real(one, class_id) for one in CONFIDENCES])
        assert (real <= np.array(CONFIDENCES) + 1e-12).all()
        assert (np.diff(real) >= -1e-12).all()
        assert 0 <= recall.share(class_id) <= 0.9
        if recall.share(class_id):
            assert recall.real(recall.least_confidence(class_id), class_id) == pytest.approx(0.3)


def test_a_detector_that_is_surer_than_sure_is_sure():
    """One of the user's own may count from 0 to 100."""
    assert heard((9, 10)).real(100.0, CAR) == pytest.approx(1)
