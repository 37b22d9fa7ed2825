"""The gate: what the base shows well enough."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from clips import hard_pictures
from hvt_edge.perception.base_loss import BaseLoss, measure_loss
from hvt_edge.stills.gate import Gate

CROP = hard_pictures(1, size=(160, 96))[0]


@pytest.mark.parametrize(
    ("psnr_y_db", "detail_lost", "good"),
    [(36.0, 0.0, True), (35.9, 0.0, False), (60.0, 0.4, True), (60.0, 0.41, False)],
)
def test_both_conditions_have_to_hold(psnr_y_db, detail_lost, good):
    """An object whose edges are gone, or whose colours are wrong, would never be shown."""
    assert Gate(psnr_y_db=36.0).good_enough(BaseLoss(psnr_y_db, detail_lost)) == good


def test_off_it_holds_nothing_back():
    """The paper's methods would lose stills."""
    gate = Gate()
    assert not gate.on
    assert not gate.good_enough(BaseLoss(99.0, 0.0))


def test_a_dim_object_without_its_edges_is_not_good():
    """PSNR alone would call every object in the shade good: there is little of anything to lose."""
    gate = Gate(psnr_y_db=36.0)
    dim = (CROP * 0.12).astype(np.uint8)
    loss = measure_loss(dim, cv2.GaussianBlur(dim, (0, 0), 3))
    assert loss.psnr_y_db > 36
    assert not gate.good_enough(loss)
    assert gate.good_enough(measure_loss(dim, dim))
