"""Metres on the earth, and the pose between two."""

import numpy as np
import pytest

from hvt_common.geodesy import interpolate, metres_per_degree, moved, wrap_180
from hvt_common.values import Orientation, Pose


@pytest.mark.parametrize(
    ("latitude", "north_m", "east_m"),
    [(0.0, 110_574, 111_320), (45.0, 111_132, 78_847), (60.0, 111_412, 55_800), (-52.0, 111_267, 68_678)],
)
def test_a_degree_is_as_long_as_tables_of_wgs_84_say(latitude, north_m, east_m):
    """Places would be metres off, and nobody could say where."""
    assert metres_per_degree(latitude) == pytest.approx((north_m, east_m), abs=1.0)


def test_moving_there_and_back_returns_to_the_place():
    """North and east, or their signs, would be mixed up."""
    there = moved(52.0, 13.0, north_m=300, east_m=-400)
    assert there[0] > 52.0
    assert there[1] < 13.0
    assert moved(*there, north_m=-300, east_m=400) == pytest.approx((52.0, 13.0), abs=1e-6)


def test_longitudes_go_round():
    """A ship that crosses the date line would jump around the world."""
    assert moved(0.0, 179.9999, north_m=0, east_m=100)[1] == pytest.approx(-179.9992, abs=1e-4)
    first, second = Pose(0, 0.0, 179.9998), Pose(10, 0.0, -179.9998)
    assert abs(interpolate(first, second, 5).longitude_deg) == pytest.approx(180.0, abs=1e-9)
    assert [wrap_180(one) for one in (-190.0, 179.0, 180.0, 540.0)] == [170.0, 179.0, -180.0, -180.0]
    assert wrap_180(np.array([-190.0, 0.0, 180.0])).tolist() == [170.0, 0.0, -180.0]


def test_angles_turn_the_shorter_way():
    """A camera that looks north would spin once a second; what only one pose knows is not known between."""
    first = Pose(0, 1.0, 2.0, camera=Orientation(350, -80, 170), height_m=10)
    second = Pose(10, 1.0, 2.0, camera=Orientation(20, -90, -170), height_m=20)
    middle = interpolate(first, second, 5)
    camera = middle.camera
    assert (camera.yaw_deg, camera.pitch_deg, abs(camera.roll_deg)) == pytest.approx((5, -85, 180))
    assert middle.height_m == pytest.approx(15)
    middle = interpolate(Pose(0, 1.0, 2.0, height_m=10), Pose(10, 1.0, 2.0, position_error_m=9), 5)
    assert (middle.height_m, middle.position_error_m) == (None, 9)
