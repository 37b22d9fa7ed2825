"""Codes on the roofs of the drawn scene, and their truth."""

import cv2
import numpy as np
import pytest

from hvt_scene import Scene
from hvt_scene.drawing.codes import ALPHABET, CODE_LENGTH, HEIGHTS_PX
from hvt_scene.drawing.vehicles import CLASS_NAMES

MOMENTS = (0.0, 6.4, 13.0)


@pytest.fixture(scope="module")
def pair():
    """Draw one seed without codes and with them."""
    return Scene(2), Scene(2, codes=True)


def test_codes_change_nothing_but_the_roofs_that_bear_them(pair):
    """A comparison with and without codes would compare two scenes."""
    plain, marked = pair
    for t_s in MOMENTS:
        first, second = plain.truth(t_s), marked.truth(t_s)
        assert np.array_equal(first.boxes_source_px, second.boxes_source_px)
        assert np.array_equal(first.visible, second.visible)
        if t_s != MOMENTS[1]:
            continue
        changed = np.abs(plain.image(t_s).astype(int) - marked.image(t_s)).max(2) > 8
        for code in marked.codes(t_s):
            x1, y1, x2, y2 = np.round(code.box_source_px).astype(int)
            margin = int(0.6 * code.height_px) + 2
            changed[max(0, y1 - margin) : y2 + margin, max(0, x1 - margin) : x2 + margin] = False
        assert not changed.any()


def test_a_code_lies_on_its_body_and_stands_out(pair):
    """The reader would be sent to the wrong place, or there would be nothing to read."""
    _, marked = pair
    image, truth = cv2.cvtColor(marked.image(6.4), cv2.COLOR_BGR2GRAY), marked.truth(6.4)
    boxes = dict(zip(truth.ids.tolist(), truth.boxes_source_px.tolist(), strict=True))
    kinds = dict(zip(truth.ids.tolist(), truth.class_ids.tolist(), strict=True))
    whole = [code for code in marked.codes(6.4) if code.visible > 0.95]
    assert len(whole) >= 8
    for code in whole:
        x1, y1, x2, y2 = boxes[code.object_id]
        left, top, right, bottom = code.box_source_px
        assert x1 < left < right < x2
        assert y1 < top < bottom < y2
        assert CLASS_NAMES[kinds[code.object_id]] in ("van", "truck", "bus")
        assert len(code.text) == CODE_LENGTH
        assert set(code.text) <= set(ALPHABET)
        inner = image[round(top) : round(bottom), round(left) : round(right)]
        assert np.ptp(np.percentile(inner, (10, 90))) > 60


@pytest.mark.parametrize("size", [(1920, 1080), (3840, 2160)])
def test_characters_have_their_height_in_pixels_of_the_source(size):
    """A 4K source would be given larger codes, and every method would read them."""
    scene = Scene(1, size=size, codes=True)
    heights = [code.height_px for t_s in MOMENTS for code in scene.codes(t_s)]
    # The camera rises and sinks by an eighth about its mean altitude.
    assert HEIGHTS_PX[0] * 0.85 <= min(heights) < 8
    assert 9 < max(heights) <= HEIGHTS_PX[1] * 1.2
    assert scene.size == size


def test_no_two_characters_look_alike():
    """A reader would be scored on a guess."""
    assert len(set(ALPHABET)) == len(ALPHABET)
    for pair_ in ("O0", "B8", "S5", "Z2", "I1", "G6", "VY", "MW", "69", "UV", "CG", "L7", "DO", "Q0"):
        assert not set(pair_) <= set(ALPHABET)
