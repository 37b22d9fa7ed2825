"""What a decoded picture shows of a crop, in whole numbers."""

import pytest

from hvt_common.values import Frame, View
from hvt_common.video.base_crop import base_crop
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
