"""Camera motion: measured with a virtual camera over a real aerial picture, and used by the tracker."""

from typing import Any

import cv2
import numpy as np
import pytest

from hvt_common.camera_motion import CameraMotion
from hvt_common.tracking import kalman
from hvt_common.tracking.bytetrack import ByteTracker
from hvt_common.tracking.settings import TrackerSettings
from hvt_common.values import Detections
from rigs.examples import detections

WIDTH, HEIGHT = 640, 360


@pytest.fixture(scope="module")
def ground(data):
    return cv2.imread(str(data / "aerial_highway.jpg"))


def view(x, y, zoom, degrees):
    """World to image: (x, y) is the point of the world in the middle of the image."""
    angle = np.deg2rad(degrees)
    turn = zoom * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.column_stack((turn, [WIDTH / 2, HEIGHT / 2] - turn @ [x, y]))


def shot(ground, camera, rng):
    image = cv2.warpAffine(ground, camera, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)
    return np.clip(image + rng.normal(0, 4, image.shape), 0, 255).astype(np.uint8)


def between(a, b):
    square = [np.vstack((camera, [0, 0, 1])) for camera in (a, b)]
    return (square[1] @ np.linalg.inv(square[0]))[:2]


def worst_corner_px(estimate, truth):
    """How far apart the two maps put a corner of the image, at worst."""
    corners = np.array([[0, 0, 1], [WIDTH, 0, 1], [0, HEIGHT, 1], [WIDTH, HEIGHT, 1]]).T
    return float(np.linalg.norm((estimate - truth) @ corners, axis=0).max())


def flight(*, steps, pan_px, zoom, turn, seed):
    """Cameras that wander from the middle of the picture."""
    rng = np.random.default_rng(seed)
    pose = np.array([534.0, 290.0, 1.0, 0.0])
    for _ in range(steps):
        yield view(*pose)
        pose[:2] += rng.uniform(-pan_px, pan_px, 2)
        pose[2] *= 1 + rng.uniform(-zoom, zoom)
        pose[3] += rng.uniform(-turn, turn)


@pytest.mark.realdata
@pytest.mark.parametrize(("scale", "median_px", "worst_px"), [(1.0, 0.1, 0.2), (0.5, 0.2, 0.5)])
def test_known_motion_is_measured(ground, scale, median_px, worst_px):
    """Tracks and moving-object masks would be shifted against the ground by the error, every frame."""
    rng, motion = np.random.default_rng(3), CameraMotion(scale=scale)
    errors, last = [], None
    for camera in flight(steps=8, pan_px=20, zoom=0.02, turn=1.0, seed=5):
        estimate = motion.step(shot(ground, camera, rng))
        assert estimate.shape == (2, 3)
        assert estimate.dtype == np.float64
        if last is None:
            np.testing.assert_array_equal(estimate, np.eye(2, 3))
        else:
            errors.append(worst_corner_px(estimate, between(last, camera)))
        last = camera
    assert np.median(errors) < median_px
    assert max(errors) < worst_px


@pytest.mark.realdata
def test_moving_objects_do_not_pull_the_estimate(ground):
    """A street full of cars would look like a moving camera."""
    rng, motion = np.random.default_rng(3), CameraMotion()
    cameras = list(flight(steps=2, pan_px=8, zoom=0.01, turn=0.3, seed=2))
    cars = rng.integers(0, 255, (12, 24, 24, 3))
    for k, camera in enumerate(cameras):
        image = shot(ground, camera, rng)
        for n, car in enumerate(cars):
            x, y = 40 + 45 * n + 9 * k, 60 + 20 * n
            image[y : y + 24, x : x + 24] = car
        estimate = motion.step(image)
    assert worst_corner_px(estimate, between(*cameras)) < 0.5


def test_a_vehicle_that_fills_a_standing_picture_does_not_move_the_camera():
    """Its corners are most of those on a plain road: boxes and parked cars would drive off with it."""
    rng, motion = np.random.default_rng(6), CameraMotion(scale=None)
    road = cv2.GaussianBlur(rng.normal(110, 30, (360, 640)).astype(np.float32), (0, 0), 2)
    road[:, [30, 31, 600, 601]] = 220  # lane marks
    car = cv2.resize(rng.integers(0, 255, (10, 9)).astype(np.float32), (220, 240))
    for k in range(8):
        image = road + rng.normal(0, 2, road.shape)
        image[40 + 9 * k : 280 + 9 * k, 200:420] = car
        estimate = motion.step(np.clip(image, 0, 255).astype(np.uint8))
        np.testing.assert_array_equal(estimate, np.eye(2, 3))


