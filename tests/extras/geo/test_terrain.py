"""Places on ground that is not flat, from real GeoTIFFs."""

import logging
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from rasterio.warp import transform

import hvt_ground.cli
from hvt_common.errors import UserError
from hvt_common.geodesy import metres_per_degree, moved
from hvt_common.protocol.clock_offset import ClockOffset
from hvt_common.runtime.failures import Failures
from hvt_common.values import Orientation, Pose, View
from hvt_geo.camera import Surface, SurfaceLocator, ground_points, places_of_boxes
from hvt_geo.elevation import ElevationModel, Terrain
from hvt_geo.extra import GeoExtra
from hvt_ground.backlog.edge_backlog import EdgeBacklog
from hvt_ground.config import check
from hvt_ground.extras import config_class
from hvt_ground.poses import Locator
from hvt_ground.session.edge_port import ReceiverReports
from hvt_ground.sinks import Outputs
from hvt_ground.wiring import Models, SessionFactory
from rigs.messages import INFO

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
BOX = np.array([[490, 240, 510, 260]], np.float32)
MOON = "+proj=eqc +R=1737400 +units=m +no_defs"
PLAN = 'LOCAL_CS["plan",UNIT["metre",1]]'


def geotiff(path: Path, heights: np.ndarray, *corner: float, cell: float, **profile: Any) -> Path:
    """A file of these heights; ``corner`` is its west and north."""
    high, wide = heights.shape
    known = {"dtype": "float32", "crs": "EPSG:4326", "transform": from_origin(*corner, cell, cell), **profile}
    with rasterio.open(path, "w", driver="GTiff", width=wide, height=high, count=1, **known) as file:
        file.write(heights.astype(known["dtype"]), 1)
    return path


def model(folder: Path, height_m, *, dtype: str = "float32", nodata: float | None = -9999) -> Path:
    """An elevation model of 0.2 degrees around the camera; ``height_m`` of metres north and east of it."""
    rows, columns = np.mgrid[0:720, 0:720]
    north = (0.1 - (rows + 0.5) * CELL) * NORTH_M
    east = ((columns + 0.5) * CELL - 0.1) * EAST_M
    heights = np.broadcast_to(height_m(north, east), rows.shape)
    return geotiff(folder / "dem.tif", heights, 7.9, 47.1, cell=CELL, dtype=dtype, nodata=nodata)


def terrain_of(path: Path) -> Terrain:
    return Terrain(ElevationModel(path), "uav-1")


def surface_of(locator: Locator) -> Surface:
    assert isinstance(locator, SurfaceLocator)
    return locator.surface


def flat_file(path: Path, corner: tuple[float, float], *, size=(200, 200), **profile) -> Path:
    """500 m everywhere; ``corner`` is west and north, ``size`` columns and rows, cells 30 m or 0.001 degrees."""
    cell = profile.pop("cell", 0.001 if profile["crs"] == "EPSG:4326" else 30)
    return geotiff(path, np.full(size[::-1], 500), *corner, cell=cell, **profile)


def ground_m(path: Path, latitude: float, longitude: float) -> float:
    """The elevation below a camera there."""
    tile = ElevationModel(path).around(latitude, longitude)
    return float(tile.at(np.array([latitude]), np.array([longitude]))[0])


@pytest.mark.parametrize(
    ("height_m", "tilt_deg", "point", "north"),
    [
        (lambda north, _: 500.0 + 0 * north, -45, (500, 250), (99.5, 100.5)),
        (lambda north, _: 500.0 + 0 * north, -45, (200, 300), None),  # as on flat ground
        (lambda north, _: 500.0 + 0 * north, -45, (900, 480), None),
        (lambda north, _: 500 + 0.5 * north, -45, (500, 250), (65.7, 67.7)),  # 100 - d = 0.5 d
        # over flat ground it would be 1,908 m
        (lambda north, _: 500 + 80.0 * (np.abs(north - 1000) < 150), -3, (500, 250), (820, 900)),
    ],
)
def test_a_ray_meets_the_ground_where_it_rises_to_it(tmp_path, caplog, height_m, tilt_deg, point, north):
    """What stands on a hillside would be placed behind the hill, and a boat behind the headland in front of it."""
    terrain, points = terrain_of(model(tmp_path, height_m)), np.array([point], float)
    pose = replace(POSE, camera=Orientation(0, tilt_deg, 0))
    found = ground_points(pose, points, size=SIZE, surface=terrain)
    if north is None:
        flat = ground_points(replace(pose, height_m=100.0), points, size=SIZE)
        assert found == pytest.approx(flat, abs=0.5)
    else:
        assert north[0] < found[0, 0] < north[1]
    assert caplog.records == [], "the log would cry wolf"


