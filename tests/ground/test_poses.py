"""The pose of a moment."""

import pytest

from hvt_common.values import Orientation, Pose
from hvt_ground.poses import PoseTrail

SECOND_NS = 1_000_000_000


def pose(second: float, *, north: float = 0.0, yaw: float = 0.0) -> Pose:
    at_ns, latitude_deg = round(second * SECOND_NS), 50.0 + north / 111_229
    return Pose(at_ns, latitude_deg, 10.0, height_m=50.0, camera=Orientation(yaw, -60, 0))


def trail_of(*poses: Pose) -> PoseTrail:
    trail = PoseTrail()
    for one in poses:
        assert trail.add(one)
    return trail


@pytest.mark.parametrize(
    ("second", "north", "yaw", "position_error_m"),
    [(0.25, 5, 2.5, 3.0), (1.5, 30, 15.0, (3**2 + 5**2) ** 0.5)],
    ids=["between two it is on the line", "after the last it goes on and is less sure"],
)
def test_a_pose_at_a_moment(second, north, yaw, position_error_m):
    """Places would jump once a second, or stay where the drone was a second ago."""
    found = trail_of(pose(0), pose(1, north=20, yaw=10)).at(round(second * SECOND_NS))
    assert found is not None
    assert found.latitude_deg == pytest.approx(50 + north / 111_229, abs=1e-8)
    assert found.camera is not None
    assert found.camera.yaw_deg == pytest.approx(yaw)
    assert found.position_error_m == pytest.approx(position_error_m, rel=0.01)
    assert (found.angle_error_deg > 2.0) == (second > 1)


def test_a_camera_that_stands_is_as_sure_as_it_was():
    """A fixed camera's places would grow vague between two reports."""
    found = trail_of(pose(0), pose(1)).at(5 * SECOND_NS)
    assert found is not None
    assert (found.position_error_m, found.angle_error_deg) == (3.0, 2.0)


def test_ten_seconds_old_is_no_pose():
    """An aircraft that is gone would still place what it sees."""
    trail = trail_of(pose(0))
    assert PoseTrail().at(0) is None
    assert trail.at(10 * SECOND_NS) is not None
    assert trail.at(10 * SECOND_NS + 1) is None


def test_one_pose_of_the_future_does_not_hold_for_the_rest_of_the_flight():
    """The map would show one place, as if it were of now, until that time is there."""
    trail = trail_of(pose(0), pose(1e6))
    taken = [trail.add(pose(second)) for second in range(1, 20)]
    assert taken == 4 * [False] + 15 * [True]
    assert trail.newest == pose(19)
    assert trail.at(19 * SECOND_NS) is not None


def test_an_old_one_is_left_out_and_memory_is_bounded():
    """A repeated message would turn time back, and a long flight fill the memory."""
    trail = PoseTrail(most=10)
    for second in range(100):
        assert trail.add(pose(second))
    assert not trail.add(pose(50))
    assert trail.at(80 * SECOND_NS) is None  # the last ten are from 90 on
    assert trail.at(95 * SECOND_NS) is not None