def letters(image):
    for line in range(4):
        cv2.putText(image, "ALT 120 m  SPD 9", (8, 20 + 16 * line), 0, 0.5, (255, 255, 255))


def bars(image):
    image[:45] = image[-45:] = 0


def pillars(image):
    image[:, :80] = image[:, -80:] = 255


def bonnet(image):
    image[-60:] = 40
    image[-60::12] = 200


@pytest.mark.realdata
@pytest.mark.parametrize("before_it", [letters, bars, pillars, bonnet])
def test_a_camera_that_hovered_and_turns_is_followed_at_once(ground, before_it):
    """What always stands in its picture, or that it stood until now, would leave every box behind."""
    rng, motion = np.random.default_rng(3), CameraMotion(scale=None)
    cameras = [view(500 + 9 * max(0, k - 3), 300, 1.0, 0.0) for k in range(8)]
    for k, camera in enumerate(cameras):
        image = shot(ground, camera, rng)
        before_it(image)
        estimate = motion.step(image)
        if k:
            assert worst_corner_px(estimate, between(cameras[k - 1], camera)) < 1


def test_without_texture_or_in_another_scene_the_camera_stands_still():
    """Every track would jump at a cut, over water, or at the first picture of another size."""
    rng = np.random.default_rng(0)
    cuts = (cv2.GaussianBlur(rng.integers(0, 255, (180, 320, 3), np.uint8), (0, 0), 2) for _ in range(4))
    for pictures in (
        [np.zeros((90, 160, 3)), np.full((90, 160, 3), 127), *[np.zeros((1, 1, 3))] * 2],
        [rng.integers(0, 255, (*size, 3)) for size in ((90, 160), (45, 80))],  # another size
        cuts,
    ):
        motion = CameraMotion()
        for picture in pictures:
            np.testing.assert_array_equal(motion.step(np.asarray(picture, np.uint8)), np.eye(2, 3))


def test_warp_moves_boxes_as_the_picture_moves():
    """With a turning and zooming camera, boxes and their velocities would point the wrong way."""
    states = kalman.initiate(np.array([[100.0, 50.0, 0.5, 40.0]]).T)
    states[kalman.VELOCITY, :, 0] = [3.0, 0.0, 0.01, 0.5]
    before = states.copy()
    kalman.warp(states, np.array([[0.0, -2.0, 10.0], [2.0, 0.0, 20.0]]))  # a quarter turn, twice the size
    np.testing.assert_allclose(states[kalman.POSITION, :, 0], [-90, 220, 0.5, 80])
    np.testing.assert_allclose(states[kalman.VELOCITY, :, 0], [0, 6, 0.01, 1.0], atol=1e-12)
    np.testing.assert_allclose(
        states[kalman.VAR_P :, :, 0] / before[kalman.VAR_P :, :, 0].clip(1e-30),
        [[4, 4, 1, 4], [0, 0, 0, 0], [4, 4, 1, 4]],  # lengths by the square of the scale; no covariance yet
    )


def follow(ground, *, camera_motion, every):
    """The ids listed at each frame for six parked cars under a shaking camera."""
    rng = np.random.default_rng(4)
    world = np.array([[420, 200], [500, 260], [600, 240], [460, 350], [560, 330], [650, 310]], float)
    tracker = ByteTracker(TrackerSettings(camera_motion=camera_motion), fps=15)
    listed = []
    for k, camera in enumerate(flight(steps=13, pan_px=30, zoom=0.02, turn=1.5, seed=9)):
        image = shot(ground, camera, rng)
        centre = world @ camera[:, :2].T + camera[:, 2] + rng.normal(0, 0.5, world.shape)
        half = np.array([10, 8])
        boxes = np.hstack((centre - half, centre + half)).astype(np.float32)
        seen = Detections(boxes, np.full(6, 0.9, np.float32), np.zeros(6, np.int32))
        if k % every == 0:
            tracks = tracker.update(seen, frame_index=k, image=image)
        else:
            tracks = tracker.predict(frame_index=k, image=image)
        listed.append(tracks.ids.tolist())
    return listed


