"""Still codecs: sizes like the paper's, and nothing hostile gets decoded."""

from __future__ import annotations

import io

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image as Pillow

from hvt_common.errors import UserError
from hvt_common.vision.still_codecs import STILL_CODECS, JpegCodec, StillError, jpeg_size, still_codec

CODEC = JpegCodec()


def textured(width: int, height: int, *, seed: int = 0) -> np.ndarray:
    """A smooth random picture."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (max(2, height // 6), max(2, width // 6), 3), dtype=np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    """Over all three channels, in dB."""
    return float(10 * np.log10(255**2 / np.mean((one.astype(np.float64) - other) ** 2)))


def pillow_jpeg(image_bgr: np.ndarray, **options) -> bytes:
    """The same picture as Pillow codes it."""
    buffer = io.BytesIO()
    Pillow.fromarray(image_bgr[..., ::-1].copy()).save(buffer, "JPEG", **options)
    return buffer.getvalue()


@pytest.mark.parametrize("quality_pct", [35, 65, 90])
def test_jpeg_costs_what_the_paper_s_pillow_setting_costs(quality_pct):
    """A user who compares with the paper would pay 19 % more for each still, as OpenCV does unasked."""
    crops = [textured(96 + 7 * seed, 64 + 5 * seed, seed=seed) for seed in range(8)]
    ours = sum(len(CODEC.encode(crop, quality_pct=quality_pct)) for crop in crops)
    theirs = sum(len(pillow_jpeg(crop, quality=quality_pct, optimize=True)) for crop in crops)
    assert ours == pytest.approx(theirs, rel=0.005)


@pytest.mark.realdata
def test_real_crops_cost_and_look_like_pillow(data):
    """On a real picture the stills would be larger or worse than the paper's."""
    picture = cv2.imread(str(data / "aerial_highway.jpg"))
    crop = np.ascontiguousarray(picture[100:260, 200:400])
    coded = CODEC.encode(crop, quality_pct=65)
    reference = pillow_jpeg(crop, quality=65, optimize=True)
    assert len(coded) == pytest.approx(len(reference), rel=0.01)
    theirs = CODEC.decode(reference, max_pixels=crop.size)
    assert psnr(CODEC.decode(coded, max_pixels=crop.size), crop) == pytest.approx(psnr(theirs, crop), abs=0.1)


@given(
    width=st.integers(1, 90), height=st.integers(1, 90), quality=st.integers(1, 100), seed=st.integers(0, 9)
)
@settings(max_examples=60, deadline=None)
def test_every_crop_comes_back_in_its_size(width, height, quality, seed):
    """A crop of an odd size would fail at the ground, or come back as another picture."""
    crop = textured(width, height, seed=seed)
    data = CODEC.encode(crop, quality_pct=quality)
    assert jpeg_size(data) == (width, height)
    back = CODEC.decode(data, max_pixels=width * height)
    assert back.shape == crop.shape
    assert back.dtype == np.uint8
    if quality >= 90 and min(width, height) >= 16:
        assert psnr(back, crop) > 25


def test_a_bomb_is_refused_before_it_is_decoded():
    """One message of 20 bytes more than a header would make the ground allocate 12 GB."""
    data = bytearray(CODEC.encode(textured(32, 32), quality_pct=65))
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = b"\xff\xff\xff\xff"
    assert jpeg_size(bytes(data)) == (65535, 65535)
    with pytest.raises(StillError, match="65535x65535 has more than 1000000 pixels"):
        CODEC.decode(bytes(data), max_pixels=1_000_000)


def test_the_limit_is_exact():
    """A still of just the allowed size would be refused, or one beyond it taken."""
    data = CODEC.encode(textured(30, 20), quality_pct=65)
    assert CODEC.decode(data, max_pixels=600).shape == (20, 30, 3)
    with pytest.raises(StillError):
        CODEC.decode(data, max_pixels=599)


def _foreign() -> dict[str, bytes]:
    crop = textured(40, 30)
    whole = CODEC.encode(crop, quality_pct=65)
    encoded = {kind: cv2.imencode(kind, crop)[1].tobytes() for kind in (".png", ".bmp", ".webp")}
    wrong_size = bytearray(whole)
    at = whole.index(b"\xff\xc0")
    wrong_size[at + 5 : at + 9] = bytes(4)
    return {
        **encoded,
        "empty": b"",
        "short": b"\xff\xd8",
        "truncated": whole[: len(whole) // 2],
        "header only": whole[: whole.index(b"\xff\xda")] + b"\xff\xd9",
        "text": b"\xff\xd8 hello \xff\xd9",
        "progressive": pillow_jpeg(crop, progressive=True),
        "four components": _cmyk(crop),
        "no pixels": bytes(wrong_size),
        "two frame headers": whole[:at] + whole[at : at + 19] + whole[at:],
    }


def _cmyk(crop: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Pillow.fromarray(crop).convert("CMYK").save(buffer, "JPEG")
    return buffer.getvalue()


@pytest.mark.parametrize("kind", sorted(_foreign()))
def test_what_is_no_sequential_jpeg_is_refused(kind):
    """A truncated or disguised still would be shown, or reach a decoder that nobody meant to expose."""
    with pytest.raises(StillError):
        CODEC.decode(_foreign()[kind], max_pixels=10_000)


@given(st.data())
@settings(max_examples=200, deadline=None)
def test_flipped_bytes_never_crash_or_grow(draw):
    """A bit error on the link would take the ground down."""
    data = bytearray(CODEC.encode(textured(48, 40), quality_pct=65))
    for _ in range(draw.draw(st.integers(1, 4))):
        data[draw.draw(st.integers(0, len(data) - 1))] = draw.draw(st.integers(0, 255))
    try:
        image = CODEC.decode(bytes(data), max_pixels=4096)
    except StillError:
        return
    assert image.shape[0] * image.shape[1] <= 4096


@given(st.binary(max_size=200))
def test_noise_is_refused(noise):
    """Foreign bytes on the key would raise something that no stage catches."""
    with pytest.raises(StillError):
        CODEC.decode(noise, max_pixels=4096)
    with pytest.raises(StillError):
        CODEC.decode(b"\xff\xd8" + noise + b"\xff\xd9", max_pixels=4096)


def test_an_orientation_tag_does_not_turn_the_still():
    """A still from a third-party edge would be laid over its box on its side."""
    exif = Pillow.Exif()
    exif[0x0112] = 6
    data = pillow_jpeg(textured(40, 20), exif=exif)
    assert CODEC.decode(data, max_pixels=800).shape == (20, 40, 3)


def test_codecs_are_found_by_their_word_on_the_wire():
    """A wrong --still-codec would end in a traceback instead of a sentence."""
    assert still_codec("jpeg").media_type == "image/jpeg"
    assert all(name == codec.name for name, codec in STILL_CODECS.items())
    with pytest.raises(UserError, match="still codec 'gif' is not known: choose one of jpeg"):
        still_codec("gif")
