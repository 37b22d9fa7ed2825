"""Stills in their places on the base picture."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.values import Image, View
from hvt_ground.perception.stills.decode import DecodedStill
from hvt_models.redetection import composite

SOURCE, BASE = (1280, 720), (320, 180)
VIEW = View.fitted(SOURCE, BASE, fit="letterbox")
GREY = np.full((180, 320, 3), 100, np.uint8)


def still(crop: tuple[int, int, int, int], image_bgr: Image) -> DecodedStill:
    return DecodedStill(image_bgr, crop, ((0.0, 0.0, 1.0, 1.0),), 0)


def one_colour(
    crop: tuple[int, int, int, int], *, colour=(0, 0, 255), size: tuple[int, int] | None = None
) -> DecodedStill:
    """A still of one colour; ``size`` as coded."""
    width, height = size or (crop[2] - crop[0], crop[3] - crop[1])
    return still(crop, np.full((height, width, 3), colour, np.uint8))


def texture(size: tuple[int, int]) -> Image:
    """A smooth picture whose place is told by its values."""
    rng = np.random.default_rng(7)
    noise = rng.integers(0, 255, (size[1] // 16, size[0] // 16, 3), np.uint8)
    return cv2.GaussianBlur(cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC), (0, 0), 3)


def test_the_still_takes_its_place_at_base_resolution():
    """The detector would look for the object where it is not."""
    picture = composite(GREY, [one_colour((400, 200, 480, 280))], view=VIEW)
    assert picture.shape == GREY.shape
    assert (picture[52:68, 102:118] == (0, 0, 255)).all()
    picture[50:70, 100:120] = 100
    assert (picture == 100).all()
    assert (GREY == 100).all(), "the decoded picture is left alone"


def test_the_seam_is_soft():
    """A hard edge around the still is a contour that a detector takes for an object's."""
    picture = composite(GREY, [one_colour((400, 200, 480, 280), colour=(200, 200, 200))], view=VIEW)
    across = picture[60, 98:104, 0].tolist()
    assert across == sorted(across)
    assert (across[1], 110 < across[2] < 190, across[-1]) == (100, True, 200)


@pytest.mark.parametrize("zoom", [1.0, 2.0, 1.7])
@pytest.mark.parametrize("size", [None, (50, 44)])
def test_a_still_lands_between_pixels_where_it_belongs(zoom, size):
    """Rounded to whole pixels a small object moves by a good part of itself, and its refined box with it."""
    source = texture(SOURCE)
    matrix = np.array([[0.25, 0, (0.25 - 1) / 2], [0, 0.25, (0.25 - 1) / 2]])
    whole = still((0, 0, *SOURCE), source)
    truth = composite(GREY, [whole], view=VIEW, zoom=zoom)
    base = cv2.warpAffine(cv2.GaussianBlur(source, (0, 0), 1.6), matrix, BASE, flags=cv2.INTER_CUBIC)
    if zoom == 1:
        inner = np.s_[4:-4, 4:-4]
        assert np.abs(truth[inner].astype(int) - base[inner]).mean() < 2, "the whole frame maps on itself"
    crop = (403, 201, 503, 289)
    image = source[crop[1] : crop[3], crop[0] : crop[2]]
    if size is not None:
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    picture = composite(GREY, [still(crop, image)], view=VIEW, zoom=zoom)
    x1, y1, x2, y2 = (round(edge * 0.25 * zoom) for edge in crop)
    inner = np.s_[y1 + 4 : y2 - 4, x1 + 4 : x2 - 4]
    error = np.abs(picture[inner].astype(int) - truth[inner]).mean()
    shifted = np.abs(np.roll(picture, 1, axis=1)[inner].astype(int) - truth[inner]).mean()
    assert error < 1.5
    assert shifted > 3 * error


def test_the_enlarged_picture_keeps_the_stills_detail():
    """At base resolution a network with a larger input is shown the blur that the still was sent against."""
    stripes = np.zeros((80, 80, 3), np.uint8)
    stripes[:, ::4] = stripes[:, 1::4] = 255  # lines of two source pixels: half a pixel of the base
    one = still((400, 200, 480, 280), stripes)
    plain = composite(GREY, [one], view=VIEW)
    fine = composite(GREY, [one], view=VIEW, zoom=4.0)
    assert fine.shape == (720, 1280, 3)
    assert plain[60, 104:116].std() < 10
    assert fine[240, 410:470].std() > 100
    assert (fine[:190] == 100).all()


def test_stills_at_the_border_and_shrunk_stills_fit():
    """One object at the edge of the picture would end the ground."""
    stills = [
        one_colour((0, 0, 41, 33)),
        one_colour((1240, 690, 1280, 720), colour=(0, 255, 0)),
        one_colour((600, 100, 1240, 600), size=(512, 400)),  # coded smaller than its crop
        one_colour((300, 300, 302, 301)),  # less than a pixel of the base
    ]
    picture = composite(GREY, stills, view=VIEW)
    assert picture[[3, -3, 90], [3, -3, 230]].tolist() == [[0, 0, 255], [0, 255, 0], [0, 0, 255]]


@settings(max_examples=40)
@given(
    st.tuples(st.integers(0, 1279), st.integers(0, 719), st.integers(1, 700), st.integers(1, 700)),
    st.sampled_from(["letterbox", "crop"]),
    st.sampled_from([(320, 180), (180, 320), (64, 64), (2560, 1440)]),
    st.sampled_from([1.0, 1.5]),
)
def test_any_crop_of_any_view_can_be_pasted(box, fit, base, zoom):
    """Some aspect ratio would end the ground."""
    x, y, width, height = box
    crop = (x, y, min(1280, x + width), min(720, y + height))
    view = View.fitted(SOURCE, base, fit=fit)
    picture = np.full((base[1], base[0], 3), 100, np.uint8)
    pasted = composite(picture, [one_colour(crop, colour=(200, 200, 200))], view=view, zoom=zoom)
    assert pasted.shape == (round(base[1] * zoom), round(base[0] * zoom), 3)
    assert 100 <= pasted.min() <= pasted.max() <= 200