def test_what_a_ridge_hides_is_not_seen_through_it(tmp_path):
    """A boat behind the headland would be reported in front of it, or the other way round."""
    terrain = terrain_of(model(tmp_path, lambda north, east: 500 + 80.0 * (np.abs(north - 1000) < 150)))
    flat_camera = replace(POSE, camera=Orientation(0, -3.0, 0))  # over flat ground it would be 1,908 m
    found = ground_points(flat_camera, MIDDLE, size=SIZE, surface=terrain)
    assert 820 < found[0, 0] < 900


def test_height_alone_counts_from_the_first_place(tmp_path):
    """Drones say how far above the take-off they are, and the take-off is not at sea level."""
    terrain = terrain_of(model(tmp_path, lambda north, east: 500 + 0.5 * north, dtype="int16"))
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
    holed = terrain_of(model(tmp_path, lambda north, east: np.where(north > 40, -9999.0, 500.0)))
    places = places_of_boxes(POSE, BOX, view=VIEW, surface=holed)
    assert places is not None
    assert np.isnan(places.places_deg).all()
    elsewhere = replace(POSE, latitude_deg=-20.0)
    assert np.isnan(ground_points(elsewhere, MIDDLE, size=SIZE, surface=holed)).all()
    under = replace(POSE, altitude_m=400.0)
    assert places_of_boxes(under, BOX, view=VIEW, surface=holed) is None


def test_a_far_flight_loads_the_ground_that_it_comes_to(tmp_path):
    """The first 10 km of a flight would be the only ones with ground."""
    terrain = terrain_of(model(tmp_path, lambda north, east: 500.0))
    for north in (0, 3000, 6000, 9000, 10_500):
        pose = replace(POSE, latitude_deg=47.0 + north / NORTH_M)
        assert ground_points(pose, MIDDLE, size=SIZE, surface=terrain)[0] == pytest.approx((100, 0), abs=1)


def test_a_wrong_file_is_refused_in_a_sentence(tmp_path, capsys):
    """The flight would begin, and its places be those of flat ground; or none, after a download that failed."""
    wrong = tmp_path / "wrong.tif"
    short = flat_file(tmp_path / "short.tif", (8.0, 48.0), crs="EPSG:4326").read_bytes()[:40_000]
    for content in (b"", b"not a picture", b"II*\0\x08\0\0\0", short):
        wrong.write_bytes(content)
        with pytest.raises(UserError, match="is no elevation model"):
            ElevationModel(wrong)
    assert hvt_ground.cli.main(["--terrain", str(wrong), "--record", str(tmp_path / "f.rrd")]) == 2
    assert f"--terrain {wrong} is no elevation model" in capsys.readouterr().err


@pytest.mark.parametrize("height_m", [0.5, 2.0, 3.0])
@pytest.mark.parametrize("said", ["altitude", "height"])
def test_a_camera_that_is_hardly_above_the_ground_ends_no_session(tmp_path, height_m, said):
    """At each start and landing the session would end, for by its error the camera may be below the ground."""
    terrain = terrain_of(model(tmp_path, lambda north, east: 500.0))
    pose = replace(POSE, altitude_m=500 + height_m)
    if said == "height":
        pose = replace(POSE, altitude_m=None, height_m=height_m)
    assert terrain.usable(pose)
    places = places_of_boxes(pose, BOX, view=VIEW, surface=terrain)
    assert places is not None
    assert np.isnan(places.places_deg).all(), "how far it is nobody knows"
    below = replace(pose, altitude_m=499.0)
    assert np.isnan(terrain.meet(below, np.array([[1.0, 0.0, 1.0]]))).all()
    assert terrain.below_m(below, np.zeros((1, 2)))[0] == pytest.approx(-1.0, abs=0.01)
    silent = replace(pose, altitude_m=None, height_m=None)
    assert not terrain.usable(silent)
    assert np.isnan(terrain.meet(silent, np.array([[1.0, 0.0, 1.0]]))).all()
    assert np.isnan(terrain.below_m(silent, np.zeros((1, 2)))).all()


