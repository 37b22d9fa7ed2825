"""How many objects more or fewer the ground shows than were found here."""

from __future__ import annotations

import pytest

from hvt_edge.perception.shadow import Detected, GroundDifference

SECOND_NS = 1_000_000_000
FPS = 15


def difference(*counts: int, here: float = 10, receiver_id: int = 1) -> GroundDifference:
    """Compared once a second, a report of each at once."""
    return told(GroundDifference(), *counts, here=here, receiver_id=receiver_id)


def told(
    one: GroundDifference, *counts: int, at_s: int = 0, here: float = 10, receiver_id: int = 1
) -> GroundDifference:
    """It goes on."""
    for second, count in enumerate(counts, at_s):
        one.expect(second * FPS, here, capture_ns=second * SECOND_NS)
        one.take(Detected(receiver_id, second * FPS + 2, count))
    return one


def test_the_mean_of_what_was_reported_after_the_first_second():
    """The first picture of a stream is coarse: each flight would begin as if the ground saw little."""
    assert difference(2).mean is None
    assert difference(2, 12).mean == pytest.approx(2)
    assert difference(2, 12, 14).mean == pytest.approx(3.06, abs=0.01), "the newer counts a little more"


def test_a_report_counts_for_the_picture_that_it_covers():
    """A scene that fills or empties would be a difference between two detectors."""
    one = difference(10, 10)
    one.expect(40, 30, capture_ns=3 * SECOND_NS)
    one.take(Detected(1, 39, 10))
    assert one.mean == 0, "it was done before that picture"
    one.take(Detected(1, 41, 30))
    assert one.mean == 0
    one.take(Detected(1, 41, 0))
    assert one.mean == 0, "the same report again, as of a ground that hangs"


def test_a_ground_that_says_no_more_is_forgotten():
    """It may have left, and another that does not report took its place."""
    one = difference(*[0] * 20)
    assert one.mean == pytest.approx(-10)
    for second in range(20, 60):
        one.expect(second * FPS, 10, capture_ns=second * SECOND_NS)
    assert one.mean is None


def test_another_ground_begins_anew():
    """One without a detector would speak for one that has it."""
    one = told(difference(*[0] * 20), 10, at_s=20, receiver_id=2)
    assert one.mean is None
    assert told(one, 10, at_s=21, receiver_id=2).mean == 0
