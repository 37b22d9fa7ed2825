"""What a candidate knows of its place in the picture, and of what the base lost."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from hvt_common.values import Tracks, View
from hvt_edge.perception.candidates import MOST_PSNR_DB, BaseLoss, TrackMemory, sharpness
from rigs.examples import tracks_of

VIEW = View.fitted((1280, 720), (640, 360), fit="letterbox")


def tracks(*boxes: tuple[float, float, float, float]) -> Tracks:
    """Confirmed cars, boxes in base pixels."""
    return tracks_of(0, boxes, confidences=0.8, started=True)


def candidates(*boxes: tuple[float, float, float, float], **pictures):
    """The candidates of one step."""
    return TrackMemory().candidates(
        tracks(*boxes), view=VIEW, class_names=("car",), now_ns=10**18, **pictures
    )


def test_only_what_stands_in_front_covers():
    """Stills would go to the half of a car that shows behind another one, and not to the one in front."""
    behind, front, apart = candidates((100, 100, 140, 140), (120, 110, 160, 150), (300, 100, 340, 140))
    assert behind.covered_share == pytest.approx(20 * 30 / 1600)
    assert front.covered_share == 0
    assert apart.covered_share == 0
    assert candidates() == []


def test_loss_is_measured_on_the_very_crop_and_once():
    """M6 would judge the base by another place, or by pixels that have changed since."""
    rng = np.random.default_rng(0)
    source = np.ascontiguousarray(
        rng.integers(0, 255, (90, 160, 3), dtype=np.uint8).repeat(8, 0).repeat(8, 1)
    )
    base = cv2.resize(source, (640, 360), interpolation=cv2.INTER_AREA)
    base[:, 320:] = 128  # the right half of the base shows nothing
    left, right = candidates((100, 100, 140, 140), (500, 100, 540, 140), source_bgr=source, base_bgr=base)
    # The box doubled, and 15 % on each side; at the base's grid the left half has lost nothing.
    crop = source[188:292, 188:292]
    assert left.loss() == BaseLoss(MOST_PSNR_DB, 0.0)
    assert right.loss().detail_lost == pytest.approx(1, abs=0.01)
    base[:] = 0
    assert left.loss() is left.loss()
    assert left.loss().detail_lost == 0
    assert left.sharpness is not None
    assert left.sharpness() == sharpness(crop)


def test_without_pictures_nothing_is_measured():
    """A stage that has no picture at hand would crash."""
    (alone,) = candidates((100, 100, 140, 140))
    assert alone.loss is None
    assert alone.sharpness is None
    source = np.zeros((720, 1280, 3), np.uint8)
    assert candidates((100, 100, 140, 140), source_bgr=source)[0].loss is None