@pytest.mark.parametrize("profile", [{}, {"nodata": -9999}, {"nodata": -1.7e308, "dtype": "float64"}])
def test_beside_a_model_there_is_no_sea(tmp_path, profile):
    """A boat near the edge of the map would be placed on a plain at 0 m, hundreds of metres away."""
    path = flat_file(tmp_path / "utm.tif", (700_000, 5_300_000), crs="EPSG:32632", **profile)
    # 30 m beside, but between the meridians of its corners
    (inside, beside), latitudes = transform(
        "EPSG:32632", "EPSG:4326", [700_100, 699_970], [5_297_000, 5_296_000]
    )
    assert ground_m(path, latitudes[0], inside) == pytest.approx(500)
    assert np.isnan(ground_m(path, latitudes[1], beside))


@pytest.mark.parametrize("mark", [-32768, -9999, 32767])
def test_a_hole_that_the_model_does_not_mark_is_one(tmp_path, mark):
    """Objects stood 33 km below the camera."""
    heights = np.full((200, 200), 500)
    heights[:, :100] = mark
    path = geotiff(tmp_path / "holed.tif", heights, 8.0, 48.0, cell=0.001, dtype="int16")
    assert ground_m(path, 47.9, 8.15) == pytest.approx(500)
    assert np.isnan(ground_m(path, 47.9, 8.05))


def test_what_a_mask_leaves_out_is_a_hole(tmp_path):
    """Some models say in a mask where they have nothing: there would be a plain."""
    path = flat_file(tmp_path / "masked.tif", (8.0, 48.0), crs="EPSG:4326")
    with rasterio.open(path, "r+") as file:
        mask = np.full((200, 200), 255, np.uint8)
        mask[:, :100] = 0
        file.write_mask(mask)
    assert np.isnan(ground_m(path, 47.9, 8.05))
    assert ground_m(path, 47.9, 8.15) == pytest.approx(500)


@pytest.mark.parametrize(
    ("profile", "said"),
    [
        ({"crs": MOON}, "is no elevation model that can be read"),
        ({"crs": PLAN}, "has neither degrees nor the coordinates of a map"),
        ({"crs": "EPSG:4978"}, "has neither degrees nor the coordinates of a map"),
        ({"crs": None}, "does not say where it lies"),
        ({"crs": "EPSG:4326", "transform": rasterio.Affine.identity()}, "does not say where it lies"),
    ],
)
def test_a_model_of_elsewhere_is_refused_before_the_flight(tmp_path, profile, said):
    """The first pose would end the session, with a message of GDAL."""
    path = flat_file(tmp_path / "elsewhere.tif", (0, 0), **profile)
    with pytest.raises(UserError, match=said):
        ElevationModel(path)


def test_a_fine_model_is_thinned_out_and_lies_where_it_did(tmp_path):
    """A slope of a fine model would be shifted, and with it all that stands on it."""
    slope = np.broadcast_to(np.arange(9000) + 0.5, (60, 9000))
    path = geotiff(tmp_path / "fine.tif", slope, 700_000, 5_300_000, cell=1, crs="EPSG:32632")
    for east_m in (1000.0, 4500.0, 8000.0):
        (longitude,), (latitude,) = transform("EPSG:32632", "EPSG:4326", [700_000 + east_m], [5_299_970])
        assert ground_m(path, latitude, longitude) == pytest.approx(east_m, abs=5)


