"""Angles as files and autopilots say them."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_geo.pose.angles import compass_deg, euler_deg


def quaternion(yaw_deg: float, pitch_deg: float, roll_deg: float) -> tuple[float, float, float, float]:
    """Of a turn by yaw, then by pitch, then by roll."""
    yaw, pitch, roll = (math.radians(one) / 2 for one in (yaw_deg, pitch_deg, roll_deg))
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    cr, sr = math.cos(roll), math.sin(roll)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


@pytest.mark.parametrize("pitch", [-90.0, 90.0])
@pytest.mark.parametrize("yaw", [33.0, 90.0, 200.0])
def test_straight_up_and_down_the_yaw_stays(yaw, pitch):
    """A picture from straight above would be turned at random."""
    for sign in (1, -1):  # both are the same direction
        found = euler_deg(*(sign * one for one in quaternion(yaw, pitch, 0)))
        assert compass_deg(found[0]) == pytest.approx(yaw)
        assert found[1:] == (pitch, 0.0)


@given(st.floats(0, 359), st.floats(-89, 89), st.floats(-179, 179))
def test_everywhere_else_it_is_the_turn_that_was_made(yaw, pitch, roll):
    """Places would be off by whatever a sign is."""
    found = euler_deg(*quaternion(yaw, pitch, roll))
    assert compass_deg(found[0] - yaw + 180) == pytest.approx(180, abs=1e-4)
    assert found[1:] == pytest.approx((pitch, roll), abs=1e-4)


@pytest.mark.parametrize("yaw", [-1e-17, -0.0, 360.0, 720.0, -360.0])
def test_north_is_zero(yaw):
    """The ground would refuse a report of 360 degrees."""
    assert compass_deg(yaw) == 0.0


@given(st.floats(-1e6, 1e6))
def test_a_course_is_below_360(yaw):
    """The same, of any number."""
    assert 0.0 <= compass_deg(yaw) < 360.0
