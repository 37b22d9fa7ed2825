"""Vehicles tell whether the camera looks aslant."""

from __future__ import annotations

import numpy as np
import pytest

from hvt_common.values import Tracks
from hvt_ground.perception.stills.refine import ViewTilt
from rigs.examples import tracks_of

NAMES = ("car", "pedestrian")


def vehicles(growth: float, *, seed: int, count: int = 6) -> Tracks:
    """Cars, and a truck among them, ``growth`` times larger at the bottom than at the top."""
    rng = np.random.default_rng(seed)
    rows = rng.uniform(40, 680, count)
    sides = 30 * growth ** (rows / 720) * rng.uniform(0.8, 1.25, count)
    sides[0] *= 2
    left = rng.uniform(0, 1200, count)
    return tracks_of(0, np.column_stack((left, rows - sides / 2, left + sides, rows + sides / 2)))


@pytest.mark.parametrize(("growth", "aslant"), [(1.0, False), (1.5, False), (2.5, True), (6.0, True)])
def test_sizes_that_grow_down_the_picture_tell(growth, aslant):
    """A class would have a check mark that is right every second time."""
    tilt = ViewTilt()
    for seed in range(8):
        tilt.take(vehicles(growth, seed=seed), NAMES, height_px=720)
    assert tilt.aslant is aslant


def test_a_gimbal_that_turns_is_followed():
    """After a look at the horizon no class of the whole flight would be sure."""
    tilt = ViewTilt()
    for growth, aslant in ((6.0, True), (1.0, False), (6.0, True)):
        for seed in range(30):
            tilt.take(vehicles(growth, seed=seed), NAMES, height_px=720)
        assert tilt.aslant is aslant


def test_too_few_tell_nothing():
    """Two cars, of which one is a truck, would tilt the camera."""
    tilt = ViewTilt()
    tilt.take(tracks_of(0, [[0, 0, 20, 20], [0, 600, 60, 660]]), NAMES, height_px=720)
    tilt.take(Tracks.none(1), NAMES, height_px=720)
    assert not tilt.aslant
    for _ in range(30):  # side by side
        tilt.take(tracks_of(0, [[0, 300, 20, 320], [80, 300, 140, 360]]), NAMES, height_px=720)
    assert not tilt.aslant


@pytest.mark.parametrize("changes", [{"classes": 1}, {"seen": -1}], ids=["people", "carried on"])
def test_what_is_no_vehicle_or_was_not_just_seen_tells_nothing(changes):
    """Their sizes say nothing of the view, and a track that is only carried on keeps its size."""
    tilt = ViewTilt()
    for seed in range(8):
        boxes = vehicles(6.0, seed=seed).boxes_xyxy_px
        tilt.take(tracks_of(0, boxes, **changes), NAMES, height_px=720)
    assert not tilt.aslant
