"""The decoder of the base stream, fed by the real encoder."""

from fractions import Fraction

import av
import numpy as np
import pytest
from av.video.reformatter import ColorRange

from hvt_common.video.hevc import MAX_SIDE_PX, BaseDecoder, ToBgr, YuvPicture
from hvt_edge.video.encoder import EncoderSettings
from hvt_edge.video.x265 import BaseEncoder
from media.clips import framed, smooth_pictures

SIZE = (320, 192)


def coded(count, *, keyframes=(), size=SIZE):
    encoder = BaseEncoder(EncoderSettings(size=size, fps=15, bitrate_bps=300_000, preset="ultrafast"))
    return [
        encoder.encode(frame, keyframe=frame.index in keyframes).data
        for frame in framed(smooth_pictures(count, size=size))
    ]


def test_every_unit_gives_its_picture_at_once():
    """The picture would lag behind the flight, and a still's base crop would be that of another frame."""
    decoder = BaseDecoder()
    for index, data in enumerate(coded(12)):
        picture = decoder.decode(data)
        assert picture is not None
        assert picture.shape == (192, 320, 3)
        assert picture.dtype == np.uint8
        red = np.argwhere((picture[..., 2] > 180) & (picture[..., 0] < 90) & (picture[..., 1] < 110))
        assert abs(red[:, 1].min() - 7 * index) <= 3, "the square is where this very frame had it"


def test_colours_come_back_without_a_shift():
    """Every pixel would be two levels off: 0.9 dB that the bits have paid for."""
    pictures = smooth_pictures(6, size=SIZE)
    decoder = BaseDecoder()
    for picture, data in zip(pictures, coded(6), strict=True):
        error = decoder.decode(data).astype(np.float64) - picture
    assert np.abs(error.mean(axis=(0, 1))).max() < 0.35
    assert 10 * np.log10(255**2 / (error**2).mean()) > 36


def test_gray_is_the_luma_of_the_colours():
    """The ground would follow a camera by a flatter picture than an edge."""
    decoder = BaseDecoder()
    for data in coded(2):
        picture = decoder.decode_yuv(data)
        expected = picture.bgr() @ np.array([0.0722, 0.7152, 0.2126])
        assert picture.gray().dtype == np.uint8
        assert np.abs(picture.gray() - expected).mean() < 1


def test_gray_of_a_camera_of_full_range_is_not_stretched():
    """Below 16 and above 235 it would show nothing."""
    ramp = np.tile(np.arange(256, dtype=np.uint8), (16, 1))
    frame = av.VideoFrame.from_ndarray(
        np.concatenate((ramp, np.full((8, 256), 128, np.uint8))), format="yuvj420p"
    )
    frame.color_range = ColorRange.JPEG
    picture = YuvPicture(frame, ToBgr())
    assert np.array_equal(picture.gray(), ramp)
    assert np.abs(picture.bgr()[..., 1].astype(int) - picture.gray()).max() <= 2, "as the colours"


def test_garbage_gives_nothing_and_a_keyframe_mends_it():
    """One damaged unit would end the video; one without its keyframe would be a grey smear."""
    units, decoder = coded(8, keyframes=(4,)), BaseDecoder()
    assert [decoder.decode(data) for data in units[1:4]] == [None] * 3
    decoder = BaseDecoder()
    assert [decoder.decode(data) for data in (b"", b"\x00\x00\x01 no access unit at all" * 9)] == [None] * 2
    assert decoder.decode(units[0]) is not None
    decoder.reset()
    assert all(decoder.decode(units[index]) is not None for index in (4, 5))


def test_an_oversized_picture_is_not_taken():
    """A few hostile bytes would make the ground reserve gigabytes."""
    encoder = av.CodecContext.create("libx265", "w")
    encoder.width, encoder.height, encoder.pix_fmt = MAX_SIDE_PX + 64, 64, "yuv420p"
    encoder.time_base = Fraction(1, 15)
    encoder.options = {"preset": "ultrafast", "tune": "zerolatency", "x265-params": "log-level=none"}
    picture = av.VideoFrame(MAX_SIDE_PX + 64, 64, "yuv420p")
    picture.pts = 0
    units = [bytes(packet) for packet in encoder.encode(picture)]
    assert BaseDecoder().decode(b"".join(units)) is None
    assert BaseDecoder().decode(coded(1)[0]) is not None


@pytest.mark.parametrize("size", [(64, 64), (322, 178), (1920, 1080)])
def test_sizes_that_are_no_multiple_of_a_coding_block_are_cut_right(size):
    """The picture would have the encoder's padding at its right and lower border."""
    picture = BaseDecoder().decode(coded(1, size=size)[0])
    assert picture.shape == (size[1], size[0], 3)
