"""From picture to ground, against geometry by hand."""

from dataclasses import replace

import numpy as np
import pytest

from hvt_common.values import Orientation, Pose, View
from hvt_geo.camera import footprint, ground_points, places_of_boxes

SIZE = (1000, 500)
VIEW = View.fitted(SIZE, SIZE, fit="letterbox")
DOWN = Pose(0, 50.0, 10.0, height_m=100.0, camera=Orientation(0.0, -90.0, 0.0), hfov_deg=90.0)
"""Straight down, north up, a focal length of 500 px: 0.2 m a pixel."""
MIDDLE = (500.0, 250.0)


def metres(pose: Pose, *points: tuple[float, float]) -> np.ndarray:
    return ground_points(pose, np.array(points), size=SIZE)


@pytest.mark.parametrize(
    ("camera", "point", "north", "east"),
    [
        (Orientation(0, -90, 0), MIDDLE, 0, 0),
        (Orientation(0, -90, 0), (500, 150), 20, 0),  # up in the picture is north
        (Orientation(0, -90, 0), (600, 250), 0, 20),
        (Orientation(90, -90, 0), (500, 150), 0, 20),  # up is east
        (Orientation(90, -90, 0), (600, 250), -20, 0),
        (Orientation(0, -90, 90), (600, 250), -20, 0),  # rolled to the right: what is right is behind
        (Orientation(0, -45, 0), MIDDLE, 100, 0),
        (Orientation(270, -45, 0), MIDDLE, 0, -100),
        (Orientation(0, -45, 0), (750, 250), 100, 70.7107),  # half a focal length to the right, at 141 m
        (Orientation(0, -45, 0), (500, 500), 33.3333, 0),  # 45 + atan(1/2) degrees down: 100 / tan(71.565)
        (Orientation(0, -45, 30), MIDDLE, 100, 0),  # a roll about the axis moves nothing that lies on it
    ],
)
def test_rays_meet_the_ground_where_geometry_says(camera, point, north, east):
    """A boat would be reported a street away."""
    found = metres(replace(DOWN, camera=camera), point)[0]
    assert found == pytest.approx((north, east), abs=1e-3)


def test_nothing_is_placed_in_the_sky_or_at_the_horizon():
    """A bird above the horizon would stand somewhere on the ground behind the camera."""
    level = replace(DOWN, camera=Orientation(0, 0, 0))
    assert np.isnan(metres(level, (500, 100), (500, 251))).all()
    assert np.isfinite(metres(level, (500, 400))).all()
    boxes = np.array([[490, 80, 510, 100], [490, 255, 510, 262], [480, 420, 520, 480]], np.float32)
    places = places_of_boxes(level, boxes, view=VIEW)
    assert places is not None
    assert np.isnan(
        places.places_deg[:2]
    ).all()  # the second is nearer to the horizon than the pitch is known
    assert np.isnan(places.ellipses[:2]).all()
    assert np.isfinite(places.places_deg[2]).all()


@pytest.mark.parametrize("missing", ["camera", "height_m", "hfov_deg"])
def test_without_direction_height_or_field_nothing_is_placed(missing):
    """A place would be invented."""
    boxes = np.array([[490, 240, 510, 260]], np.float32)
    assert places_of_boxes(replace(DOWN, **{missing: None}), boxes, view=VIEW) is None


@pytest.mark.parametrize("latitude", [90.0, 89.95, -90.0])
def test_at_a_pole_nothing_is_placed(latitude):
    """Latitudes of 90.004 went to tables and maps."""
    boxes = np.array([[480, 240, 520, 260]], np.float32)
    assert places_of_boxes(replace(DOWN, latitude_deg=latitude), boxes, view=VIEW) is None
    assert footprint(replace(DOWN, latitude_deg=latitude), VIEW) is None


def test_a_worse_attitude_widens_the_ellipse():
    """Somebody would trust a place that a poor compass gave."""
    boxes = np.array([[490, 240, 510, 260]], np.float32)
    tilted = replace(DOWN, camera=Orientation(0, -30, 0))
    axes = []
    for angle in (0.5, 2.0, 8.0):
        places = places_of_boxes(replace(tilted, angle_error_deg=angle), boxes, view=VIEW)
        assert places is not None
        axes.append(places.ellipses[0, 0])
    assert axes[0] < axes[1] < axes[2]
    assert axes[2] > 3 * axes[0]


def test_the_ellipse_points_where_the_error_is():
    """Looking flat along the ground, it is the distance that nobody knows."""
    east = replace(DOWN, camera=Orientation(90, -15, 0), hfov_deg=20.0)
    places = places_of_boxes(east, np.array([[495, 245, 505, 255]], np.float32), view=VIEW)
    assert places is not None
    major, minor, azimuth = places.ellipses[0]
    assert major > 2 * minor
    assert azimuth == pytest.approx(90, abs=3)


def test_base_and_source_pixels_give_the_same_place():
    """With letterbox bars or a smaller base everything would shift."""
    small = View.fitted(SIZE, (640, 360), fit="letterbox")
    box = np.array([[700, 300, 720, 320]], np.float32)
    first = places_of_boxes(DOWN, box, view=VIEW)
    second = places_of_boxes(DOWN, small.to_base(box), view=small)
    assert first is not None
    assert second is not None
    assert second.places_deg == pytest.approx(first.places_deg, abs=1e-8)


def test_objects_stand_at_the_lower_edge_where_one_looks_along_the_ground():
    """A tower would stand behind the hill, by half its height in the picture."""
    flat = replace(DOWN, camera=Orientation(0, -10, 0), hfov_deg=20.0)
    tall = places_of_boxes(flat, np.array([[495, 200, 505, 260]], np.float32), view=VIEW)
    low = places_of_boxes(flat, np.array([[495, 258, 505, 260]], np.float32), view=VIEW)
    assert tall is not None
    assert low is not None
    assert abs(tall.places_deg[0, 0] - low.places_deg[0, 0]) * 111_000 < 8
