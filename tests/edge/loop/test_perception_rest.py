"""Perception gives way to video before a frame is lost again."""

from __future__ import annotations

from itertools import pairwise

from hvt_common.units import SECOND_NS
from hvt_edge.loop.realtime import PerceptionRest

FPS = 15


def taken(lost: list[int]) -> list[bool]:
    """Whether perception may take each frame, where so many were lost before it."""
    rest, total, said = PerceptionRest(), 0, []
    for index, more in enumerate(lost):
        total += more
        said.append(rest.lets(total, now_ns=index * SECOND_NS // FPS))
    return said


def test_where_no_frame_is_lost_perception_has_them_all():
    """A machine that has the time would track less than it can."""
    assert taken([0] * 60) == [True] * 60


def test_after_a_loss_it_rests_and_longer_while_frames_go_on_being_lost():
    """Video would lose a frame at each detection, for as long as the flight lasts."""
    assert taken([0, 1, *[0] * 20]).count(False) == 2
    often = taken([1 if index in (1, 5, 10, 16, 24) else 0 for index in range(60)])
    assert often[24:32].count(False) >= 6
    assert often[40:] == [True] * 20


def test_where_video_loses_frames_all_the_time_boxes_are_still_made_twice_a_second():
    """Nothing at all would be listed on a board that is too slow for its video."""
    said = taken([1] * 150)
    picks = [index for index, one in enumerate(said) if one]
    assert 18 <= len(picks) <= 22
    assert max(b - a for a, b in pairwise(picks)) <= FPS // 2 + 1


def test_a_single_loss_long_ago_counts_for_nothing():
    """One busy second would cost boxes for the rest of the flight."""
    said = taken([0, 1, 0, 1, *[0] * 100, 1, *[0] * 10])
    assert said[104:].count(False) == 2