@pytest.mark.realdata
@pytest.mark.parametrize("every", [1, 3])
def test_ids_survive_a_shaking_camera(ground, every):
    """In gusts every object would get a new id with each frame, and each would be sent as new."""
    steady = follow(ground, camera_motion="flow", every=every)
    assert all(ids == [1, 2, 3, 4, 5, 6] for ids in steady)
    shaken = follow(ground, camera_motion="off", every=every)
    kept = sum(len(set(ids) & set(range(1, 7))) for ids in shaken) / (6 * len(shaken))
    assert kept < 0.5


def test_where_another_scene_begins_all_tracks_end():
    """Boxes of a street would stand over the next camera's picture, and one of its cars would get another's id."""
    rng = np.random.default_rng(1)
    scenes = [cv2.GaussianBlur(rng.integers(0, 255, (180, 320, 3), np.uint8), (0, 0), 6) for _ in range(2)]
    seen = detections([(40, 40, 80, 60)])
    tracker = ByteTracker(TrackerSettings(camera_motion="flow"), fps=15)
    listed = []
    for k, scene in enumerate([scenes[0]] * 6 + [scenes[1]] * 6):
        searched = k in (0, 3, 8, 11)
        image = np.clip(3 * (scene.astype(float) - 110) + rng.normal(0, 2, scene.shape), 0, 255).astype(
            np.uint8
        )
        known: dict[str, Any] = {"frame_index": k, "image": image}
        tracks = tracker.update(seen, **known) if searched else tracker.predict(**known)
        listed.append(tracks.ids.tolist())
    assert listed == [[1]] * 6 + [[]] * 2 + [[2]] * 4
    assert tracker.scene_began == 6


def seen_since(ground, cameras, *, car_px=None):
    """Whether the last picture is still, after the first was looked at; a car comes so far into it."""
    motion, rng = CameraMotion(scale=None), np.random.default_rng(1)
    for index, camera in enumerate(cameras):
        image = shot(ground, camera, rng)
        if index == len(cameras) - 1 and car_px is not None:
            image[200:230, car_px : car_px + 60] = (20, 20, 220)
        motion.step(image)
        if index == 0:
            motion.mark()
    return motion.still()


def test_a_hovering_camera_is_still_and_one_that_flies_on_is_not(ground):
    """A flight over a town would be searched once a second, or a hovering drone three times."""
    hovering = [view(500 + 2 * np.sin(step), 300, 1.0, 0.2 * step) for step in range(6)]
    standing = [view(500, 300, 1.0, 0.0)] * 4
    assert seen_since(ground, hovering)
    assert seen_since(ground, standing)
    assert not seen_since(ground, standing, car_px=300), "what moves in a standing picture"
    assert not seen_since(ground, [view(500 + 8 * step, 300, 1.0, 0.0) for step in range(6)])


def test_before_a_look_and_after_another_size_nothing_is_still(ground):
    """The first pictures of a camera, or of another mode of it, would be passed over."""
    motion = CameraMotion(scale=None)
    assert not motion.still()
    motion.step(np.zeros((360, 640, 3), np.uint8))
    motion.mark()
    assert motion.still()
    motion.step(np.zeros((480, 640, 3), np.uint8))
    assert not motion.still()


def test_while_the_camera_turns_what_comes_into_view_is_searched_soon():
    """Who turns a camera to look at something would see it for a second without a box."""
    noise = np.random.default_rng(3).integers(0, 255, (23, 125), np.uint8)
    ground = cv2.cvtColor(cv2.resize(noise, (1000, 184)), cv2.COLOR_GRAY2BGR)

    def looks(speed_px):
        tracker = ByteTracker(TrackerSettings(camera_motion="flow"), fps=15)
        found: list[int] = []
        for k in range(46):
            left = speed_px * k
            known: dict[str, Any] = {"frame_index": k, "image": ground[:, left : left + 320]}
            if found and not tracker.is_due(k - found[-1], every=5, most=15):
                tracker.predict(**known)
                continue
            found.append(k)
            box = np.array([[300 - left, 60, 340 - left, 100]], np.float32)
            tracker.update(Detections(box, np.full(1, 0.9, np.float32), np.zeros(1, np.int32)), **known)
        return found

    assert looks(12) == list(range(0, 46, 5))
    assert looks(0) == [0, 15, 30, 45]
