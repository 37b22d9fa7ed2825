"""What a decoded picture shows of a crop, in whole numbers."""

import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.values import Frame, View
from hvt_common.video.base_crop import base_crop, exact_base_crop
from hvt_common.video.hevc import BaseDecoder
from hvt_common.video.still_codecs import psnr_y_db
from hvt_edge.video.encoder import EncoderSettings
from hvt_edge.video.x265 import BaseEncoder
from media.crops import textured

SIZE = (320, 192)


@pytest.fixture(scope="module")
def picture():
    image = textured(*SIZE, seed=2)
    encoder = BaseEncoder(EncoderSettings(size=SIZE, fps=10, bitrate_bps=2_000_000))
    found = BaseDecoder().decode_yuv(encoder.encode(Frame(0, 0, image, image), keyframe=True).data)
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("view", "crop", "size"),
    [
        (View((960, 576), SIZE, 1 / 3, (0.0, 0.0)), (300, 200, 417, 251), (117, 51)),
        (View((960, 576), SIZE, 1 / 3, (0.0, 0.0)), (0, 0, 960, 576), (512, 307)),
        (View((900, 576), SIZE, 1 / 3, (10.0, 0.0)), (0, 500, 90, 576), (90, 76)),
        (View(SIZE, SIZE, 1.0, (0.0, 0.0)), (20, 30, 220, 130), (200, 100)),
        (View((160, 96), SIZE, 2.0, (0.0, 0.0)), (20, 20, 90, 60), (70, 40)),
        (View((80, 48), SIZE, 4.0, (0.0, 0.0)), (3, 5, 70, 41), (67, 36)),
    ],
)
def test_it_is_the_picture_of_that_place(picture, view, crop, size):
    """A still would be the difference to another place, and cost the bytes of a whole picture."""
    exact = base_crop(picture, view=view, crop_source_px=crop, size=size)
    usual = base_crop(picture.bgr(), view=view, crop_source_px=crop, size=size)
    assert exact.shape == (size[1], size[0], 3)
    assert psnr_y_db(exact, usual) > 40
    aside = base_crop(picture.bgr(), view=view, crop_source_px=(crop[0] + 1, *crop[1:]), size=size)
    assert psnr_y_db(exact, usual) > psnr_y_db(exact, aside)


def slowly(planes, view, crop, size, place):
    """One pixel, B, G, R, as docs/wire-stills.md states it, in Python's whole numbers."""

    def fixed(value):
        return math.floor(value * 65536 + 0.5)

    def taps(origin, step, i, length):
        n = max(1, -(-step // 65536))
        found = []
        for j in range(i * n, (i + 1) * n):
            q = (origin + (2 * j + 1) * step // (2 * n) - 32768 + 1024) // 2048
            k, t = q // 32, Fraction(q % 32, 32)
            a = Fraction(-3, 4)  # the kernel of Keys, as its author has it
            weights = (
                a * (t**3 - 2 * t**2 + t),
                (a + 2) * t**3 - (a + 3) * t**2 + 1,
                -(a + 2) * t**3 + (2 * a + 3) * t**2 - a * t,
                a * (t**2 - t**3),
            )
            for one, weight in enumerate(weights, -1):
                found.append((min(max(k + one, 0), length - 1), int(weight * 2**17)))
                assert weight * 2**17 == found[-1][1]
        return found, n

    levels = []
    for plane, part in zip(planes, (1, 2, 2), strict=True):
        axes = []
        for low, high, offset, count, i, length in (
            (crop[1], crop[3], view.offset_px[1], size[1], place[1], plane.shape[0]),
            (crop[0], crop[2], view.offset_px[0], size[0], place[0], plane.shape[1]),
        ):
            origin, step = fixed(low * view.scale + offset), fixed((high - low) / count * view.scale)
            axes.append(taps(origin // part, step // part, i, length))
        (rows, ny), (columns, nx) = axes
        total = sum(wy * wx * int(plane[y, x]) for y, wy in rows for x, wx in columns)
        t = nx * ny * 2**28
        levels.append(min(max((total + t // 2) // t, 0), 16320))
    y, b, r = 76309 * (levels[0] - 1024) + 2097152, levels[1] - 8192, levels[2] - 8192
    sums = (y + 138438 * b, y - 13975 * b - 34925 * r, y + 117489 * r)
    return [min(max(one // 4194304, 0), 255) for one in sums]


@given(draw=st.data())
@settings(max_examples=40, deadline=None)
def test_every_pixel_is_as_the_document_states_it(draw):
    """Who writes a ground in another language would ask for every still again."""
    width, height = draw.draw(st.integers(1, 70)), draw.draw(st.integers(1, 50))
    rng = np.random.default_rng(draw.draw(st.integers(0, 99)))
    half = -(-height // 2), -(-width // 2)
    planes: Any = tuple(rng.integers(0, 256, shape, np.uint8) for shape in ((height, width), half, half))
    scale = draw.draw(st.floats(0.05, 6))
    x1, y1 = draw.draw(st.integers(0, 300)), draw.draw(st.integers(0, 300))
    wide, high = draw.draw(st.integers(1, 200)), draw.draw(st.integers(1, 200))
    size = draw.draw(st.integers(1, wide)), draw.draw(st.integers(1, high))
    offset = draw.draw(st.tuples(st.floats(-40, 40), st.floats(-40, 40)))
    view, crop = View((1, 1), (width, height), scale, offset), (x1, y1, x1 + wide, y1 + high)
    exact = exact_base_crop(planes, view=view, crop_source_px=crop, size=size)
    for _ in range(4):
        x, y = draw.draw(st.integers(0, size[0] - 1)), draw.draw(st.integers(0, size[1] - 1))
        assert exact[y, x].tolist() == slowly(planes, view, crop, size, (x, y))
