"""What every still codec of HVT promises, one test for all of them."""

import numpy as np
import pytest

from hvt_common.errors import UserError
from hvt_common.runtime import plug_ins
from hvt_common.video.still_codecs import StillError, psnr_y_db, still_codec, still_codec_names
from media.clips import real_pictures
from media.crops import textured, washed_out
from media.third_party import install
from programs.processes import python

NAMES = ("jpeg", "webp", "avif", "jxl", "h264-intra", "residual")
SIZE = (56, 40)


@pytest.fixture(params=NAMES)
def codec(request):
    if request.param not in still_codec_names():
        pytest.skip(f"{request.param} is not installed")
    return still_codec(request.param)


def encoded(codec, crop, quality_pct):
    return codec.encode(crop, quality_pct=quality_pct, base_bgr=_base(codec, crop))


def decoded(codec, coded, crop, data=None):
    return codec.decode(
        coded.data if data is None else data,
        size=(crop.shape[1], crop.shape[0]),
        parameters=coded.parameters,
        base_bgr=_base(codec, crop),
    )


def _base(codec, crop):
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

    def mean_db(one):
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


def test_codecs_are_found_by_their_word_on_the_wire():
    """A ground could not decode what its edge sends."""
    names = still_codec_names()
    assert {"jpeg", "h264-intra", "residual"} <= set(names)
    for name, codec in zip(names, map(still_codec, names), strict=True):
        assert (codec.name, codec.needs_base) == (name, name == "residual")
        assert "/" in codec.media_type
    with pytest.raises(UserError, match="still codec 'gif' is not known: choose one of jpeg, h264-intra"):
        still_codec("gif")


@pytest.mark.parametrize(("name", "package"), [("webp", "hvt"), ("avif", "hvt"), ("jxl", "hvt[jxl]")])
def test_without_the_extra_a_codec_names_what_to_install(name, package, monkeypatch):
    """It would be a codec that nobody knows."""
    still_codec.cache_clear()
    monkeypatch.setattr(plug_ins, "entry_points", lambda **_group: ())
    plug_ins.installed.cache_clear()
    try:
        assert still_codec_names() == ("jpeg", "h264-intra", "residual")
        with pytest.raises(UserError) as refused:
            still_codec(name)
    finally:
        plug_ins.installed.cache_clear()
    assert str(refused.value) == (
        f"still codec '{name}' is of an extra that is not installed: pip install '{package}'"
    )


@pytest.mark.parametrize(
    ("name", "place", "nothing", "says"),
    [
        ("jxl", "hvt_codecs.jxl.find_spec", None, r"it comes with the extra hvt\[jxl\]"),
        ("avif", "cv2.haveImageWriter", False, r"OpenCV .* is built without avif"),
        ("webp", "cv2.haveImageWriter", False, r"OpenCV .* is built without webp"),
    ],
)
def test_what_does_not_work_here_says_so(name, place, nothing, says, monkeypatch):
    """The edge would offer a codec, and fail at the first still."""
    still_codec.cache_clear()
    monkeypatch.setattr(place, lambda _name: nothing)
    assert name not in still_codec_names()
    with pytest.raises(UserError, match=rf"'{name}' is not available: {says}"):
        still_codec(name)


def test_asking_for_names_loads_no_codec():
    """`--help` on a drone would wait for encoders that nobody uses."""
    program = (
        "import sys; from hvt_common.video.still_codecs import still_codec_names; still_codec_names();"
        "heavy = {'av', 'PIL', 'pillow_jxl', 'hvt_common.video.still_codecs.residual'};"
        "print(sorted(heavy & sys.modules.keys()))"
    )
    done = python(program)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("target", ["PixelCodec", "PixelCodec()"])
def test_a_third_party_codec_codes_and_decodes(packages, target):
    """JPEG AI, or whatever comes next, could not be used without changing HVT."""
    source = (install.__globals__["PIXELS"]) + "\ninstance = PixelCodec()\n"
    packages({"acme-pixels": "instance" if target.endswith(")") else target}, source=source)
    assert still_codec_names()[-1] == "acme-pixels"
    codec, crop = still_codec("acme-pixels"), textured(40, 30)
    coded = codec.encode(crop, quality_pct=100)
    back = codec.decode(coded.data, size=(40, 30), parameters=coded.parameters)
    assert np.array_equal(back, crop)
    with pytest.raises(StillError):
        codec.decode(coded.data, size=(41, 30), parameters=coded.parameters)


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("raise RuntimeError('no licence')", "does not load: RuntimeError: no licence"),
        ("import nowhere_to_be_found", "does not load: ModuleNotFoundError"),
        ("", "does not load: AttributeError"),
        ("class C: pass", "its name is None"),
        ("class C:\n def lacking(self): pass", "does not load: TypeError"),
        ("class C: name = 'other'", "its name is 'other', and has to be the entry point's"),
        ("class C: name, media_type = 'acme', 'picture'", "its media_type is 'picture'"),
        ("class C: name, media_type = 'acme', 'image/x'", "its needs_base is None"),
        (
            "class C: name, media_type, needs_base = 'acme', 'image/x', False",
            "it has no encode and no decode",
        ),
    ],
)
def test_a_broken_plug_in_is_named_and_hinders_nobody(packages, source, says):
    """One bad package would ground every drone that has it installed, whatever codec it flies."""
    packages({"acme": "C"}, module="acme_broken", source=source)
    assert "acme" in still_codec_names()
    assert still_codec("jpeg").name == "jpeg"
    with pytest.raises(UserError, match=f"'acme' of package acme_broken .*{says}"):
        still_codec("acme")


@pytest.mark.parametrize("source", ["raise RuntimeError('no licence')", "class C: name = 'webp'"])
def test_another_webp_hinders_nobody(packages, source):
    """Every ground with that package would end at its start, which asks for the names, or say that it reads webp."""
    packages({"webp": "C"}, module="acme_webp", source=source)
    assert "webp" not in still_codec_names()
    with pytest.raises(UserError, match="still codec 'webp' comes from both package"):
        still_codec("webp")


def test_a_name_that_is_taken_is_refused(packages):
    """An installed package would change what `jpeg` means, on one side of the link."""
    packages({"jpeg": "PixelCodec"})
    with pytest.raises(UserError, match=r"'jpeg' is built in, and package acme_codecs .* brings another"):
        still_codec("jpeg")
    assert still_codec_names().count("jpeg") == 1
    assert still_codec("residual").name == "residual"
