"""The base stream, out of the real x265."""

from __future__ import annotations

import numpy as np
import pytest

from clips import framed, hard_pictures, smooth_pictures
from hvt_common.errors import UserError
from hvt_common.vision.hevc import BaseDecoder
from hvt_edge.encode import PRESETS, BaseEncoder, EncoderSettings, keyframe_floor_bytes, minimum_bps

SIZE = (320, 192)
VPS, SPS, PPS, IDR = 32, 33, 34, (19, 20)


def settings(**changes) -> EncoderSettings:
    """A small stream."""
    return EncoderSettings(**{"size": SIZE, "fps": 15.0, "bitrate_bps": 200_000} | changes)


def nal_types(data: bytes) -> list[int]:
    """Types of the NAL units in an access unit (H.265, 7.3.1.2)."""
    assert data.startswith((b"\x00\x00\x01", b"\x00\x00\x00\x01"))
    return [part[0] >> 1 & 0x3F for part in data.split(b"\x00\x00\x01")[1:]]


def is_idr(data: bytes) -> bool:
    """Whether decoding can start here, with nothing from elsewhere."""
    types = nal_types(data)
    return {VPS, SPS, PPS} <= set(types) and any(one in IDR for one in types)


def encode(pictures, keyframes=(), **changes):
    """Access units of pictures."""
    encoder = BaseEncoder(settings(**changes))
    return [encoder.encode(frame, keyframe=frame.index in keyframes) for frame in framed(pictures)]


def test_each_frame_gives_its_unit_at_once():
    """The operator would see the world one or more frames late."""
    units = encode(smooth_pictures(20, size=SIZE))
    assert [unit.frame_index for unit in units] == list(range(20))
    assert all(nal_types(unit.data) for unit in units)
    assert [unit.capture_ns for unit in units] == [
        frame.capture_ns for frame in framed(smooth_pictures(20, size=SIZE))
    ]


@pytest.mark.parametrize("preset", ["ultrafast", "veryfast"])
def test_a_keyframe_comes_when_it_is_asked_for_and_only_then(preset):
    """A ground that joined late could not start at it; or keyframes would come that no budget was held for."""
    asked = (1, 4, 5, 12, 29)  # also right after another one, and at the cut
    units = encode(hard_pictures(58, size=SIZE), keyframes=asked, preset=preset)
    assert [unit.frame_index for unit in units if unit.keyframe] == [0, *asked]
    assert [unit.frame_index for unit in units if is_idr(unit.data)] == [0, *asked]
    for start in asked:
        decoder = BaseDecoder()
        assert all(decoder.decode(unit.data) is not None for unit in units[start : start + 3])


def test_the_same_pictures_give_the_same_bytes():
    """No table of the study and no bug report could be repeated."""
    pictures = hard_pictures(40, size=SIZE)
    first, second = (encode(pictures, keyframes=(7, 30)) for _ in range(2))
    assert [unit.data for unit in first] == [unit.data for unit in second]


def test_what_comes_back_is_what_went_in():
    """Colours would be off for every viewer and every detector behind it."""
    decoder = BaseDecoder()
    pictures = smooth_pictures(10, size=SIZE)
    for picture, unit in zip(pictures, encode(pictures, bitrate_bps=600_000), strict=True):
        error = decoder.decode(unit.data).astype(np.float64) - picture
    luma = error @ np.array([0.0722, 0.7152, 0.2126])
    assert abs(luma.mean()) < 0.3
    assert np.abs(error.mean(axis=(0, 1))).max() < 0.5
    assert 10 * np.log10(255**2 / (luma**2).mean()) > 40


def test_more_bits_show_more():
    """The budget would be spent and nothing gained."""
    pictures = hard_pictures(20, size=SIZE)
    errors = []
    for bitrate in (150_000, 600_000):
        decoder = BaseDecoder()
        decoded = [decoder.decode(unit.data) for unit in encode(pictures, bitrate_bps=bitrate)]
        errors.append(float(((decoded[9].astype(np.float64) - pictures[9]) ** 2).mean()))
    assert errors[1] < 0.8 * errors[0]


def test_the_given_arrays_are_left_alone():
    """Stills are cropped later from the very frame that was encoded."""
    pictures = hard_pictures(3, size=SIZE)
    copies = [picture.copy() for picture in pictures]
    encode(pictures)
    assert all(np.array_equal(one, other) for one, other in zip(pictures, copies, strict=True))


@pytest.mark.parametrize("size", [(64, 64), (1920, 1080), (322, 178)])
@pytest.mark.parametrize("fps", [0.5, 29.97])
def test_sizes_and_rates_at_the_rim_work(size, fps):
    """An odd camera could not be used."""
    encoder = BaseEncoder(settings(size=size, fps=fps, bitrate_bps=500_000, preset="ultrafast"))
    decoder = BaseDecoder()
    for frame in framed(smooth_pictures(3, size=size)):
        assert decoder.decode(encoder.encode(frame).data).shape == (size[1], size[0], 3)


def test_what_x265_refuses_is_one_sentence():
    """A traceback out of a C library in place of the setting's name."""
    with pytest.raises(UserError, match="x265 does not take 16x8 at 15 fps and 200 kbps"):
        BaseEncoder(settings(size=(16, 8)))


def test_every_preset_opens():
    """A preset that ``--help`` names would end the edge at its start."""
    picture = framed(smooth_pictures(1, size=(64, 64)))[0]
    for preset in PRESETS:
        assert BaseEncoder(settings(size=(64, 64), preset=preset)).encode(picture).keyframe


@pytest.mark.parametrize(("size", "count"), [((320, 180), 150), ((640, 360), 150), ((1280, 720), 60)])
def test_at_the_minimum_the_target_is_still_followed(size, count):
    """``hvt-edge`` would accept a budget that its base stream then overspends."""
    target = minimum_bps(size, 15)
    units = encode(hard_pictures(count, size=size), size=size, bitrate_bps=target)
    assert 0.7 * keyframe_floor_bytes(size) < len(units[0].data) < 1.3 * keyframe_floor_bytes(size)
    run_bps = 8 * sum(len(unit.data) for unit in units[1:]) / (count / 15)
    assert run_bps <= 1.1 * target
