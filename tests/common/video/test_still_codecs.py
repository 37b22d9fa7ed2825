"""What every still codec of HVT promises, one test for all of them."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hvt_common.video.still_codecs import (
    CodedCrop,
    StillCodec,
    StillError,
    psnr_y_db,
    still_codec,
    still_codec_names,
)
from media.clips import real_pictures
from media.crops import textured, washed_out

NAMES = ("jpeg", "webp", "avif", "jxl", "h264-intra", "residual")
SIZE = (56, 40)


@pytest.fixture(params=NAMES)
def codec(request) -> StillCodec:
    """Each codec that this machine has."""
    if request.param not in still_codec_names():
        pytest.skip(f"{request.param} is not installed")
    return still_codec(request.param)


def encoded(codec: StillCodec, crop: np.ndarray, quality_pct: int) -> CodedCrop:
    """With the base that it may want."""
    return codec.encode(crop, quality_pct=quality_pct, base_bgr=_base(codec, crop))


def decoded(codec: StillCodec, coded: CodedCrop, crop: np.ndarray, data: bytes | None = None) -> np.ndarray:
    """As the ground does, from other bytes if given."""
    return codec.decode(
        coded.data if data is None else data,
        size=(crop.shape[1], crop.shape[0]),
        parameters=coded.parameters,
        base_bgr=_base(codec, crop),
    )


def _base(codec: StillCodec, crop: np.ndarray) -> np.ndarray | None:
    return washed_out(crop) if codec.needs_base else None


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (15, 17), (16, 16), (117, 50), (33, 130), (512, 9)])
def test_every_size_comes_back(codec, size):
    """A small or odd crop would fail at the ground, or come back shifted."""
    crop = textured(*size, seed=sum(size))
    back = decoded(codec, encoded(codec, crop, 95), crop)
    assert back.shape == crop.shape
    assert back.dtype == np.uint8
    assert back.flags.c_contiguous
    assert psnr_y_db(back, crop) > 33


def test_the_same_crop_gives_the_same_bytes(codec):
    """No run of a study could be made again."""
    crop = textured(117, 50)
    first, *others = (encoded(codec, crop, 65) for _ in range(3))
    assert all(other == first for other in others)


def test_more_quality_is_better_and_larger(codec):
    """A search for the best that fits would end in the wrong place."""
    crop = textured(120, 72, seed=4)
    coded = [encoded(codec, crop, quality) for quality in (1, 20, 40, 60, 80, 100)]
    reached = [psnr_y_db(decoded(codec, one, crop), crop) for one in coded]
    sizes = [len(one.data) for one in coded]
    for row in (reached, sizes):
        assert row == sorted(row)
        assert len(set(row)) >= 5, "a residual has nothing to say at the lowest"


@pytest.mark.realdata
@pytest.mark.parametrize("quality_pct", [35, 65, 90])
def test_quality_means_the_same_for_all(codec, quality_pct, data):
    """A user who changes the codec would have to find all quality settings anew."""
    (picture,) = real_pictures(data / "clips/drone_carpark.mp4", 1, size=(1100, 720))
    corners = [(x, y) for x in (150, 400, 650, 850) for y in (150, 300, 450, 600)]
    crops = [np.ascontiguousarray(picture[y : y + 50, x : x + 117]) for x, y in corners]
    jpeg = still_codec("jpeg")

    def mean_db(one: StillCodec) -> float:
        return float(np.mean([psnr_y_db(decoded(one, encoded(one, c, quality_pct), c), c) for c in crops]))

    assert mean_db(codec) == pytest.approx(mean_db(jpeg), abs=2.0)


def test_colours_stay(codec):
    """Red cars would be sent as another red, or every still come a level or two too dark."""
    crop = np.empty((48, 64, 3), np.uint8)
    for column, colour in enumerate(((20, 30, 220), (210, 60, 20), (128, 128, 128), (235, 240, 250))):
        crop[:, column * 16 : column * 16 + 16] = colour
    back = decoded(codec, encoded(codec, crop, 95), crop).astype(float)
    for column, off in enumerate((6, 6, 3, 3)):
        inner = (slice(4, -4), slice(column * 16 + 4, column * 16 + 12))
        assert np.abs(back[inner].mean(axis=(0, 1)) - crop[inner][0, 0]).max() < off, column


def test_what_crosses_the_link_is_small(codec):
    """A still's header would not take its parameters."""
    parameters = encoded(codec, textured(40, 30), 65).parameters
    assert len(parameters) <= 6
    assert all(len(key.encode()) <= 16 for key in parameters)
    assert len(codec.name) <= 24


@cache
def _middling(codec: StillCodec) -> CodedCrop:
    return encoded(codec, textured(*SIZE), 50)


@given(draw=st.data())
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_hostile_bytes_only_raise_still_error(codec, draw):
    """Someone on the link would take the ground down with one message."""
    crop = textured(*SIZE)
    coded = _middling(codec)
    data = bytearray(coded.data)
    for _ in range(draw.draw(st.integers(1, 3))):
        at = draw.draw(st.integers(0, len(data)))
        gone = draw.draw(st.integers(0, 12))
        data[at : at + gone] = draw.draw(st.binary(max_size=24))
    try:
        image = decoded(codec, coded, crop, bytes(data))
    except StillError:
        return
    assert image.shape == crop.shape


@given(noise=st.binary(max_size=300))
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_noise_only_raises_still_error(codec, noise):
    """Foreign bytes on the key would raise something that no stage catches."""
    crop = textured(*SIZE)
    try:
        image = decoded(codec, _middling(codec), crop, noise)
    except StillError:
        return
    assert image.shape == crop.shape


@pytest.mark.parametrize("name", ["jpeg", "webp", "avif", "jxl"])
@pytest.mark.parametrize("size", [(55, 40), (56, 41), (600, 400)])
def test_a_header_of_another_size_is_refused(name, size):
    """A few bytes would make the ground allocate gigabytes, or paint a still over the wrong place."""
    if name not in still_codec_names():
        pytest.skip(f"{name} is not installed")
    codec = still_codec(name)
    data = codec.encode(textured(*size), quality_pct=1).data
    with pytest.raises(StillError):
        codec.decode(data, size=SIZE)
    assert codec.decode(data, size=size).shape == (size[1], size[0], 3)