@pytest.mark.parametrize(
    ("corner", "profile"),
    [
        ((179.8, -16.8), {"crs": "EPSG:4326", "size": (400, 200)}),
        ((-180.2, -16.8), {"crs": "EPSG:4326", "size": (400, 200)}),
        ((-180.0, 90.0), {"crs": "EPSG:4326", "size": (720, 360), "cell": 0.5}),
        ((0.0, 90.0), {"crs": "EPSG:4326", "size": (720, 360), "cell": 0.5}),
        ((800_000, 8_150_000), {"crs": "EPSG:32760", "size": (600, 600), "cell": 100}),
    ],
)
def test_at_the_antimeridian_there_is_ground_on_both_sides(tmp_path, corner, profile):
    """Off Fiji nothing would be placed."""
    path = flat_file(tmp_path / "fiji.tif", corner, **profile)
    terrain = terrain_of(path)
    for longitude in (179.95, 179.9995, -179.9995, -179.95):
        pose = replace(
            POSE, latitude_deg=-16.9, longitude_deg=longitude, camera=Orientation(90.0, -45.0, 0.0)
        )
        assert terrain.usable(pose)
        places = places_of_boxes(pose, BOX, view=VIEW, surface=terrain)
        assert places is not None
        truth = moved(-16.9, longitude, north_m=0.0, east_m=100.0)
        assert places.places_deg[0] == pytest.approx(truth, abs=1e-4)
    assert terrain.usable(replace(pose, longitude_deg=179.95)), "and back"


@pytest.mark.parametrize("latitude", [-20.0, 47.15])
def test_a_flight_outside_the_model_is_said_once(tmp_path, latitude, caplog):
    """The operator would wait for places that cannot come: it is the wrong file."""
    terrain = terrain_of(model(tmp_path, lambda north, east: 500.0))
    for second in range(5):
        outside = replace(POSE, latitude_deg=latitude, longitude_deg=8.0 + second / 1000)
        assert places_of_boxes(outside, BOX, view=VIEW, surface=terrain) is None
    (notice,) = caplog.records
    assert notice.levelno == logging.WARNING
    assert (
        f"--terrain {tmp_path / 'dem.tif'} has no ground below uav-1 at {latitude:.5f}, 8.0" in notice.message
    )


def opened_factory(path: Path, folder: Path) -> tuple[SessionFactory, Outputs]:
    make: Any = config_class()
    config = check(make(record=folder, terrain=path, detector="motion", classifier="none"))
    outputs = Outputs(Failures(time.time_ns))
    return SessionFactory(config, Models(config), clock=time.time_ns, outputs=outputs), outputs


def test_a_model_that_goes_in_flight_ends_no_flight(tmp_path, caplog):
    """A share that is gone would keep the ground from receiving anything of an edge that starts again."""
    path = model(tmp_path, lambda north, east: 500.0)
    factory, outputs = opened_factory(path, tmp_path)
    try:
        path.unlink()
        reports = ReceiverReports(
            lambda _report: None,
            clock=time.time_ns,
            clock_offset=ClockOffset(),
            backlog=EdgeBacklog("uav-1", recordings=None),
        )
        session = factory.open_session(replace(INFO, edge="uav-1"), reports)
        session.close()
    finally:
        outputs.close()
    caplog.clear()
    terrain = surface_of(GeoExtra().locators(model(tmp_path, lambda north, east: 500.0))("uav-1"))
    path.unlink()
    assert not terrain.usable(POSE)
    (notice,) = caplog.records
    assert f"--terrain {path} cannot be read, and nothing of uav-1 is placed: " in notice.message


def test_a_model_that_comes_back_in_flight_is_read_again(tmp_path):
    """A share that is away for a second would take the map for as long as the aircraft circles."""
    path, now_ns = model(tmp_path, lambda north, east: 500.0), 0
    terrain = Terrain(ElevationModel(path), "uav-1", clock=lambda: now_ns)
    away = path.rename(tmp_path / "away")
    assert not terrain.usable(POSE)
    away.rename(path)
    assert not terrain.usable(POSE)  # not with every frame
    now_ns += 2_000_000_000
    assert terrain.usable(POSE)
    path.unlink()
    assert terrain.usable(replace(POSE, latitude_deg=47.0 + 6000 / NORTH_M)), "what is in memory is forgotten"


def test_each_flight_has_a_ground_below_its_own_first_pose(tmp_path):
    """The second drone's heights would count from where the first one took off."""
    locator_of = GeoExtra().locators(model(tmp_path, lambda north, east: 500 + 0.5 * north))
    above = replace(POSE, altitude_m=None, height_m=100.0)
    for flight, north in (("uav-1", 0.0), ("uav-2", 400.0)):
        pose = replace(above, latitude_deg=47.0 + north / NORTH_M)
        ground = surface_of(locator_of(flight))
        assert ground.usable(pose)
        assert ground.below_m(pose, np.zeros((1, 2)))[0] == pytest.approx(100.0, abs=0.1)
