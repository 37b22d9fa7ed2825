"""Times of frames as a player gives them."""

from fractions import Fraction
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_edge.source.decoding.timeline import Timeline, surveyed

STEP = Fraction(1, 30)


def times(stamps):
    """What a timeline makes of stamps in steps."""
    timeline = Timeline(STEP)
    return [timeline.at(None if one is None else one * STEP) / STEP for one in stamps], timeline


@pytest.mark.parametrize(
    ("stamps", "shown"),
    [
        ([5, 6, 7, 8], [5, 6, 7, 8]),
        ([0, 1, 1_128_000, 3, 4], [0, 1, 2, 3, 4]),
        ([0, 1, 1_128_000, 1_128_001, 4], [0, 1, 2, 3, 4]),
        ([100, 101, 102, 0, 1, 2], [100, 101, 102, 103, 104, 105]),
        ([0, 1, 1, 3], [0, 1, Fraction(3, 2), 3]),
        ([0, None, None, 3], [0, 1, 2, 3]),
        ([None, None, 7, 8], [0, 1, 2, 3]),
        ([0, 200, 201], [0, 200, 201]),
        ([60, 61, 30, 31, 64, 65], [60, 61, 62, 63, 64, 65]),
        ([31, 62, 63, 32, 64, 65], [31, 62, 63, 64, Fraction(129, 2), 65]),
        ([60, 61, 30, 31, 52, 53], [60, 61, 62, 63, 84, 85]),
    ],
    ids=[
        *("plain", "late", "two late", "anew", "twice", "unsaid", "late first", "a pause of seven seconds"),
        *("early", "behind damage", "anew, and a pause"),
    ],
)
def test_each_frame_comes_once_where_a_player_shows_it(stamps, shown):
    """One wrong stamp would repeat a picture for hours, or a recording be lost up to where its clock began anew."""
    assert times(stamps)[0] == shown


@given(st.lists(st.one_of(st.none(), st.integers(-(10**7), 10**7)), min_size=2, max_size=60))
def test_times_rise_whatever_the_stamps_say(stamps):
    """Two frames of one time, or one before its predecessor, would be one frame less."""
    shown, _ = times(stamps)
    assert all(earlier < later for earlier, later in pairwise(shown))


@given(st.lists(st.integers(1, 200), min_size=1, max_size=60), st.integers(0, 10**6))
def test_good_stamps_stay_as_they_are(steps, begin):
    """A clip of uneven frames would play at another speed than it was taken."""
    stamps = [begin]
    for step in steps:
        stamps.append(stamps[-1] + step)
    shown, timeline = times(stamps)
    assert shown == stamps
    assert timeline.says == ""


def test_a_jump_is_told_of_with_what_helps():
    """Who wonders about the time of a still would not know that the clip's own stamps are wrong."""
    _, timeline = times([0, 1, 2, 9000, 9001, 0])
    assert "jump by +299.933 s at 0.067 s, the first of 2" in timeline.says
    assert "--source-fps" in timeline.says


def test_the_first_packets_say_the_usual_step():
    """A jump among them, or stamps in whole seconds, would make a frame last for hours, or a second."""
    even = [(one * STEP, one * STEP) for one in range(60)]
    assert surveyed(even, said_fps=Fraction(30), reorders=False).period_s == STEP
    jumping = [*even, *((one + 10**6, one + 10**6) for one, _ in even)]
    assert surveyed(jumping, said_fps=Fraction(1, 1000), reorders=False).period_s == STEP
    coarse = [(Fraction(int(one)), Fraction(int(one))) for one, _ in even]
    assert surveyed(coarse, said_fps=None, reorders=False).period_s < Fraction(1, 20)
    still = [(Fraction(0), Fraction(0))] * 20
    assert not surveyed(still, said_fps=Fraction(24), reorders=False).usable
    assert not surveyed(even, said_fps=Fraction(30), reorders=True).ordered
