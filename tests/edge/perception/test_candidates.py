"""What a candidate knows of its place in the picture, and of what the base lost."""

import cv2
import numpy as np
import pytest

from hvt_common.values import View
from hvt_edge.perception.candidates import MOST_PSNR_DB, BaseLoss, TrackMemory, measure_loss, sharpness
from rigs.examples import tracks_of

VIEW = View.fitted((1280, 720), (640, 360), fit="letterbox")


def candidates(*boxes: tuple[float, float, float, float], **pictures):
    tracks = tracks_of(0, boxes, confidences=0.8, started=True)
    return TrackMemory().candidates(tracks, view=VIEW, class_names=("car",), now_ns=10**18, **pictures)


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


def texture(size: tuple[int, int] = (60, 80)) -> np.ndarray:
    rng = np.random.default_rng(1)
    blocks = rng.integers(40, 215, (size[0] // 4 + 1, size[1] // 4 + 1, 3), dtype=np.uint8)
    return np.ascontiguousarray(blocks.repeat(4, 0).repeat(4, 1)[: size[0], : size[1]])


def test_psnr_is_that_of_luma():
    """The gate would hold back stills, or let them go, by a figure that is not the one documented."""
    source = np.full((32, 32, 3), 100, np.uint8)
    assert measure_loss(source, source + np.uint8(5)).psnr_y_db == pytest.approx(34.151, abs=1e-3)
    blue = source.copy()
    blue[..., 0] += 100  # 11.4 of luma
    assert measure_loss(source, blue).psnr_y_db == pytest.approx(20 * np.log10(255 / 11.4), abs=1e-3)
    assert measure_loss(source, source).psnr_y_db == MOST_PSNR_DB


def test_detail_is_lost_by_blur_and_not_by_what_the_base_adds():
    """M6 would ask for stills of flat road, or leave a blurred number plate as it is."""
    source = texture()
    half = ((source.astype(np.float32) - 127) / 2 + 127).round().astype(np.uint8)
    noisy = np.clip(source + np.random.default_rng(2).normal(0, 8, source.shape), 0, 255).astype(np.uint8)
    assert measure_loss(source, source).detail_lost == 0
    assert measure_loss(source, cv2.GaussianBlur(source, (0, 0), 4)).detail_lost > 0.9
    assert measure_loss(source, half).detail_lost == pytest.approx(0.5, abs=0.02)
    assert measure_loss(source, noisy).detail_lost < 0.05
    blurs = [
        measure_loss(source, cv2.GaussianBlur(source, (0, 0), sigma)).detail_lost
        for sigma in (0.4, 0.7, 1, 2)
    ]
    assert blurs == sorted(blurs)
    flat = np.full((32, 32, 3), 100, np.uint8)
    assert measure_loss(flat, flat + np.uint8(9)).detail_lost == 0


@pytest.mark.parametrize("size", [(1, 1), (1, 90), (8, 8), (300, 500)])
def test_any_crop_has_a_loss_between_nothing_and_all(size):
    """One odd crop at the border would end the flight."""
    source = texture(size)
    loss = measure_loss(source, 255 - source)
    assert 0 <= loss.detail_lost <= 1
    assert 0 < loss.psnr_y_db < 30
