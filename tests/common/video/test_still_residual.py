"""The residual still: small, exact where nothing was lost, and never painted on another base."""

import numpy as np
import pytest

from hvt_common.video.still_codecs import (
    BaseMissingError,
    StillError,
    psnr_y_db,
    smallest_reaching,
    still_codec,
)
from hvt_common.video.still_codecs.residual import CHECKSUM
from hvt_common.video.still_codecs.yuv420 import difference_bgr, filled_outside, to_bgr, to_planar
from media.crops import textured, washed_out

CODEC = still_codec("residual")
SIZE = (117, 50)


@pytest.fixture(scope="module")
def pair():
    crop = textured(*SIZE, seed=2)
    return crop, washed_out(crop)


def test_a_perfect_base_costs_next_to_nothing(pair):
    """Stills of what the base already shows would eat the budget of those that it lost."""
    crop, _ = pair
    coded = CODEC.encode(crop, quality_pct=65, base_bgr=crop)
    assert len(coded.data) <= 12
    back = CODEC.decode(coded.data, size=SIZE, parameters=coded.parameters, base_bgr=crop)
    assert np.array_equal(back, crop)


def test_it_is_far_smaller_than_any_still_by_itself(pair):
    """The product's promise: more detail per bit than pictures that know nothing of the base."""
    crop, base = pair
    jpeg = still_codec("jpeg")
    data = jpeg.encode(crop, quality_pct=65).data
    target_db = psnr_y_db(jpeg.decode(data, size=SIZE), crop)
    assert target_db > psnr_y_db(base, crop) + 3, "the base leaves something to say"
    found = smallest_reaching(CODEC, crop, target_db=target_db, low_pct=1, high_pct=100, base_bgr=base)
    assert found is not None
    coded, _, image, reached_db = found
    assert reached_db >= target_db
    assert np.array_equal(
        image, CODEC.decode(coded.data, size=SIZE, parameters=coded.parameters, base_bgr=base)
    )
    assert len(coded.data) <= 0.6 * len(data)


@pytest.mark.parametrize("quality_pct", [1, 35, 65, 90])
def test_it_never_makes_the_base_worse(pair, quality_pct):
    """A refined object would look worse than before it was refined."""
    crop, base = pair
    coded = CODEC.encode(crop, quality_pct=quality_pct, base_bgr=base)
    back = CODEC.decode(coded.data, size=SIZE, parameters=coded.parameters, base_bgr=base)
    assert psnr_y_db(back, crop) >= psnr_y_db(base, crop)


def test_another_base_is_noticed(pair):
    """A difference would be painted on another picture: an object that nobody saw."""
    crop, base = pair
    coded = CODEC.encode(crop, quality_pct=65, base_bgr=base)
    other = base.copy()
    other[-1, -1, 0] ^= 1
    bases = [(coded.parameters, wrong) for wrong in (other, None, base[:, :-1], base[..., 0])]
    for parameters, wrong in bases + [
        (said, base) for said in ({}, {CHECKSUM: 0}, {CHECKSUM: "x"}, {CHECKSUM: float("nan")})
    ]:
        with pytest.raises(BaseMissingError):
            CODEC.decode(coded.data, size=SIZE, parameters=parameters, base_bgr=wrong)
    for wrong in (None, base[:-1]):
        with pytest.raises(BaseMissingError):
            CODEC.encode(crop, quality_pct=65, base_bgr=wrong)
    for data in (b"", b"\x20", b"\x40abc", b"\xff\x00\x00\x01"):
        with pytest.raises(StillError):
            CODEC.decode(data, size=SIZE, parameters=coded.parameters, base_bgr=base)


def test_black_and_white_survive_the_planes():
    """A black or white base would be a level off everywhere, or break the reference picture's bytes."""
    for level in (0, 1, 128, 255):
        crop = np.full((20, 30, 3), level, np.uint8)
        planar = to_planar(crop)
        assert planar.min() >= 1
        assert np.abs(to_bgr(planar, size=(30, 20)).astype(int) - level).max() <= 1
        assert not difference_bgr(planar, planar, size=(30, 20)).any()


def test_beyond_the_crop_the_source_is_the_base(pair):
    """Pixels that nobody sees would cost up to a sixth of the still."""
    crop, base = pair
    source, below = to_planar(crop), to_planar(base)
    filled = filled_outside(source, below, size=SIZE)
    high = filled.shape[0] * 2 // 3
    assert np.array_equal(filled[: SIZE[1], : SIZE[0]], source[: SIZE[1], : SIZE[0]])
    assert np.array_equal(filled[SIZE[1] : high], below[SIZE[1] : high])
    assert np.array_equal(filled[:high, SIZE[0] :], below[:high, SIZE[0] :])
