"""Where another scene begins, and where there is only little to see."""

import itertools
from functools import cache, partial

import cv2
import numpy as np
import pytest

from hvt_common.camera_motion import SceneChange

SIZE = (640, 360)


def plain(level, *, noise, boats=0, waves=0.0, seed=1):
    """A grey ground with small objects that move slowly, one picture a decision step."""
    rng = np.random.default_rng(seed)
    places, steps = rng.uniform(50, 300, (boats, 2)), rng.uniform(-4, 4, (boats, 2))
    pictures = []
    for k in range(12):
        ground = np.full(SIZE[::-1], level, np.float32)
        swell = rng.normal(0, waves, (22, 40)).astype(np.float32)
        ground += cv2.resize(swell, SIZE, interpolation=cv2.INTER_CUBIC)
        for place, step in zip(places, steps, strict=True):
            x, y = (place + step * k).astype(int)
            ground[y : y + 8, x : x + 8] += 60 if level < 200 else -60
        pictures.append(filmed(ground, noise, rng))
    return pictures


def structured(contrast, level, *, noise, seed):
    """Soft shapes that drift: hills in fog, or a landscape at night."""
    rng = np.random.default_rng(seed)
    shapes = cv2.resize(rng.normal(0, contrast, (8, 12)), (720, 360), interpolation=cv2.INTER_CUBIC)
    return [filmed(level + shapes[:, 2 * k : 2 * k + SIZE[0]], noise, rng) for k in range(12)]


def filmed(ground, noise, rng):
    """With a sensor's noise, in 8 bits."""
    return np.clip(np.rint(ground[..., None] + rng.normal(0, noise, (*ground.shape, 3))), 0, 255).astype(
        np.uint8
    )


SCENES = {
    "land": partial(structured, 30, 110, noise=2, seed=7),
    "calm sea": partial(plain, 100.5, noise=3, boats=1),
    "sea without noise": partial(plain, 60.5, noise=0, boats=1),
    "waves": partial(plain, 140, noise=3, boats=3, waves=8),
    "snow": partial(plain, 235.4, noise=2, boats=2),
    "white": partial(plain, 254, noise=3),
    "fog": partial(structured, 5, 170, noise=3, seed=5),
    "night": partial(structured, 1, 4, noise=3, seed=6),
    "dark": partial(plain, 2, noise=3),
}

# Of two dark or white ones nobody sees which it is.
CUTS = [
    cut for cut in itertools.permutations(SCENES, 2) if set(cut) not in ({"dark", "night"}, {"snow", "white"})
]


@cache
def scene(name):
    return SCENES[name]()


def changes(pictures):
    change = SceneChange()
    return [k for k, one in enumerate(pictures) if change.take(one)]


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_of_little_contrast_is_one_scene(name):
    """Over water, snow and fog what was measured would be forgotten at each step: no tracks are ever sent."""
    assert changes(scene(name)) == []


@pytest.mark.parametrize(("before", "after"), CUTS)
def test_a_cut_is_seen_in_each(before, after):
    """What was measured of the scene before would hold decisions for seconds."""
    assert 6 in changes(scene(before)[:6] + scene(after)[:6])


def test_a_fast_flight_is_one_scene_and_exposure_is_no_other():
    """All tracks would end with each frame of a fast flight, or where the camera opens its iris."""
    rng = np.random.default_rng(3)
    land = cv2.resize(rng.normal(110, 40, (30, 400)), (12_000, 360), interpolation=cv2.INTER_CUBIC)
    assert changes([filmed(land[:, 640 * k : 640 * k + SIZE[0]], 2, rng) for k in range(12)]) == []
    assert changes([filmed(np.full(SIZE[::-1], 80.5 + 12 * (k % 2)), 3, rng) for k in range(12)]) == []
