"""The quality of a still is searched for: the best that fits, and the least that is good enough."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.video.still_codecs import best_fitting, psnr_y_db, smallest_reaching, still_codec
from media.crops import textured, washed_out

CROP = textured(117, 50, seed=2)
BASE = washed_out(CROP)
SIZE = (117, 50)
WHOLE: dict[str, Any] = {"low_pct": 1, "high_pct": 100}


@pytest.mark.parametrize("name", ["jpeg", "h264-intra", "residual"])
@given(limit_bytes=st.integers(100, 4000))
@settings(max_examples=12)
def test_the_best_that_fits(name, limit_bytes):
    """A still would overrun its admission, or leave bytes unused that were paid for."""
    codec = still_codec(name)
    found = best_fitting(codec, CROP, limit_bytes=limit_bytes, base_bgr=BASE, **WHOLE)
    sizes = {q: len(codec.encode(CROP, quality_pct=q, base_bgr=BASE).data) for q in range(1, 101, 9)}
    if found is None:
        assert min(sizes.values()) > limit_bytes
        return
    coded, quality_pct = found
    assert coded == codec.encode(CROP, quality_pct=quality_pct, base_bgr=BASE)
    assert len(coded.data) <= limit_bytes
    assert all(size > limit_bytes for quality, size in sizes.items() if quality > quality_pct)


def test_a_search_for_enough_fits_and_takes_fewer_tries():
    """A board would code a large closer look until its requester is told that there was no room."""
    codec, tries = still_codec("jpeg"), {1.0: 0, 0.85: 0}
    for limit_bytes in range(800, 4000, 200):
        sizes = {}
        for enough in tries:
            tried = {}
            coded, _ = best_fitting(codec, CROP, limit_bytes=limit_bytes, tried=tried, enough=enough, **WHOLE)
            sizes[enough] = len(coded.data)
            tries[enough] += len(tried)
        assert sizes[0.85] <= limit_bytes
        assert sizes[0.85] >= min(sizes[1.0], 0.85 * limit_bytes)
    assert tries[0.85] < 0.8 * tries[1.0]


@pytest.mark.parametrize("name", ["jpeg", "h264-intra", "residual"])
@pytest.mark.parametrize("target_db", [31.0, 36.0, 40.5])
def test_the_least_that_reaches(name, target_db):
    """Every still would cost more than the classifier needs, or show it less."""
    codec = still_codec(name)
    found = smallest_reaching(codec, CROP, target_db=target_db, base_bgr=BASE, **WHOLE)
    assert found is not None
    coded, quality_pct, image, reached_db = found
    assert reached_db >= target_db
    assert reached_db == pytest.approx(psnr_y_db(image, CROP))
    again = codec.decode(coded.data, size=SIZE, parameters=coded.parameters, base_bgr=BASE)
    assert np.array_equal(again, image)
    if quality_pct > 1:
        less = codec.encode(CROP, quality_pct=quality_pct - 1, base_bgr=BASE)
        below = codec.decode(less.data, size=SIZE, parameters=less.parameters, base_bgr=BASE)
        assert psnr_y_db(below, CROP) < target_db


@pytest.mark.parametrize("name", ["h264-intra", "residual"])
@pytest.mark.parametrize("target_db", [31.0, 36.0, 40.5])
def test_a_search_takes_few_tries_and_none_twice(name, target_db):
    """Seven codings a still, half of them of one QP under two names, took more time than tracking."""
    codec, tried = still_codec(name), []

    class Counted:
        def __getattr__(self, attribute):
            return getattr(codec, attribute)

        def encode(self, *args, **settings):
            coded = codec.encode(*args, **settings)
            tried.append(coded.data)
            return coded

    smallest_reaching(Counted(), CROP, target_db=target_db, base_bgr=BASE, **WHOLE)
    assert len(tried) <= 6
    assert len(set(tried)) == len(tried)


def test_what_cannot_be_had_is_none_and_the_bounds_are_kept():
    """A still would be sent that breaks the budget, or is worse than the method's floor."""
    codec = still_codec("jpeg")
    assert best_fitting(codec, CROP, limit_bytes=50, **WHOLE) is None
    assert smallest_reaching(codec, CROP, target_db=70, **WHOLE) is None
    assert best_fitting(codec, CROP, limit_bytes=10**6, low_pct=35, high_pct=90)[1] == 90
    assert smallest_reaching(codec, CROP, target_db=1, low_pct=35, high_pct=90)[1] == 35
    assert best_fitting(codec, CROP, limit_bytes=10**6, low_pct=60, high_pct=60)[1] == 60


def test_psnr_is_that_of_luma():
    """A target in dB would mean another picture than in the tables."""
    assert psnr_y_db(CROP, CROP) == math.inf
    grey = np.full((8, 8, 3), 100, np.uint8)
    assert psnr_y_db(grey + 5, grey) == pytest.approx(20 * math.log10(255 / 5), abs=1e-3)
    blue = grey.copy()
    blue[..., 0] += 10
    assert psnr_y_db(blue, grey) == pytest.approx(20 * math.log10(255 / 1.14), abs=1e-3)
