"""How far a study is."""

from __future__ import annotations

from collections import deque

import pytest

from hvt_study.commands.progress import time_left_s


def test_the_time_left_is_that_of_the_last_steps():
    """Who waits would be told two hours of what takes one."""
    assert time_left_s(deque([(100.0, 1), (110.0, 2), (140.0, 5)]), 9) == pytest.approx(40.0)


def test_of_the_first_steps_nothing_is_concluded():
    """Two processes that begin together end together: the first estimate would be twice too long."""
    assert time_left_s(deque([(0.0, 0)]), 80) == 0
    assert time_left_s(deque([(20.0, 1), (20.1, 2)]), 80) == 0
