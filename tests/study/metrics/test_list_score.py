"""The score of lists, against counts done by hand."""

from __future__ import annotations

import numpy as np
import pytest

from hvt_common.inference.class_names import same_kind
from hvt_study.metrics.list_score import Listed, ListScore, score_lists


def listed(*rows, ignored=()):
    """Rows of (x, y, side, class)."""
    boxes = np.array([[x, y, x + side, y + side] for x, y, side, _ in rows], np.float32).reshape(-1, 4)
    regions = np.array([[x, y, x + side, y + side] for x, y, side in ignored], np.float32).reshape(-1, 4)
    return Listed(boxes, tuple(name for *_, name in rows), regions)


def test_counts():
    """The figures of every table hang on these four."""
    truth = listed((0, 0, 10, "car"), (100, 0, 10, "bus"), (200, 0, 10, "car"))
    shown = listed((1, 0, 10, "car"), (100, 1, 10, "car"), (300, 0, 10, "car"), (400, 0, 10, "car"))
    score = score_lists([(truth, shown)])
    assert score == ListScore(matched=2, right=1, wanted=3, shown=4)
    assert score.f1 == pytest.approx(4 / 7)
    assert score.class_agreement == 0.5
    assert (score.precision, score.recall) == (0.5, pytest.approx(2 / 3))


def test_a_box_counts_once():
    """Two boxes on one car are one find and one false alarm, whatever their classes."""
    truth = listed((0, 0, 10, "car"))
    assert score_lists([(truth, listed((0, 0, 10, "car"), (1, 0, 10, "van")))]) == ListScore(1, 1, 1, 2)


def test_as_many_pairs_as_possible():
    """The greatest overlap first would leave the second object without its box."""
    truth = listed((0, 0, 10, "a"), (3, 0, 10, "b"))
    shown = listed((2, 0, 10, "b"), (5.9, 0, 10, "b"))
    assert score_lists([(truth, shown)]).matched == 2


def test_what_nobody_knows_counts_for_nothing():
    """VisDrone leaves regions without labels: a car found there is neither right nor wrong."""
    truth = listed((0, 0, 10, "car"), ignored=[(100, 100, 50)])
    shown = listed((0, 0, 10, "car"), (110, 110, 10, "car"), (145, 145, 20, "car"))
    assert score_lists([(truth, shown)]) == ListScore(1, 1, 1, 2)


def test_ticks_add_up_and_nothing_is_perfect_where_nothing_is():
    """An empty road shown empty must not spoil the score."""
    one, none = listed((0, 0, 10, "car")), listed()
    assert score_lists([(one, one), (one, none), (none, one)]) == ListScore(1, 1, 2, 2)
    assert score_lists([(none, none)]).f1 == 1.0
    assert score_lists([(one, none)]).f1 == 0.0


def test_words_of_two_models_may_mean_the_same():
    """A COCO detector on VisDrone labels calls a van a car."""
    pair = (listed((0, 0, 10, "van")), listed((0, 0, 10, "car")))
    assert score_lists([pair]).right == 0
    assert score_lists([pair], same_class=same_kind).right == 1
