"""Still codecs are found by name, those of others too, and what is wrong with one is said in a sentence."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from hvt_common.errors import UserError
from hvt_common.runtime import plug_ins
from hvt_common.video.still_codecs import StillError, still_codec, still_codec_names
from media.crops import textured
from media.third_party import install


def test_codecs_are_found_by_their_word_on_the_wire():
    """A still would be coded as one thing and announced as another."""
    names = still_codec_names()
    assert {"jpeg", "h264-intra", "residual"} <= set(names)
    for name in names:
        codec = still_codec(name)
        assert codec.name == name
        assert "/" in codec.media_type
        assert codec.needs_base == (name == "residual")


def test_an_unknown_name_gets_the_choice():
    """A wrong --still-codec would end in a traceback instead of a sentence."""
    with pytest.raises(UserError, match="still codec 'gif' is not known: choose one of jpeg, h264-intra"):
        still_codec("gif")


@pytest.mark.parametrize(("name", "package"), [("webp", "edge"), ("avif", "edge"), ("jxl", "jxl")])
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
        f"still codec '{name}' is of an extra that is not installed: pip install 'hvt[{package}]'"
    )


def test_what_is_not_installed_names_its_extra(monkeypatch):
    """A user without JPEG XL would not learn how to get it."""
    still_codec.cache_clear()
    monkeypatch.setattr("hvt_codecs.jxl.find_spec", lambda _name: None)
    assert "jxl" not in still_codec_names()
    with pytest.raises(UserError, match=r"'jxl' is not available: it comes with the extra hvt\[jxl\]"):
        still_codec("jxl")


def test_an_opencv_without_a_format_says_so(monkeypatch):
    """An older OpenCV on a drone would fail at the first still, in flight."""
    still_codec.cache_clear()
    monkeypatch.setattr("cv2.haveImageWriter", lambda _name: False)
    assert not {"webp", "avif"} & set(still_codec_names())
    with pytest.raises(UserError, match=r"'avif' is not available: OpenCV .* is built without avif"):
        still_codec("avif")


def test_asking_for_names_loads_no_codec():
    """`--help` on a drone would wait for encoders that nobody uses."""
    program = (
        "import sys; from hvt_common.video.still_codecs import still_codec_names; still_codec_names();"
        "heavy = {'av', 'PIL', 'pillow_jxl', 'hvt_common.video.still_codecs.residual'};"
        "print(sorted(heavy & sys.modules.keys()))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
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


def test_two_packages_of_one_name_are_refused(packages):
    """Which of the two codes the stills would depend on the order of the path."""
    for module in ("acme_codecs", "acme_other"):
        packages({"acme-pixels": "PixelCodec"}, module=module)
    with pytest.raises(UserError, match="comes from both package acme_"):
        still_codec("acme-pixels")
