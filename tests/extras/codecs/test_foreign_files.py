"""WebP, AVIF and JPEG XL: files of other kinds are refused, and other programs open ours."""

import io

import cv2
import numpy as np
import pytest
from PIL import Image as Pillow

from hvt_codecs.avif import av1_data, av1_size, avif_file
from hvt_codecs.jxl import jxl_size
from hvt_codecs.webp import webp_size
from hvt_common.video.still_codecs import StillError, psnr_y_db, still_codec, still_codec_names
from media.crops import textured

SIZE = (56, 40)


def _pillow(kind: str, **options) -> bytes:
    buffer = io.BytesIO()
    Pillow.fromarray(textured(*SIZE)).save(buffer, kind, **options)
    return buffer.getvalue()


def test_webp_of_other_kinds_is_refused():
    """An animation of a thousand pictures hides in a few kilobytes."""
    frames = [Pillow.fromarray(textured(*SIZE, seed=seed)) for seed in range(3)]
    for data in (_pillow("WEBP", save_all=True, append_images=frames), _pillow("WEBP", lossless=True)):
        with pytest.raises(StillError):
            webp_size(data)
    assert webp_size(_pillow("WEBP", quality=50)) == SIZE


@pytest.mark.skipif("avif" not in still_codec_names(), reason="OpenCV without AVIF")
def test_avif_goes_both_ways_with_other_programs():
    """`avif` would be a name for something that no other program opens."""
    crop = textured(*SIZE)
    file = still_codec("avif").encode(crop, quality_pct=80).data
    with Pillow.open(io.BytesIO(file)) as opened:
        theirs = np.asarray(opened.convert("RGB"))[..., ::-1]
    ours = still_codec("avif").decode(file, size=SIZE)
    assert psnr_y_db(np.ascontiguousarray(theirs), ours) > 45
    assert np.array_equal(ours, cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR))


@pytest.mark.skipif("avif" not in still_codec_names(), reason="OpenCV without AVIF")
def test_boxes_written_here_show_the_same_picture():
    """A foreign AVIF file would be shown in other colours than it has."""
    file = still_codec("avif").encode(textured(*SIZE), quality_pct=65).data
    data = av1_data(file)
    assert av1_size(data) == SIZE
    rebuilt = cv2.imdecode(np.frombuffer(avif_file(data, size=SIZE), np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(rebuilt, still_codec("avif").decode(file, size=SIZE))


@pytest.mark.skipif("avif" not in still_codec_names(), reason="OpenCV without AVIF")
def test_avif_of_more_than_one_picture_is_refused():
    """A sequence, or two frames behind one header, would cost more than the one picture that was announced."""
    file = still_codec("avif").encode(textured(*SIZE), quality_pct=65).data
    data = av1_data(file)
    frame = data[data.index(b"\x32") :]
    for wrong in (data + frame, frame, data[: len(data) - len(frame)], data[:-1], data + b"\x32"):
        with pytest.raises(StillError):
            av1_size(wrong)
    for wrong in (file.replace(b"ftypavif", b"ftypavis"), file + file[file.index(b"mdat") - 4 :], file[:-1]):
        with pytest.raises(StillError):
            av1_data(wrong)


@pytest.mark.skipif("jxl" not in still_codec_names(), reason="the extra hvt[jxl] is not installed")
def test_jxl_of_several_frames_is_refused():
    """Frames that are only kept for reference may be of any size."""
    from pillow_jxl import Encoder

    crop = textured(*SIZE)
    assert jxl_size(still_codec("jxl").encode(crop, quality_pct=65).data) == SIZE
    for options in ({"lossless": True, "quality": 100}, {"use_container": True, "quality": 90}):
        whole = {"mode": "RGB", "lossless": False, "use_container": False, "use_original_profile": False}
        encoder = Encoder(**{**whole, **options}, decoding_speed=0, effort=3, num_threads=0)
        data = encoder(crop.tobytes(), *SIZE, jpeg_encode=False)
        with pytest.raises(StillError):
            still_codec("jxl").decode(data, size=SIZE)
