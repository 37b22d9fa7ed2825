"""Which codes count, and what a row says of their readings."""

import math

import numpy as np
import pytest

from hvt_scene import CodeInView
from hvt_study.reading.score import Code, Evidence, Reading, channel_score, codes_to_read

PICTURE = np.zeros((48, 160, 3), np.uint8)


def code_in_view(object_id, *, visible=1.0, height_px=8.0):
    corners = np.array([(0, 0), (3 * height_px, 0), (3 * height_px, height_px), (0, height_px)], np.float32)
    return CodeInView(object_id, "AB12", corners, visible)


def evidence(*said):
    """Readings (text, confidence, seconds) of the code KP47, one after the other."""
    found = Evidence()
    for text, confidence, at_s in said:
        found.add(Reading(text, confidence, PICTURE), code="KP47", at_s=at_s)
    return found


def test_a_code_counts_when_it_was_whole_in_view_for_a_second():
    """A code that nobody could have read would be held against every method alike, and hide the difference."""
    views = [
        [code_in_view(1), code_in_view(2, visible=0.5), *([code_in_view(3, height_px=12.0)] * (index >= 6))]
        for index in range(20)
    ]
    views[10].append(code_in_view(4))
    assert codes_to_read(views) == {1: Code(1, "AB12", 0.0, 8.0)}
    views += [[code_in_view(3, height_px=14.0)]] * 2
    found = codes_to_read(views)
    assert list(found) == [1, 3]
    assert found[3].first_s == pytest.approx(6 / 15)
    assert found[3].height_px == 12.0


@pytest.mark.parametrize(
    ("said", "right", "read_s", "best"),
    [
        # A later mistake, however confident, does not take away what an operator has read already.
        (
            (("KP4", 0.9, 1.0), ("KP47", 0.3, 2.0), ("KR47", 0.99, 3.0), ("KP47", 0.99, 4.0)),
            True,
            2.0,
            "KP47",
        ),
        # The sheet of examples would show a guess in place of what the reader insisted on.
        ((("KR47", 0.6, 1.0), ("K", 0.9, 2.0), ("KR41", 0.8, 3.0)), False, math.inf, "K"),
    ],
)
def test_the_first_right_reading_stays_and_of_wrong_ones_the_most_confident(said, right, read_s, best):
    """What an operator has read would be taken away, or a guess be shown."""
    found = evidence(*said)
    assert (found.right, found.read_s, found.best.text) == (right, read_s, best)


def test_shares_and_waits():
    """The headline of the page: how many, how soon, and how many codes would mislead somebody."""
    codes = [Code(number, "KP47", first_s, 8.0) for number, first_s in enumerate((0.0, 1.0, 0.0, 0.0, 0.0))]
    said = (("KP47", 0.9, 3.0), ("KP47", 0.9, 2.0), ("KP47", 0.9, 4.5), ("KR47", 0.8, 1.0))
    found = {number: evidence(one) for number, one in enumerate(said)}
    score = channel_score(codes, found)
    assert score.read == pytest.approx(3 / 5)
    assert score.median_s == 4.5  # waits of 1, 3, 4.5 seconds, and two for ever
    assert score.misread == pytest.approx(1 / 5)
    assert channel_score(codes[3:], found).median_s is None
    assert channel_score([], {}).read is None
    # A doubtful reading or a fragment misleads nobody.
    found[3] = evidence(("KR47", 0.4, 1.0), ("KR", 0.9, 2.0))
    assert channel_score(codes, found).misread == 0.0
