"""Places on ground that is not flat, from real GeoTIFFs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

import hvt_ground.cli
from hvt_common.errors import UserError
from hvt_common.geodesy import metres_per_degree
from hvt_common.values import Orientation, Pose, View
from hvt_ground.geolocation.camera import ground_points, places_of_boxes
from hvt_ground.geolocation.terrain import Terrain

pytestmark = [
    pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning"),  # of rasterio's own
    pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning"),
]

SIZE = (1000, 500)
VIEW = View.fitted(SIZE, SIZE, fit="letterbox")
NORTH_M, EAST_M = metres_per_degree(47.0)
POSE = Pose(0, 47.0, 8.0, altitude_m=600.0, camera=Orientation(0, -45, 0), hfov_deg=60.0)
MIDDLE = np.array([[500.0, 250.0]])
CELL = 1 / 3600


def model(folder: Path, height_m, *, dtype: str = "float32", nodata: float | None = -9999) -> Path:
    """An elevation model of 0.2 degrees around the camera; ``height_m`` of metres north and east of it."""
    rows, columns = np.mgrid[0:720, 0:720]
    north = (0.1 - (rows + 0.5) * CELL) * NORTH_M
    east = ((columns + 0.5) * CELL - 0.1) * EAST_M
    path = folder / "dem.tif"
    with rasterio.open(
        *(path, "w"),
        driver="GTiff",
        width=720,
        height=720,
        count=1,
        dtype=dtype,
        nodata=nodata,
        crs="EPSG:4326",
        transform=from_origin(7.9, 47.1, CELL, CELL),
    ) as file:
        file.write(np.broadcast_to(height_m(north, east), rows.shape).astype(dtype), 1)
    return path


def test_a_plain_is_as_flat_ground(tmp_path):
    """The two ways to find a place would disagree where they must not."""
    terrain = Terrain(model(tmp_path, lambda north, east: 500.0))
    points = np.array([[500.0, 250.0], [200.0, 300.0], [900.0, 480.0]])
    flat = ground_points(replace(POSE, height_m=100.0), points, size=SIZE)
    assert ground_points(POSE, points, size=SIZE, surface=terrain) == pytest.approx(flat, abs=0.5)
    assert flat[0] == pytest.approx((100, 0), abs=1e-6)


def test_a_slope_is_met_where_it_rises_to_the_ray(tmp_path):
    """Everything on a hillside would be placed behind the hill."""
    terrain = Terrain(model(tmp_path, lambda north, east: 500 + 0.5 * north))
    # 100 - d = 0.5 d
    found = ground_points(POSE, MIDDLE, size=SIZE, surface=terrain)
    assert found[0] == pytest.approx((66.7, 0), abs=1.0)


def test_what_a_ridge_hides_is_not_seen_through_it(tmp_path):
    """A boat behind the headland would be reported in front of it, or the other way round."""
    terrain = Terrain(model(tmp_path, lambda north, east: 500 + 80.0 * (np.abs(north - 1000) < 150)))
    flat_camera = replace(POSE, camera=Orientation(0, -3.0, 0))  # over flat ground it would be 1,908 m
    found = ground_points(flat_camera, MIDDLE, size=SIZE, surface=terrain)
    assert 820 < found[0, 0] < 900


def test_height_alone_counts_from_the_first_place(tmp_path):
    """Drones say how far above the take-off they are, and the take-off is not at sea level."""
    terrain = Terrain(model(tmp_path, lambda north, east: 500 + 0.5 * north, dtype="int16"))
    above = replace(POSE, altitude_m=None, height_m=100.0)
    first = ground_points(above, MIDDLE, size=SIZE, surface=terrain) if terrain.usable(above) else None
    assert first is not None
    assert first[0] == pytest.approx((66.7, 0), abs=3.0)
    # 100 m further north and up to the same height above the take-off: only 50 m above the slope
    later = replace(above, latitude_deg=47.0 + 100 / NORTH_M)
    assert terrain.usable(later)
    assert ground_points(later, MIDDLE, size=SIZE, surface=terrain)[0] == pytest.approx((33.3, 0), abs=3.0)


def test_outside_the_model_and_in_its_holes_nothing_is_placed(tmp_path):
    """A place would be invented where nobody knows the ground."""
    holed = Terrain(model(tmp_path, lambda north, east: np.where(north > 40, -9999.0, 500.0)))
    box = np.array([[490, 240, 510, 260]], np.float32)
    places = places_of_boxes(POSE, box, view=VIEW, surface=holed)
    assert places is not None
    assert np.isnan(places.places_deg).all()
    elsewhere = replace(POSE, latitude_deg=-20.0)
    assert np.isnan(ground_points(elsewhere, MIDDLE, size=SIZE, surface=holed)).all()
    under = replace(POSE, altitude_m=400.0)
    assert places_of_boxes(under, box, view=VIEW, surface=holed) is None


def test_a_far_flight_loads_the_ground_that_it_comes_to(tmp_path):
    """The first 10 km of a flight would be the only ones with ground."""
    terrain = Terrain(model(tmp_path, lambda north, east: 500.0))
    for north in (0, 3000, 6000, 9000, 10_500):
        pose = replace(POSE, latitude_deg=47.0 + north / NORTH_M)
        assert ground_points(pose, MIDDLE, size=SIZE, surface=terrain)[0] == pytest.approx((100, 0), abs=1)


@pytest.mark.parametrize("content", [b"", b"not a picture", b"II*\0\x08\0\0\0"])
def test_a_wrong_file_is_refused_in_a_sentence(tmp_path, content, capsys):
    """The flight would begin, and its places be those of flat ground without a word."""
    wrong = tmp_path / "wrong.tif"
    wrong.write_bytes(content)
    with pytest.raises(UserError, match="is no elevation model"):
        Terrain(wrong)
    assert hvt_ground.cli.main(["--terrain", str(wrong), "--record", str(tmp_path / "f.rrd")]) == 2
    assert f"--terrain {wrong} is no elevation model" in capsys.readouterr().err


def test_a_picture_without_coordinates_is_refused(tmp_path):
    """It would lie at 0, 0."""
    path = tmp_path / "plain.tif"
    with rasterio.open(path, "w", driver="GTiff", width=8, height=8, count=1, dtype="float32") as file:
        file.write(np.zeros((8, 8), np.float32), 1)
    with pytest.raises(UserError, match="does not say where it lies"):
        Terrain(path)
