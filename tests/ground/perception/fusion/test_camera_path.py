"""The camera's motion between any two frames, from that between decoded frames."""

from __future__ import annotations

import numpy as np
import pytest

from hvt_ground.perception.fusion.camera_path import CameraPath

BOX = np.array([[100.0, 100.0, 120.0, 110.0]])


def shift(dx, dy, zoom=1.0):
    """An affine map."""
    return np.array([[zoom, 0, dx], [0, zoom, dy]])


@pytest.fixture
def path():
    """Frames at frames 0, 1 and 6: five pixels to the right, then ten down."""
    path = CameraPath(ahead_frames=10)
    path.add(shift(5, 0), start=0, end=1)
    path.add(shift(0, 10), start=1, end=6)
    return path


@pytest.mark.parametrize(
    ("start", "end", "moved"),
    [
        (0, 6, (5, 10)),
        (1, 6, (0, 10)),
        (0, 3, (5, 4)),  # evenly over the frames without a picture
        (3, 5, (0, 4)),
        (6, 8, (0, 4)),  # and on as it was
        (6, 40, (0, 20)),  # but not for ever
        (8, 10, (0, 4)),
        (-4, 1, (5, 0)),  # before the first it stood
        (6, 0, (-5, -10)),
        (4, 4, (0, 0)),
    ],
)
def test_boxes_move_with_the_camera(path, start, end, moved):
    """The edge's boxes would lie beside their objects wherever the drone turns."""
    wire_field = path.carry(BOX, start=start, end=end)
    np.testing.assert_allclose(wire_field, BOX + np.tile(moved, 2), atol=1e-9)


def test_a_climbing_camera_makes_boxes_smaller():
    """Boxes would keep the size that they had before the drone rose."""
    path = CameraPath(ahead_frames=5)
    path.add(shift(0, 0, zoom=0.5), start=0, end=1)
    np.testing.assert_allclose(path.carry(BOX, start=0, end=1), BOX / 2)


def test_without_motion_boxes_stay_where_they_are():
    """A ground that does not follow the camera would move boxes at random."""
    path = CameraPath(ahead_frames=5)
    assert path.carry(BOX, start=0, end=30) is BOX
    np.testing.assert_array_equal(path.between(3, 0), np.eye(2, 3))


def test_what_is_remembered_is_bounded():
    """A flight of hours would slow down with every frame."""
    path = CameraPath(ahead_frames=5, frames=8)
    for index in range(100):
        path.add(shift(1, 0), start=index, end=index + 1)
    assert path.between(0, 100)[0, 2] == pytest.approx(8)
