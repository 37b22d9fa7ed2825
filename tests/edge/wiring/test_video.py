"""The size and frame rate of the base stream where nobody gives them, and a camera that is passed through."""

from pathlib import Path

import pytest

from hvt_codecs.passthrough.camera import Passthrough
from hvt_common.config import load
from hvt_common.errors import UserError
from hvt_common.values import View
from hvt_edge.config import EdgeConfig, check, check_rate, with_profile
from hvt_edge.source.opening import open_source
from hvt_edge.stills.policy.m6 import ExpectedGain
from hvt_edge.wiring import base_size, default_size, surveyed
from hvt_edge.wiring.link import auto_settings
from hvt_edge.wiring.perception import make_method
from media.hevc_camera import SIZE, write_clip


@pytest.mark.parametrize(
    ("source", "letterbox", "crop"),
    [
        ((1920, 1080), (1280, 720), (1280, 720)),
        ((3840, 2160), (1280, 720), (1280, 720)),
        ((1366, 768), (1280, 720), (1280, 720)),
        ((1100, 720), (1100, 720), (1100, 618)),
        ((1600, 1200), (960, 720), (1280, 720)),
        ((1080, 1920), (404, 720), (1080, 608)),
        ((360, 240), (360, 240), (360, 202)),
        ((363, 243), (362, 242), (362, 204)),
        ((30, 30), (64, 64), (64, 64)),
    ],
)
def test_no_source_is_enlarged(source, letterbox, crop):
    """Bits would be spent on pixels that nobody has taken, or on black borders."""
    assert default_size(source, fit="letterbox") == letterbox
    assert default_size(source, fit="crop") == crop


def settled(flags: str = "") -> EdgeConfig:
    words = ["--source", "x.mp4", *flags.split()]
    config, loaded = load(EdgeConfig, words, program="hvt-edge", description="")
    return check(with_profile(config, given=loaded.values))


@pytest.mark.parametrize(
    ("flags", "source", "size"),
    [
        ("", (360, 240), (360, 240)),
        ("--size 1280x720", (360, 240), (1280, 720)),
        ("--fit crop", (360, 240), (360, 202)),
        ("--method M0 --fps 2 --budget 40kbps", (1920, 1080), (1280, 720)),
        ("--method M0 --fps 2 --budget 30kbps", (1920, 1080), (960, 540)),
        ("--method M0 --fps 2 --budget 13kbps", (1920, 1080), (320, 180)),
        ("--method M0 --fps 2 --budget 12kbps", (1920, 1080), (320, 180)),  # and is refused
        ("--profile M0-best --budget 31kbps", (1920, 1080), (320, 180)),
    ],
)
def test_a_size_that_is_given_holds_and_another_fits_the_budget(flags, source, size):
    """The start would be refused for a size that nobody has asked for, or a given one count for nothing."""
    config = settled(flags)
    found = base_size(config)
    assert (found(source) if callable(found) else found) == size
    if config.budget_bps > 12_000:
        check_rate(config, size)


@pytest.mark.parametrize(
    ("opens", "says"),
    [(Passthrough.open_source, "--fps is 5"), (open_source, "no video that is coded already")],
)
def test_no_refusal_says_the_cameras_password(tmp_path: Path, opens, says):
    """It would stand in a log that everybody reads."""
    config = EdgeConfig(source="rtsp://admin:SECRET@10.0.0.5/s", encoder="passthrough", fps=5.0)
    clip = write_clip(tmp_path / "a.mp4")
    with opens(str(clip), size=SIZE, fps=15) as source, pytest.raises(UserError, match=says) as caught:
        surveyed(config, source)
    assert "SECRET" not in str(caught.value)
    assert "10.0.0.5" in str(caught.value)


# What stills are worth, by how much finer the source is than the base.


def view_of(source: tuple[int, int]) -> View:
    return View.fitted(source, (1280, 720), fit="letterbox")


@pytest.mark.parametrize(
    ("source", "weight", "finer"),
    [
        ((3840, 2160), 5 * 8 / 9, True),
        ((1920, 1080), 5 * 5 / 9, True),
        ((1600, 900), 5 * (1 - 0.64), False),
        ((1280, 720), 0, False),
        ((640, 360), 0, False),
    ],
)
def test_auto_values_pixels_that_the_base_does_not_have(source, weight, finer):
    """Of a 4K camera the operator would get a 720p picture, and no still that shows more."""
    view, config = view_of(source), settled()
    made = make_method(config, view)
    assert isinstance(made, ExpectedGain)
    assert made.detail_weight == pytest.approx(weight)
    assert auto_settings(config, view).finer == finer


def test_a_method_that_comes_back_has_the_parameters_it_began_with():
    """`set-method M5` and back would fly another M6 than was asked for."""
    view, config = view_of((1280, 720)), settled("--tune min_gain=0.07")
    assert make_method(config, view) == make_method(config, view, name="m6")
    assert make_method(config, view, name="M5").name == "M5"


@pytest.mark.parametrize(
    ("flags", "weight"),
    [
        ("--tune detail_weight=2", 2),
        ("--tune detail_weight=0", 0),
        ("--method M6", 0),
        ("--profile thin", 0),
        ("--profile auto --method M5", None),
    ],
)
def test_what_was_asked_for_holds_and_stills_may_pause_where_nobody_wants_details(flags, weight):
    """A study of M6 would fly another method, or stills be sent for ever for what the method does not value."""
    config, view = settled(flags), view_of((3840, 2160))
    assert getattr(make_method(config, view), "detail_weight", None) == weight
    assert auto_settings(config, view).finer == bool(weight)
