"""Places against the drawn scene, whose camera and objects are known exactly."""

from dataclasses import replace

import numpy as np
import pytest

from hvt_common.geodesy import metres_per_degree, moved
from hvt_common.values import Orientation, Pose, View
from hvt_geo.camera import places_of_boxes
from hvt_scene import Scene
from hvt_scene.appearance import Appearance

SIZE = (1920, 1080)
VIEW = View.fitted(SIZE, (1280, 720), fit="letterbox")


def disturbed(pose: Pose, noise: np.random.Generator) -> Pose:
    """A pose as a sensor gives it that is as bad as the pose says."""
    north, east = noise.normal(0, pose.position_error_m, 2)
    latitude, longitude = moved(pose.latitude_deg, pose.longitude_deg, north_m=north, east_m=east)
    assert pose.camera is not None
    assert pose.height_m is not None
    assert pose.hfov_deg is not None
    yaw, pitch, roll = noise.normal(0, pose.angle_error_deg, 3)
    camera = Orientation(
        pose.camera.yaw_deg + yaw, pose.camera.pitch_deg + pitch, pose.camera.roll_deg + roll
    )
    return replace(
        pose,
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=pose.height_m + noise.normal(0, pose.height_error_m),
        camera=camera,
        hfov_deg=pose.hfov_deg * (1 + noise.normal(0, 0.02)),
    )


@pytest.mark.parametrize("tilt_deg", [0.0, 30.0])
def test_objects_are_where_they_are_and_the_ellipse_holds_them(tilt_deg):
    """A map would say what no sensor knows, or be so vague that nobody can use it."""
    scene = Scene(3, size=SIZE, appearance=Appearance(tilt_deg=tilt_deg))
    noise = np.random.default_rng(0)
    exact_m, inside, areas = [], [], []
    for t_s in np.linspace(0, scene.duration_s, 25):
        truth, middles = scene.truth(float(t_s)), scene.places(float(t_s))
        whole = truth.visible > 0.95
        ids, boxes = truth.ids[whole], VIEW.to_base(truth.boxes_source_px[whole])
        at_m = np.array([middles[one] for one in ids.tolist()])
        real = np.array([scene.geographic(x, y) for x, y in at_m.tolist()])
        pose = replace(scene.pose(float(t_s)), position_error_m=2.0, height_error_m=2.0, angle_error_deg=1.0)
        for seen, into in ((pose, exact_m), (disturbed(pose, noise), None)):
            places = places_of_boxes(seen, boxes, view=VIEW)
            assert places is not None
            off = (places.places_deg - real) * metres_per_degree(52.0)
            if into is not None:
                into.extend(np.linalg.norm(off, axis=1).tolist())
                continue
            major, minor, azimuth = places.ellipses.T
            turned = np.radians(azimuth)
            along = off[:, 0] * np.cos(turned) + off[:, 1] * np.sin(turned)
            across = off[:, 1] * np.cos(turned) - off[:, 0] * np.sin(turned)
            inside.extend(((along / major) ** 2 + (across / minor) ** 2 <= 1).tolist())
            areas.extend((np.pi * major * minor).tolist())
    assert len(exact_m) > 500
    assert np.percentile(exact_m, 95) < (1.0 if tilt_deg == 0 else 2.5)
    # Objects of one picture share the pose's errors: 25 poses, of which each is in or out.
    assert np.mean(inside) > 0.9
    assert np.median(areas) < np.pi * 15**2
